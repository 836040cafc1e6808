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
from mjx_nero.data import encoding, stats


def write(
    path: pathlib.Path, episodes: Sequence[tuple[int, Callable[[], Iterable[np.ndarray]]]], shape: tuple[int, ...], fps: float
) -> list[stats.Stats]:
    """Encodes episodes, as many at a time as there are cores, and writes them one after another.

    Args:
        episodes: of each the number of frames, and a function that yields them, uint8 [height, width, 3]; called in any thread.
        shape: shape of a frame, with even height and width.

    Returns:
        the statistics of each episode's pictures.
    """
    import av

    step, found = fractions.Fraction(1, round(fps)), list[stats.Stats]()
    pool = concurrent.futures.ThreadPoolExecutor(cores())
    with av.open(str(path), "w") as file, contextlib.ExitStack() as ends:
        ends.callback(pool.shutdown, cancel_futures=True)  # start no further episode after an error or Ctrl-C
        stream: Any = file.add_stream(encoding.CODEC, rate=round(fps), options=encoding.OPTIONS)
        stream.height, stream.width, stream.pix_fmt = *shape[:2], encoding.PIXELS
        begin = 0
        for packets, told in pool.map(lambda each: encoding.encoded(each[1](), each[0], shape, fps), episodes):
            for packet in packets:
                packet.stream, packet.time_base = stream, step
                packet.pts, packet.dts = packet.pts + begin, packet.dts + begin
                file.mux(packet)
            begin += len(packets)
            found.append(told)
    return found


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
        "video.pix_fmt": encoding.PIXELS,
        "video.is_depth_map": False,
        "video.fps": round(fps),
        "video.channels": 3,
        "has_audio": False,
    }
