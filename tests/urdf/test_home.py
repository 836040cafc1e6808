"""The home pose of imported arms: the elbow's branch, linkages that always touch, hands that cannot point straight down."""

import mujoco
import numpy as np
import pytest
import urdf_files as files

from mjx_nero import env_cfg
from mjx_nero.sim import robot_file
from mjx_nero.sim.scene import robot_model
from mjx_nero.urdf import import_urdf

UR = (
    "0 0 1",
    "0 1 0",
    "0 1 0",
    "0 1 0",
    "0 0 -1",
    "0 1 0",
)  # axes of a shoulder, an elbow and a wrist that all bend in one plane
FRAMES = ("0 0 0.16", "0 0.14 0", "0 -0.12 0.425", "0 0 0.39", "0 0.09 0", "0 0 0.09")
FREE = 'lower="-6.28" upper="6.28" effort="100" velocity="2"'


def ur(folder, *more: str):
    """An arm with three parallel axes, as UR's, whose elbow goes up as well as down."""
    names = ["base", *(f"u{i}" for i in range(1, 7))]
    lengths = (0.1, 0.42, 0.38, 0.06, 0.06, 0.06)
    parts = [files.base()]
    for i, axis in enumerate(UR):
        body = files.shape(f'<box size="0.06 0.06 {lengths[i]}"/>', xyz=f"0 0 {lengths[i] / 2}")
        parts.append(files.link(names[i + 1], files.inertial(2.0), body))
        parts.append(files.joint(f"j{i}", names[i], names[i + 1], xyz=FRAMES[i], axis=axis, limit=FREE))
    palm = files.link("palm", files.inertial(0.1)), files.joint("tool", "u6", "palm", "fixed", "0 0.08 0", "-1.5708 0 0")
    hand = files.fingers(folder, "palm", at="0 0 0.03")
    report = import_urdf(files.write(folder / "in", files.robot(*parts, *palm, *hand, *more)), folder / "out")
    return report, robot_file.read(folder / "out")


def lowest_elbow(robot) -> float:
    model = robot_model(robot)
    data = mujoco.MjData(model)
    for name, at in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos = at
    mujoco.mj_kinematics(model, data)
    return float(data.body("u3").xpos[2]), float(data.site(robot.ee_site).xpos[2])


def test_the_elbow_of_a_ur_is_up(tmp_path):
    _, robot = ur(tmp_path)
    assert robot.pick is not None
    elbow, hand = lowest_elbow(robot)
    assert elbow > 0.3 and elbow > hand


@pytest.mark.parametrize("offset", ["0", "3.14159265", "1.5708"])
def test_a_home_spares_half_a_turn_of_the_hand(tmp_path, offset):
    """However the hand is mounted, at home its fingers open along y within a quarter of a turn of what ``down`` asks for."""
    hand = files.fingers(tmp_path, "palm", at="0 0 0.02")
    palm = files.link("palm", files.inertial(0.1)), files.joint("tool", "link6", "palm", "fixed", "0 0 0.05", f"0 0 {offset}")
    import_urdf(files.write(tmp_path / "in", files.robot(files.base(), *files.six(), *palm, *hand)), tmp_path / "out")
    robot = robot_file.read(tmp_path / "out")
    model = robot_model(robot)
    data, down, between = mujoco.MjData(model), np.zeros(9), np.zeros(4)
    for name, at in zip(robot.joints, robot.home, strict=True):
        data.joint(name).qpos = at
    mujoco.mj_kinematics(model, data)
    mujoco.mju_quat2Mat(down, np.array(robot.down))
    off = data.site(robot.ee_site).xmat.reshape(3, 3) @ down.reshape(3, 3).T
    mujoco.mju_mat2Quat(between, off.ravel())
    assert off[2, 2] > 0.99 and off[1, 1] > -0.01 and robot.pick is not None


