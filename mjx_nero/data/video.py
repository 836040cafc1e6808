"""Videos of a data set: H.264 with a whole picture every second frame, so that any frame is near one to begin from."""

import pathlib
from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np

from mjx_nero.errors import UserError

CODEC, PIXELS = "libx264", "yuv420p"
_OPTIONS = {"crf": "18", "g": "2", "preset": "veryfast"}  # crf: of 0 to 51, the least lossless


def need() -> None:
    """Is there an encoder?

    Raises:
        UserError: there is none.
    """
    try:
        import av  # noqa: F401
    except ModuleNotFoundError:
        raise UserError("pictures need PyAV, of the extra 'demos': pip install 'mjx-nero[demos]'") from None


def write(path: pathlib.Path, pictures: Iterable[np.ndarray], shape: tuple[int, ...], fps: float) -> None:
    """Encodes frames, uint8 [height, width, 3], one after another.

    Args:
        shape: of a frame; height and width are even.
    """
    import av

    with av.open(str(path), "w") as file:
        stream: Any = file.add_stream(CODEC, rate=round(fps), options=_OPTIONS)
        stream.height, stream.width, stream.pix_fmt = *shape[:2], PIXELS
        for frame in pictures:
            file.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")))
        file.mux(stream.encode())


def frames(path: pathlib.Path) -> Iterator[np.ndarray]:
    """The frames of a file, uint8 [height, width, 3], one after another.

    Raises:
        OSError, ValueError: it is none.
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
