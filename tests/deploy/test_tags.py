"""Objects by AprilTags, in pictures that are drawn here: every pixel's ray meets the tag's plane."""

import json
import time

import numpy as np
import pytest

from mjx_nero.deploy import places, tags
from mjx_nero.deploy.body import matrix, transform
from mjx_nero.errors import UserError

# Number 0 of tag36h11 (AprilRobotics/apriltag, tag36h11.c): its code, and where its bits are, from the highest.
CODE = 0xD7E00984B
COLUMNS = [1, 2, 3, 4, 5, 2, 3, 4, 3, 6, 6, 6, 6, 6, 5, 5, 5, 4, 6, 5, 4, 3, 2, 5, 4, 3, 4, 1, 1, 1, 1, 1, 2, 2, 2, 3]
ROWS = [1, 1, 1, 1, 1, 2, 2, 2, 3, 1, 2, 3, 4, 5, 2, 3, 4, 3, 6, 6, 6, 6, 6, 5, 5, 5, 4, 6, 5, 4, 3, 2, 5, 4, 3, 4]
SIZE, CAMERA = 0.03, (600.0, 600.0, 320.0, 240.0)


def tag():
    """[10, 10] black and white, with the white border."""
    out = np.zeros((10, 10))
    out[[0, -1]] = out[:, [0, -1]] = 1.0
    for i, (column, row) in enumerate(zip(COLUMNS, ROWS, strict=True)):
        out[row + 1, column + 1] = CODE >> (35 - i) & 1
    return out


def drawn(pose, shape=(480, 640), finer=3):
    """A picture of the tag at a pose [4, 4] in the camera's frame."""
    fx, fy, cx, cy = CAMERA
    v, u = (np.mgrid[0 : shape[0] * finer, 0 : shape[1] * finer] + 0.5) / finer
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1)
    normal, centre = pose[:3, 2], pose[:3, 3]
    points = rays * ((normal @ centre) / (rays @ normal))[..., None] - centre
    x, y = (points @ pose[:3, k] / SIZE * 8 + 5 for k in (0, 1))
    inside = (x >= 0) & (x < 10) & (y >= 0) & (y < 10)
    fine = np.where(inside, tag()[np.clip(y, 0, 9).astype(int), np.clip(x, 0, 9).astype(int)], 0.6)
    return (255 * fine.reshape(shape[0], finer, shape[1], finer).mean((1, 3))).astype(np.uint8)


@pytest.fixture
def camera(tmp_path):
    """Looks straight down from 60 cm above (0.3, 0.1); the tag is on top of a cube of 4 cm."""
    inside = {"object": "cube", "position": [0, 0, 0.02], "quaternion": [0, 1, 0, 0]}
    told = {"camera": 0, "intrinsics": CAMERA, "position": [0.3, 0.1, 0.6], "quaternion": [0, 1, 0, 0], "size": SIZE}
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({**told, "tags": {"0": inside}}))
    return tags.read(path)


@pytest.mark.parametrize(("x", "y", "yaw"), [(0.3, 0.1, 0.0), (0.24, 0.16, 0.5), (0.36, 0.05, -1.2)])
def test_the_cube_is_where_it_was_drawn(camera, x, y, yaw):
    """Within 3 mm and a degree, at 60 cm: the tag is 30 pixels wide."""
    cube = transform([x, y, 0.02], [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)])
    inside = camera.tags[0][1]
    pose = np.linalg.inv(camera.pose) @ cube @ np.linalg.inv(inside)
    found = tags.FromTags(camera, _once(drawn(pose)))
    place = _wait(found)
    found.close()
    np.testing.assert_allclose(place.position, [x, y, 0.02], atol=3e-3)
    turned = matrix(place.quaternion)
    assert np.arctan2(turned[1, 0], turned[0, 0]) == pytest.approx(yaw, abs=0.02) and turned[2, 2] > 0.99


def _once(picture):
    left = [picture]
    return lambda: left.pop() if left else None


def _wait(found, seconds=60.0):
    end = time.monotonic() + seconds
    while True:
        try:
            return found.find("cube", time.monotonic())
        except places.Lost:
            assert time.monotonic() < end
            time.sleep(0.02)


def test_an_empty_picture_and_an_old_one_are_lost(camera):
    found = tags.FromTags(camera, _once(np.full((480, 640), 150, np.uint8)))
    with pytest.raises(places.Lost, match="the camera does not see the tag of the cube"):
        found.find("cube", time.monotonic())
    found._places["cube"] = (time.monotonic() - 1.0, places.Place(np.zeros(3), np.array([1.0, 0, 0, 0])))
    with pytest.raises(places.Lost):
        found.find("cube", time.monotonic())
    found.close()


def test_quaternions_of_any_turn():
    rng = np.random.default_rng(0)
    for _ in range(200):
        quat = rng.normal(size=4)
        quat /= np.linalg.norm(quat) * np.sign(quat[0])
        np.testing.assert_allclose(tags.quaternion(matrix(quat)), quat, atol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"intrinsics": [1, 2, 3]}, "needs camera, intrinsics of four numbers"),
        ({"tags": {"x": {}}}, "needs camera"),
        ({"tags": {}}, "tags must name at least one"),
        ({"quaternion": [2, 0, 0, 0]}, "quaternion four of length 1"),
        ({"size": 0}, r"size \[m\] must be above 0"),
    ],
)
def test_files_that_say_something_else(tmp_path, change, message):
    told = {"camera": 0, "intrinsics": CAMERA, "size": 0.03, "tags": {"0": {"object": "cube"}}, **change}
    (tmp_path / "c.json").write_text(json.dumps(told))
    with pytest.raises(UserError, match=message):
        tags.read(tmp_path / "c.json")


def test_other_files_are_no_cameras(tmp_path):
    (tmp_path / "place.json").write_text('{"position": [0.2, 0, 0.015]}')
    assert tags.read(tmp_path / "place.json") is None and tags.read(tmp_path / "none.json") is None
    assert isinstance(places.of(str(tmp_path / "place.json")), places.FromFile)