def test_links_that_always_touch_do_not_end_the_test_of_the_others(tmp_path):
    """Two links of a linkage lie within one another at every pose: that says nothing of a pose."""
    fist = [
        files.link(n, files.inertial(0.05), files.shape('<box size="0.05 0.05 0.05"/>')) for n in ("knuckle", "rod", "coupler")
    ]
    chain = [
        files.joint(f"to_{n}", p, n, "fixed" if n == "knuckle" else "revolute", "0 0 0", inner="")
        for p, n in (("palm", "knuckle"), ("knuckle", "rod"), ("rod", "coupler"))
    ]
    _, robot = ur(tmp_path, *fist, *chain)
    elbow, _ = lowest_elbow(robot)
    assert elbow > 0.3


def test_a_hand_that_cannot_open_along_y_is_not_asked_to(tmp_path):
    """A wrist that hardly turns, mounted an eighth of a turn off: the hand points down, askew."""
    hand = files.fingers(tmp_path, "palm", at="0 0 0.02")
    palm = files.link("palm", files.inertial(0.1)), files.joint("tool", "l5", "palm", "fixed", "0 0 0.05", "0 0 0.785")
    names, axes = ["base", "l1", "l2", "l3", "l4", "l5"], ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1")
    frames = ("0 0 0.1", "0 0 0.1", "0 0 0.3", "0 0 0.3", "0 0 0.05")
    parts = [files.base()]
    for i, axis in enumerate(axes):
        parts.append(files.link(names[i + 1], files.inertial(0.3), files.shape('<box size="0.03 0.03 0.04"/>', xyz="0 0 0.02")))
        limit = 'lower="-0.02" upper="0.02" effort="80" velocity="2"' if i == 4 else files.ROOM
        parts.append(files.joint(f"j{i}", names[i], names[i + 1], xyz=frames[i], axis=axis, limit=limit))
    import_urdf(files.write(tmp_path / "in", files.robot(*parts, *palm, *hand)), tmp_path / "out")
    robot = robot_file.read(tmp_path / "out")
    assert robot.pick is not None and not robot.turns and robot.lean == 0
    assert env_cfg("pick_place", robot=robot).controllers["pick_place"]["ik.free_turn"]


@pytest.mark.parametrize("lean", [0.0, 0.7])
def test_a_lean_reaches_the_file_and_the_controllers(tmp_path, lean):
    folder = tmp_path / "arm"
    import_urdf(files.write(tmp_path / "in", files.robot(files.base(), *files.six(), *files.fingers(tmp_path, "link6"))), folder)
    text = (folder / "robot.yaml").read_text()
    assert "lean: 0.0\n" in text
    (folder / "robot.yaml").write_text(text.replace("lean: 0.0\n", f"lean: {lean}\n"))
    assert robot_file.read(folder).lean == lean
    for task, controller in (("pick_place", "pick_place"), ("stack", "pick_place"), ("place", "pick_place")):
        fields = env_cfg(task, robot=folder).controllers[controller]
        assert ("ik.orientation_weight" in fields) == (lean > 0)


def test_an_arm_that_cannot_point_down_records_its_lean(tmp_path):
    """A wrist that bends by a sixth of a turn at most, as its shoulder and elbow do: the hand leans, and its home with it."""
    bend = 'lower="-1.02" upper="1.02" effort="80" velocity="2"'
    names, axes = ["base", "l1", "l2", "l3", "l4", "l5"], ("0 0 1", "0 1 0", "0 1 0", "0 1 0", "0 0 1")
    frames = ("0 0 0.05", "0 0 0.05", "0 0 0.25", "0 0 0.25", "0 0 0.05")
    parts = [files.base()]
    for i, axis in enumerate(axes):
        parts.append(files.link(names[i + 1], files.inertial(0.3), files.shape('<box size="0.03 0.03 0.04"/>', xyz="0 0 0.02")))
        limit = bend if 0 < i < 4 else files.ROOM
        parts.append(files.joint(f"j{i}", names[i], names[i + 1], xyz=frames[i], axis=axis, limit=limit))
    import_urdf(files.write(tmp_path / "in", files.robot(*parts, *files.fingers(tmp_path, "l5"))), tmp_path / "out")
    robot = robot_file.read(tmp_path / "out")
    assert robot.pick is not None and robot.lean == pytest.approx(np.pi / 4, abs=1e-3)
