"""Encodes one film at a time in a process of its own.

Threads of one process would wait for Python's lock: they kept five of twelve cores busy. The pictures go through memory that both
processes see. Everything else goes through the process's standard input and output, as lines of JSON; bytes of packets follow
their line. The process forks for each film: x264 ends a slice by bits that depend on what it encoded before, so the same pictures
would not always be the same file.
"""

import atexit
import fractions
import json
import mmap
import os
import queue
import subprocess
import sys
from collections.abc import Iterable, Iterator
from typing import IO, Any

import numpy as np

from mjx_nero.data import stats
from mjx_nero.errors import UserError

CODEC, PIXELS = "libx264", "yuv420p"
# crf: quality from 0 (lossless) to 51. bf: no frame depends on a later one, which would need two frames between key frames.
OPTIONS = {"crf": "18", "g": "2", "bf": "0", "preset": "veryfast", "threads": "1"}
TOGETHER = 1 << 24  # bytes of pictures that are handed over at once

_free: queue.SimpleQueue["Encoder"] = queue.SimpleQueue()  # started, and idle


def encoded(frames: Iterable[np.ndarray], length: int, shape: tuple[int, ...], fps: float) -> tuple[list[Any], stats.Stats]:
    """Encodes a film in an idle process, or in a new one.

    Args:
        frames: uint8 [height, width, 3] each.
        length: number of frames.

    Returns:
        PyAV's packets, and the statistics of the pictures.

    Raises:
        UserError: the process died.
    """
    try:
        encoder = _free.get_nowait()
    except queue.Empty:
        encoder = Encoder()
    try:
        found = encoder(frames, length, shape, fps)
    except BaseException:  # it may be in the middle of a film
        encoder.close()
        raise
    _free.put(encoder)
    return found


@atexit.register
def close() -> None:
    """Ends the idle processes."""
    while not _free.empty():
        _free.get().close()


class Encoder:
    """A process that encodes. It ends with this process, too, because its standard input does."""

    def __init__(self) -> None:
        self._memory = os.memfd_create("pictures")
        self._process = subprocess.Popen(
            [sys.executable, "-c", f"from mjx_nero.data import encoding; encoding.serve({self._memory})"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            pass_fds=[self._memory],
            start_new_session=True,  # Ctrl-C is for the process that waits for this one
            env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OPENBLAS_NUM_THREADS": "1"},
        )

    def close(self) -> None:
        """Ends the process."""
        self._process.kill()
        self._process.communicate()
        os.close(self._memory)

    def __call__(self, frames: Iterable[np.ndarray], length: int, shape: tuple[int, ...], fps: float) -> tuple[list, stats.Stats]:
        """See ``encoded``."""
        size, count, packets = int(np.prod(shape)), 0, list[Any]()
        most = max(1, TOGETHER // size)
        self._tell({"shape": shape, "fps": round(fps), "sampled": sorted(stats.sampled(length))})
        for frame in frames:
            os.pwrite(self._memory, np.ascontiguousarray(frame).data, count * size)
            count += 1
            if count == most:
                packets += self._handed(count)[0]
                count = 0
        if count:
            packets += self._handed(count)[0]
        last, found = self._handed(0)
        return packets + last, {name: np.array(x) for name, x in found.items()}

    def _handed(self, count: int) -> tuple[list, dict]:
        """Hands over the pictures in the memory, none at the end. Returns packets, and at the end statistics."""
        from av import Packet

        self._tell(count)
        try:
            answer, packets = json.loads(self._process.stdout.readline()), list[Any]()  # type: ignore[union-attr]
        except (OSError, ValueError):
            raise _died() from None
        for size, key, pts, dts, duration in answer["packets"]:
            content = self._process.stdout.read(size)  # type: ignore[union-attr]
            if len(content) < size:
                raise _died()
            packet = Packet(content)
            packet.pts, packet.dts, packet.duration, packet.is_keyframe = pts, dts, duration, key
            packets.append(packet)
        return packets, answer["stats"]

    def _tell(self, what: Any) -> None:
        try:
            self._process.stdin.write(json.dumps(what).encode() + b"\n")  # type: ignore[union-attr]
            self._process.stdin.flush()  # type: ignore[union-attr]
        except OSError:
            raise _died() from None


def _died() -> UserError:
    return UserError("a process that encodes videos died, perhaps for want of memory: free some, and repeat the command")


def serve(memory: int) -> None:
    """Encodes films until the standard input ends; the other process's side is ``Encoder``."""
    import av  # noqa: F401  # here, not once for each film

    given, told = open(0, "rb", buffering=0), sys.stdout.buffer  # a buffer would hold lines that are for the fork
    try:
        while line := given.readline():
            if not (film := os.fork()):
                _film(given, told, memory, **json.loads(line))
                os._exit(0)
            if os.waitpid(film, 0)[1]:
                os._exit(1)
    except (BrokenPipeError, json.JSONDecodeError):
        os._exit(1)  # the other process died: nothing to say, and nobody to hear it


def _film(given: IO[bytes], told: IO[bytes], memory: int, shape: list[int], fps: int, sampled: list[int]) -> None:
    encoder, kept, wanted, at = _codec(shape[0], shape[1], fps), list[np.ndarray](), {*sampled}, 0
    for pictures in _pictures(given, memory, shape):
        packets = []
        for picture in pictures:
            if at in wanted:
                kept.append(picture.copy())
            packets += encoder.encode(_frame(picture, at, encoder.time_base))
            at += 1
        _answer(told, packets, {})
    found = stats.of_pictures(kept) if kept else {}
    _answer(told, encoder.encode() if at else [], {name: x.tolist() for name, x in found.items()})


def _pictures(given: IO[bytes], memory: int, shape: list[int]) -> Iterator[np.ndarray]:
    while count := json.loads(given.readline()):
        yield np.frombuffer(mmap.mmap(memory, count * int(np.prod(shape))), np.uint8).reshape(count, *shape)


def _codec(height: int, width: int, fps: int) -> Any:
    from av.codec import CodecContext
    from av.codec.context import Flags

    encoder: Any = CodecContext.create(CODEC, "w")
    encoder.height, encoder.width, encoder.pix_fmt, encoder.options = height, width, PIXELS, OPTIONS
    encoder.framerate, encoder.time_base = fps, fractions.Fraction(1, fps)
    encoder.flags |= Flags.global_header.value  # parameters are written once, in the file's header
    return encoder


def _frame(picture: np.ndarray, at: int, time_base: fractions.Fraction) -> Any:
    from av import VideoFrame

    drawn = VideoFrame.from_numpy_buffer(picture, format="rgb24")  # without a copy
    drawn.pts, drawn.time_base = at, time_base
    return drawn


def _answer(told: IO[bytes], packets: list[Any], found: dict[str, Any]) -> None:
    about = [(packet.size, packet.is_keyframe, packet.pts, packet.dts, packet.duration) for packet in packets]
    told.write(json.dumps({"packets": about, "stats": found}).encode() + b"\n" + b"".join(bytes(packet) for packet in packets))
    told.flush()
