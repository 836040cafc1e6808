"""Videos of a data set: H.264 with a key frame at every second frame, so that a reader can start near any frame.

Each episode is encoded separately, so that all cores can work, and begins with a key frame.
"""

import concurrent.futures
import contextlib
import fractions
import pathlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from mjx_nero import cores
from mjx_nero.errors import UserError

CODEC, PIXELS = "libx264", "yuv420p"
# crf: quality from 0 (lossless) to 51. bf: no frame depends on a later one, which would need two frames between key frames.
_OPTIONS = {"crf": "18", "g": "2", "bf": "0", "preset": "veryfast", "threads": "1"}


def need() -> None:
    """Checks that the encoder is installed.

    Raises:
        UserError: it is not.
    """
    try:
        import av  # noqa: F401
    except ModuleNotFoundError:
        raise UserError("pictures need PyAV, of the extra 'demos': pip install 'mjx-nero[demos]'") from None


def write(path: pathlib.Path, episodes: Sequence[Callable[[], Iterable[np.ndarray]]], shape: tuple[int, ...], fps: float) -> None:
    """Encodes episodes, as many at a time as there are cores, and writes them one after another.

    Args:
        episodes: functions that yield the frames of each, uint8 [height, width, 3]; called in any thread.
        shape: shape of a frame, with even height and width.
    """
    import av

    step = fractions.Fraction(1, round(fps))

    def encoded(frames: Callable[[], Iterable[np.ndarray]]) -> list[Any]:
        encoder: Any = av.CodecContext.create(CODEC, "w")
        encoder.height, encoder.width, encoder.pix_fmt, encoder.options = *shape[:2], PIXELS, _OPTIONS
        encoder.framerate, encoder.time_base = round(fps), step
        encoder.flags |= av.codec.context.Flags.global_header.value  # parameters are written once, in the file's header
        packets = []
        for i, frame in enumerate(frames()):
            drawn = av.VideoFrame.from_numpy_buffer(np.ascontiguousarray(frame), format="rgb24")  # without a copy
            drawn.pts, drawn.time_base = i, step
            packets += encoder.encode(drawn)
        return packets + encoder.encode()

    pool = concurrent.futures.ThreadPoolExecutor(cores())
    with av.open(str(path), "w") as file, contextlib.ExitStack() as ends:
        ends.callback(pool.shutdown, cancel_futures=True)  # start no further episode after an error or Ctrl-C
        stream: Any = file.add_stream(CODEC, rate=round(fps), options=_OPTIONS)
        stream.height, stream.width, stream.pix_fmt = *shape[:2], PIXELS
        begin = 0
        for packets in pool.map(encoded, episodes):
            for packet in packets:
                packet.stream, packet.time_base = stream, step
                packet.pts, packet.dts = packet.pts + begin, packet.dts + begin
                file.mux(packet)
            begin += len(packets)


def frames(path: pathlib.Path) -> Iterator[np.ndarray]:
    """Yields the frames of a video file, uint8 [height, width, 3].

    Raises:
        OSError, ValueError: it is not a video file.
    """
    import av

    try:
        with av.open(str(path)) as file:
            for frame in file.decode(video=0):
                yield frame.to_ndarray(format="rgb24")
    except av.FFmpegError as error:
        raise ValueError(str(error)) from None


def describe(shape: tuple[int, ...], fps: float) -> dict[str, object]:
    """Describes a video for the index."""
    return {
        "video.height": shape[0],
        "video.width": shape[1],
        "video.codec": "h264",
        "video.pix_fmt": PIXELS,
        "video.is_depth_map": False,
        "video.fps": round(fps),
        "video.channels": 3,
        "has_audio": False,
    }
