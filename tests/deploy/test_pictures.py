"""Pictures for policies that see: how they are cut, where they come from, and what becomes of the arm when they stop."""

import json
import time

import numpy as np
import pytest

from mjx_nero.deploy import pictures
from mjx_nero.errors import UserError

cv2 = pytest.importorskip("cv2")
TOLD = {"front": {"shape": [64, 64, 3], "fovy_deg": 45.0, "every_steps": 1}}


def board(rows=480, columns=640):
    """Blue grows downwards, green to the right; all of it red."""
    picture = np.zeros((rows, columns, 3), np.uint8)
    picture[..., 0] = np.linspace(0, 255, rows)[:, None]
    picture[..., 1] = np.linspace(0, 255, columns)
    picture[..., 2] = 200
    return picture


def test_the_middle_is_cut_out_in_the_policys_colours():
    """Of 90 degrees, 45 are tan(22.5) = 0.414 of the height: 199 of 480 rows, and as many columns."""
    seen = pictures.View("front", TOLD["front"], 90.0)(board())
    assert seen.shape == (64, 64, 3) and seen.dtype == np.uint8 and (seen[..., 0] == 200).all()
    down, right = seen[:, 32, 2].astype(float), seen[32, :, 1].astype(float)
    np.testing.assert_allclose([down[0], down[-1]], 127.5 + np.array([-1, 1]) * 127.5 * 0.414 * 63 / 64, atol=2)
    np.testing.assert_allclose([right[0], right[-1]], 127.5 + np.array([-1, 1]) * 127.5 * 199 / 640 * 63 / 64, atol=2)


def test_the_whole_height_where_the_field_is_the_same():
    seen = pictures.View("front", TOLD["front"], 45.0)(board())
    assert seen[0, 0, 2] < 4 and seen[-1, 0, 2] > 251


def test_cameras_that_see_too_little_are_refused():
    with pytest.raises(UserError, match="'front' has a fovy of 40 degrees, but the policy needs 45"):
        pictures.View("front", TOLD["front"], 40.0)
    with pytest.raises(UserError, match="gives 300 x 480 pixels, but the policy needs a wider one"):
        pictures.View("front", TOLD["front"], 45.0)(board(480, 300))


@pytest.fixture
def folder(tmp_path):
    """Five pictures, each of one shade."""
    for k in range(5):
        cv2.imwrite(str(tmp_path / f"{k}.png"), np.full((48, 48, 3), 50 * k, np.uint8))
    return tmp_path


def test_pictures_of_a_folder_come_in_turn_and_old_ones_are_a_fault(folder, monkeypatch):
    monkeypatch.setattr(pictures, "FRESH", 1.0)  # whoever reads them may have to wait for a processor
    film = pictures.Cameras({"front": (str(folder), 45.0)}, TOLD, 0.02)
    shades, kind = [], ""
    try:
        while True:
            shades.append(int(film(None, time.monotonic())["front"][0, 0, 0]))
            time.sleep(0.005)
    except pictures.Unseen as error:
        kind = error.kind
        assert "the last picture of the camera 'front' is 1" in str(error) and "ms old" in str(error)
    film.close()
    assert kind == "picture" and shades == sorted(shades) and shades[-1] == 200
    assert "ms old (median)" in pictures.summary(film.ages)


def test_a_video_is_a_camera(tmp_path):
    path = str(tmp_path / "film.avi")
    film = cv2.VideoWriter(path, cv2.VideoWriter_fourcc(*"MJPG"), 25, (64, 48))
    for _ in range(3):
        film.write(np.full((48, 64, 3), 90, np.uint8))
    film.release()
    seen, end = pictures.opened(path)
    assert [abs(int(seen()[20, 20, 0]) - 90) < 5 for _ in range(3)] == [True] * 3 and seen() is None
    end()


def test_no_picture_and_no_camera_are_said(tmp_path):
    with pytest.raises(UserError, match="cannot open camera '/dev/nothing'"):
        pictures.opened("/dev/nothing")
    pictures._FIRST, before = 0.1, pictures._FIRST
    with pytest.raises(UserError, match="'front' gives no picture"):
        pictures.Cameras({"front": (str(tmp_path), 45.0)}, TOLD, 0.02)
    pictures._FIRST = before


@pytest.mark.parametrize("text", ["[]", '{"side": {"camera": 0}}', '{"front": 1}', '{"front": {"camera": 0, "fovy": 200}}'])
def test_files_that_say_something_else(tmp_path, text):
    (tmp_path / "c.json").write_text(text)
    with pytest.raises(UserError, match='c.json must be JSON with a "camera"'):
        pictures.read(tmp_path / "c.json", TOLD)


def test_a_file_says_what_each_camera_is(tmp_path):
    (tmp_path / "c.json").write_text(json.dumps({"front": {"camera": "/dev/video2", "fovy": 60}}))
    assert pictures.read(tmp_path / "c.json", TOLD) == {"front": ("/dev/video2", 60.0)}
    (tmp_path / "c.json").write_text(json.dumps({"front": {"camera": 1}}))
    assert pictures.read(tmp_path / "c.json", TOLD) == {"front": (1, 45.0)}
    with pytest.raises(UserError, match="there is no file"):
        pictures.read(tmp_path / "none.json", TOLD)
