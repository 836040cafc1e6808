"""``robot.yaml``: written, read, and refused with a line that says why."""

import dataclasses
import shutil

import pytest
import yaml

from mjx_nero import UserError, make
from mjx_nero.sim import robot_file
from mjx_nero.sim.robot import GripperCfg
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.tasks.arms.so_arm100 import SO_ARM100


@pytest.fixture
def folder(tmp_path):
    """Nero as an imported robot."""
    shutil.copy(NERO.xml, tmp_path / "model.xml")
    robot_file.write(tmp_path, NERO)
    return tmp_path


def change(folder, **fields):
    path = folder / robot_file.NAME
    content = yaml.safe_load(path.read_text()) | fields
    path.write_text(yaml.safe_dump({k: v for k, v in content.items() if v != "gone"}))


def test_what_was_written_is_read(folder):
    read = robot_file.read(folder)
    assert dataclasses.replace(read, folder="") == NERO
    assert read.xml == folder / "model.xml"
    assert float(read.gripper.gap((0.03, -0.01))) == pytest.approx(0.04)  # two slides


def test_a_gap_that_nobody_knows(tmp_path):
    shutil.copy(SO_ARM100.xml, tmp_path / "model.xml")
    robot_file.write(tmp_path, SO_ARM100)
    read = robot_file.read(tmp_path)
    assert read.gripper.gap is None and read.gripper.open == (0.5,) and read.base_link == "base"


def test_without_gripper_and_with_less_said(folder):
    robot_file.write(folder, dataclasses.replace(NERO, gripper=GripperCfg()))
    assert robot_file.read(folder).gripper.joints == ()
    change(folder, gripper="gone", workspace="gone", down="gone")
    read = robot_file.read(folder)
    assert read.gripper.joints == () and read.workspace is None and read.down == (0, 1, 0, 0)


def test_edits_count(folder):
    rows = yaml.safe_load((folder / robot_file.NAME).read_text())["arm"]
    rows["joint1"]["stiffness"] = 123
    change(folder, arm=rows, workspace=[[0.2, 0.3], [-0.1, 0.1], [0.2, 0.2]])
    env = make("reach", robot=str(folder), impl="native")
    assert env.cfg.robot.arm.stiffness[0] == 123.0 and env.cfg.command.params["z"] == (0.2, 0.2)
    assert env.physics_model.actuator("joint1").gainprm[0] == 123.0


ROW = {"stiffness": 1.0, "damping": 1.0, "effort": 1.0, "speed": 1.0, "home": 0.0}


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"arms": {}}, r"no field 'arms' \(did you mean 'arm'\?\)"),
        ({"arm": {}}, "arm names no joint"),
        ({"arm": [1]}, "arm takes one line per joint"),
        ({"arm": {"joint1": {"stiffness": 1.0}}}, "joint1 takes stiffness, damping, effort, speed, home; got"),
        ({"arm": {"joint1": {**ROW, "effort": "much"}}}, "joint1.effort takes a finite number, got 'much'"),
        ({"arm": {"joint1": {**ROW, "effort": float("nan")}}}, "joint1.effort takes a finite number, got nan"),
        ({"arm": {"joint1": {**ROW, "stiffness": -1}}}, r"joint1.stiffness must be above 0 and at most 1e\+06, got -1"),
        ({"arm": {"joint11": ROW}}, r"model.xml has no joint 'joint11' \(did you mean 'joint1'\?\)"),
        ({"ee_site": "eee"}, r"has no site or body 'eee' \(did you mean 'ee'\?\)"),
        ({"base_link": "bass"}, r"has no body 'bass'"),
        ({"base_pos": [0, 0]}, r"base_pos takes a list of 3 numbers, got \[0, 0\]"),
        ({"workspace": [0.1, 0.2]}, "workspace takes a list of 3 entries"),
        ({"gravity_compensation": 1}, "gravity_compensation takes true or false, got 1"),
    ],
)
def test_mistakes(folder, fields, message):
    change(folder, **fields)
    with pytest.raises(UserError, match=message) as error:
        robot_file.read(folder)
    assert "\n" not in str(error.value)


def test_files_that_are_not_there_or_broken(folder, tmp_path_factory):
    with pytest.raises(UserError, match="holds no robot.yaml: make one with python -m mjx_nero import-urdf"):
        robot_file.read(tmp_path_factory.mktemp("empty"))
    (folder / "model.xml").write_text("<mujoco>")
    with pytest.raises(UserError, match="model.xml is not well-formed XML"):
        robot_file.read(folder)
    (folder / "model.xml").write_text("<mujoco><worldbody><body><geom/></body></worldbody></mujoco>")
    with pytest.raises(UserError, match="model.xml has no joint 'joint1'"):
        robot_file.read(folder)
    (folder / robot_file.NAME).write_text("a: [")
    with pytest.raises(UserError, match="is not YAML"):
        robot_file.read(folder)
    (folder / robot_file.NAME).write_text("- 1")
    with pytest.raises(UserError, match="takes fields like arm"):
        robot_file.read(folder)
