"""Whatever lies where a file should be: every reader of deploy says so in one line that names it, and waits for nothing."""

import os
import random

import pytest

from mjx_nero import UserError
from mjx_nero.deploy import identified, pictures, places, tags
from mjx_nero.deploy.drivers import lerobot, so_arm
from mjx_nero.deploy.policy import Policy

TOLD = {"robot": "arm", "joints": {"names": ["j1"], "lower": [-1.0], "upper": [1.0]}, "gripper": []}
READERS = {
    "policy": Policy,
    "identified": lambda path: identified.read(path, TOLD),
    "calibration of an SO-ARM": lambda path: so_arm.read_calibration(path, ("j1",)),
    "calibration of LeRobot": lambda path: lerobot.motors_of(TOLD, path),
    "cameras": lambda path: pictures.read(path, {"front": {"fovy_deg": 50}}),
    "place of an object": places.FromFile,
    "camera or place": lambda path: tags.read(path) or places.FromFile(path),
}
FOUND = {
    "missing": lambda path: None,
    "empty": lambda path: path.touch(),
    "folder": lambda path: path.mkdir(),
    "pipe": os.mkfifo,
    "endless": lambda path: path.symlink_to("/dev/zero"),
    "large": lambda path: path.write_bytes(bytes(101_000_000)),
    "random bytes": lambda path: path.write_bytes(random.Random(0).randbytes(5000)),
    "cut": lambda path: path.write_text('{"j1": {"id": 1,'),
    "another kind": lambda path: path.write_text('{"mine": [1, NaN]}'),
    "a list": lambda path: path.write_text("[1]"),
    "a number": lambda path: path.write_text("1"),
}


@pytest.mark.parametrize("found", FOUND)
@pytest.mark.parametrize("reader", READERS)
def test_it_is_refused_in_one_line(tmp_path, reader, found):
    FOUND[found](tmp_path / "file")
    with pytest.raises(UserError) as refused:
        READERS[reader](tmp_path / "file")
    said = str(refused.value)
    assert str(tmp_path / "file") in said and said.isprintable() and len(said) <= UserError.LONGEST, said
