"""Pictures for a policy with cameras, from real cameras, videos or folders (OpenCV), cropped and scaled as in training.

``--cameras cameras.json`` has an entry for each of the policy's cameras, by its name:

    {"front": {"camera": 0, "fovy": 55}, "wrist": {"camera": "/dev/video2", "fovy": 80}}

``camera`` is OpenCV's number or address of a camera, a video file, or a folder of pictures, which are shown in the order of their
names. ``fovy`` is the vertical field of view of the whole picture [deg]. The policy sees the central part that its camera saw in
training.
"""

import math
import pathlib
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from mjx_nero import files
from mjx_nero.deploy.arm import Feedback
from mjx_nero.deploy.places import Lost
from mjx_nero.errors import UserError

FRESH = 0.1  # maximum age of a picture [s], as for feedback
_FIRST = 5.0  # time limit for the first picture [s]
Source = tuple[Callable[[], "np.ndarray | None"], Callable[[], None]]


class Unseen(Lost):
    """A camera has stopped giving pictures."""

    kind = "picture"


def opened(source: int | str, period: float = 0.0) -> Source:
    """Opens a source; returns a function that gets its next picture [h, w, 3] (blue, green, red; None: no picture), and one that
    closes it.

    Args:
        source: OpenCV's number or address of a camera, or the path of a video or of a folder of pictures.
        period: time between two pictures of a file [s]; a camera has its own.

    Raises:
        UserError: the source does not exist.
    """
    import cv2  # of the extra ``camera``

    path = pathlib.Path(source) if isinstance(source, str) else None
    if path and path.is_dir():
        found = iter(sorted(each for each in path.iterdir() if each.suffix.lower() in (".png", ".jpg", ".jpeg", ".bmp")))

        def shown() -> np.ndarray | None:
            time.sleep(period)
            return cv2.imread(str(each)) if (each := next(found, None)) else None

        return shown, lambda: None
    capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        raise UserError(f"cannot open camera {source!r}: give OpenCV's number or address of a camera, a video or a folder")
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    pause = period if path and path.is_file() else 0.0

    def taken() -> np.ndarray | None:
        time.sleep(pause)
        there, picture = capture.read()
        return picture if there else None

    return taken, capture.release


class View:
    """Crops a camera's picture to what the policy's camera sees, and converts its size and colours.

    Args:
        told: description of the camera in the policy's metadata.
        fovy: vertical field of view of the whole picture [deg].

    Raises:
        UserError: the camera sees less than the policy's camera.
    """

    def __init__(self, name: str, told: Mapping[str, Any], fovy: float):
        self._name, (self._height, self._width, _) = name, told["shape"]
        self._share = math.tan(math.radians(float(told["fovy_deg"])) / 2) / math.tan(math.radians(fovy) / 2)
        if self._share > 1.001:
            raise UserError(
                f"the camera {name!r} has a fovy of {fovy:g} degrees, but the policy needs {told['fovy_deg']:g}: use a wider lens"
            )

    def __call__(self, picture: np.ndarray) -> np.ndarray:
        """Converts a picture [h, w, 3] (blue, green, red) to [height, width, 3] (red, green, blue).

        Raises:
            UserError: the picture is too narrow.
        """
        import cv2

        rows, columns = picture.shape[:2]
        height = min(self._share, 1.0) * rows
        width = height * self._width / self._height
        if width > columns + 1:
            raise UserError(
                f"the camera {self._name!r} gives {columns} x {rows} pixels, but the policy needs a wider one: change its mode"
            )
        top, left = round((rows - height) / 2), max(round((columns - width) / 2), 0)
        part = picture[top : top + round(height), left : left + round(width)]
        small = cv2.resize(part, (self._width, self._height), interpolation=cv2.INTER_AREA)
        return np.ascontiguousarray(small[..., ::-1])


class _Film:
    """The newest picture of a source, read by a thread."""

    def __init__(self, view: View, source: Source):
        self._view, (self._next, self._end) = view, source
        self._over, self.error = threading.Event(), ""
        self.newest: tuple[float, np.ndarray] | None = None
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        try:
            while not self._over.is_set():
                picture = self._next()
                if picture is None:
                    self._over.wait(0.02)
                else:
                    self.newest = time.monotonic(), self._view(picture)
        except UserError as error:
            self.error = str(error)

    def close(self) -> None:
        self._over.set()
        self._thread.join(2.0)
        self._end()


class Cameras:
    """The newest picture of each camera.

    Args:
        told: the policy's cameras, by name, from its metadata.
        dt: control step [s].

    Attributes:
        ages: ages of the pictures that the policy was shown [s].

    Raises:
        UserError: a camera is missing, gives no picture, or sees too little.
    """

    def __init__(self, own: Mapping[str, tuple[int | str, float]], told: Mapping[str, Any], dt: float):
        self.ages: list[float] = []
        self._films: dict[str, _Film] = {}
        try:
            for name, (source, fovy) in own.items():
                view = View(name, told[name], fovy)
                self._films[name] = _Film(view, opened(source, dt * told[name]["every_steps"]))
            self._wait()
        except BaseException:
            self.close()
            raise

    def _wait(self) -> None:
        end = time.monotonic() + _FIRST
        for name, film in self._films.items():
            while film.newest is None:
                if film.error or time.monotonic() > end:
                    raise UserError(film.error or f"the camera {name!r} gives no picture: check that it works and is not in use")
                time.sleep(0.01)

    def __call__(self, feedback: Feedback, now: float) -> dict[str, np.ndarray]:
        """See ``observe.Pictures``.

        Raises:
            Unseen: the newest picture is older than ``FRESH``.
        """
        out: dict[str, np.ndarray] = {}
        for name, film in self._films.items():
            assert film.newest is not None
            taken, out[name] = film.newest
            self.ages.append(now - taken)
            if now - taken > FRESH:
                raise Unseen(f"the last picture of the camera {name!r} is {1e3 * (now - taken):.0f} ms old")
        return out

    def close(self) -> None:
        """Closes the cameras."""
        for film in self._films.values():
            film.close()


def read(path: pathlib.Path, told: Mapping[str, Any]) -> dict[str, tuple[int | str, float]]:
    """Reads source and field of view [deg] of each of the policy's cameras from a file.

    Raises:
        UserError: the file does not exist, or is invalid.
    """
    found = files.read_json(path)
    try:
        if set(found) != set(told):
            raise ValueError
        return {name: _camera(found[name], told[name]) for name in told}
    except (TypeError, KeyError, ValueError, AttributeError):
        wanted = 'must be JSON with a "camera", and optionally its "fovy" in degrees, for each of'
        raise UserError(f"{path} {wanted} {', '.join(told)}") from None


def _camera(found: Mapping[str, Any], told: Mapping[str, Any]) -> tuple[int | str, float]:
    source, fovy = found["camera"], float(found.get("fovy", told["fovy_deg"]))
    if isinstance(source, bool) or not isinstance(source, int | str) or not 1 <= fovy <= 170:
        raise ValueError
    return source, fovy


def summary(ages: Sequence[float]) -> str:
    """Summarizes the ages of pictures."""
    middle, late = (1e3 * float(np.percentile(ages, p)) for p in (50, 99))
    return f"{middle:.0f} ms old (median), {late:.0f} ms (99th percentile)"
