"""Object poses from AprilTags in a camera's pictures (pupil-apriltags; OpenCV opens the camera).

``--object camera.json`` uses it if the file has a ``camera``:

    {"camera": 0, "intrinsics": [600, 600, 320, 240], "position": [0.2, 0, 0.7], "quaternion": [0, 1, 0, 0], "size": 0.03,
     "tags": {"3": {"object": "cube", "position": [0, 0, 0.015]}}}

``camera`` is OpenCV's number or address of the camera, ``intrinsics`` are fx, fy, cx, cy in pixels. ``position`` and
``quaternion`` (wxyz) are the camera's pose in the robot's root frame, with x to the right of the picture, y down and z into it.
``size`` is the edge of a tag's black square [m]; ``family`` is tag36h11 by default. Each tag names the object that it is on, and
the pose of the object's center in the tag's frame: x to the right and y down as printed, z into the object.
"""

import contextlib
import dataclasses
import pathlib
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mjx_nero import files
from mjx_nero.deploy.body import matrix, transform
from mjx_nero.deploy.pictures import opened
from mjx_nero.deploy.places import FRESH, Known, Lost, Place
from mjx_nero.errors import UserError

Pictures = Callable[[], "np.ndarray | None"]  # returns the next picture, grey [h, w]; None: there is none
_SURE = 20.0  # minimum decision margin of a detection


@dataclasses.dataclass(frozen=True)
class Camera:
    """A camera and the tags to look for. Poses are [4, 4].

    Attributes:
        source: OpenCV's number or address of the camera.
        intrinsics: fx, fy, cx, cy [pixels].
        pose: pose of the camera in the robot's root frame.
        size: edge of a tag's black square [m].
        family: family of the tags.
        tags: number of a tag -> object, and its pose in the tag's frame.
    """

    source: int | str
    intrinsics: tuple[float, float, float, float]
    pose: np.ndarray
    size: float
    family: str
    tags: Mapping[int, tuple[str, np.ndarray]]


def read(path: pathlib.Path) -> Camera | None:
    """Reads the file of a camera; None if the file does not describe one.

    Raises:
        UserError: the file has a ``camera``, but something else is wrong.
    """
    try:
        found = files.read_json(path)
    except UserError:
        return None
    if not isinstance(found, Mapping) or "camera" not in found:
        return None
    try:
        tags = {int(number): (str(tag["object"]), _pose(tag)) for number, tag in found["tags"].items()}
        fx, fy, cx, cy = (float(x) for x in found["intrinsics"])
        source = found["camera"] if isinstance(found["camera"], int) else str(found["camera"])
        made = Camera(source, (fx, fy, cx, cy), _pose(found), float(found["size"]), str(found.get("family", "tag36h11")), tags)
    except (TypeError, KeyError, ValueError, AttributeError) as error:
        text = "needs camera, intrinsics of four numbers, position, quaternion, size and tags, each with an object"
        raise UserError(f"{path} {text} ({type(error).__name__}: {error})") from None
    if not (fx > 0 and fy > 0 and 0.001 < made.size < 1 and tags):
        raise UserError(f"{path}: fx, fy and size [m] must be above 0, size below 1, and tags must name at least one")
    return made


def _pose(found: Mapping[str, Any]) -> np.ndarray:
    position, quat = (np.array(found.get(name, usual), float) for name, usual in _USUAL.items())
    if position.shape != (3,) or quat.shape != (4,) or not 0.99 < np.linalg.norm(quat) < 1.01:
        raise ValueError("position takes three numbers, quaternion four of length 1")
    return transform(position, quat)


_USUAL = {"position": (0.0, 0.0, 0.0), "quaternion": (1.0, 0.0, 0.0, 0.0)}


class FromTags(Known):
    """Object poses from tags, which a thread finds in the pictures.

    Args:
        pictures: source of pictures; None: the camera.

    Raises:
        UserError: the camera does not exist.
    """

    def __init__(self, camera: Camera, pictures: Pictures | None = None):
        from pupil_apriltags import Detector  # of the extra ``camera``

        super().__init__(FRESH)
        self._camera, self._lock, self._over, self._end = camera, threading.Lock(), threading.Event(), lambda: None
        self._detector = Detector(families=camera.family, quad_decimate=1.0)
        self._detector.tag_families = {}  # its end would free the families first, which the detector still reads as it ends
        self._pictures = pictures or self._open()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _open(self) -> Pictures:
        import cv2

        shown, self._end = opened(self._camera.source)
        return lambda: None if (picture := shown()) is None else cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)

    def _run(self) -> None:
        while not self._over.is_set():
            picture = self._pictures()
            if picture is None:
                self._over.wait(0.05)
                continue
            taken = time.monotonic()
            found = places(self._detector, self._camera, picture)
            with self._lock:
                self._places.update({name: (taken, place) for name, place in found.items()})

    def find(self, name: str, now: float) -> Place:
        """See ``Places``."""
        with self._lock, contextlib.suppress(Lost):
            return super().find(name, now)
        raise Lost(f"the camera does not see the tag of the {name}")

    def close(self) -> None:
        """Closes the camera."""
        self._over.set()
        self._thread.join(2.0)
        self._end()


def places(detector: Any, camera: Camera, picture: np.ndarray) -> dict[str, Place]:
    """Finds the objects whose tags a picture [h, w] shows, by name. If an object shows several tags, the surest counts."""
    shown = np.ascontiguousarray(picture, np.uint8)
    seen = detector.detect(shown, estimate_tag_pose=True, camera_params=camera.intrinsics, tag_size=camera.size)
    out: dict[str, Place] = {}
    for tag in sorted(seen, key=lambda each: each.decision_margin):
        if tag.tag_id in camera.tags and tag.decision_margin > _SURE and tag.hamming == 0:
            name, inside = camera.tags[tag.tag_id]
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = tag.pose_R, np.ravel(tag.pose_t)
            there = camera.pose @ pose @ inside
            out[name] = Place(there[:3, 3], quaternion(there[:3, :3]))
    return out


def quaternion(turn: np.ndarray) -> np.ndarray:
    """Returns the quaternion (wxyz) of a rotation [3, 3]: the eigenvector of its quadratic form (Bar-Itzhack 2000)."""
    (a, b, c), (d, e, f), (g, h, i) = turn
    form = np.array(
        [
            [a + e + i, h - f, c - g, d - b],
            [h - f, a - e - i, b + d, c + g],
            [c - g, b + d, e - a - i, f + h],
            [d - b, c + g, f + h, i - a - e],
        ]
    )
    found = np.linalg.eigh(form)[1][:, -1]
    assert np.allclose(matrix(found), turn, atol=1e-6)
    return found if found[0] >= 0 else -found
