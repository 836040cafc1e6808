"""Robots of other structures than an arm with two fingers: what is the arm, what the gripper, where the tool, how it stands.

Each URDF here has the structure of a public robot for which an earlier rule guessed wrong."""

import math
from pathlib import Path

import mujoco
import numpy as np
import pytest
import urdf_files as make
from urdf_files import ROOM, base, fingers, six

from mjx_nero.sim import contacts, robot_file, scene
from mjx_nero.tasks import registry
from mjx_nero.tools import tuning
from mjx_nero.tools.import_urdf import main
from mjx_nero.types import UserError
from mjx_nero.urdf import Report, cloud, import_urdf


def imported(folder: Path, *parts: str, **options) -> tuple[mujoco.MjModel, Report]:
    report = import_urdf(make.write(folder / "in", make.robot(*parts)), folder / "out", **options)
    return scene.robot_model(robot_file.read(folder / "out")), report


def at_home(model: mujoco.MjModel, report: Report) -> mujoco.MjData:
    data = mujoco.MjData(model)
    for name, value in zip(report.robot.joints, report.robot.home, strict=True):
        data.joint(name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    return data


def test_spinning_horn_is_no_finger(tmp_path):
    """A motor's horn that turns endlessly beside the fingers changes no distance between them: it is held still."""
    horn = make.link("horn", make.inertial(0.01), make.shape('<box size="0.03 0.005 0.005"/>'))
    spin = make.joint("gripper", "link6", "horn", "continuous", xyz="0 0 0.05", axis="1 0 0", limit='effort="1" velocity="3"')
    _, report = imported(tmp_path, base(), *six(), horn, spin, *fingers(tmp_path, "link6"))
    assert report.robot.gripper.joints == ("left",)
    assert report.robot.gripper.open == (0.05,) and report.robot.gripper.close == (0.01,)
    assert report.robot.arm.joints == tuple(f"a{i}" for i in range(1, 7))
    assert report.joints["gripper"]["merged"] and "note: held still at 0" in report.notes.of("joint", "gripper")


def test_limited_horn_is_no_finger(tmp_path):
    """It has limits, but still moves nothing apart."""
    horn = make.link("horn", make.inertial(0.01), make.shape('<box size="0.03 0.005 0.005"/>'))
    spin = make.joint("turner", "link6", "horn", xyz="0 0 0.05", axis="0 0 1", limit=ROOM)
    _, report = imported(tmp_path, base(), *six(), horn, spin, *fingers(tmp_path, "link6"))
    assert report.robot.gripper.joints == ("left",)


def test_a_gear_beside_the_wrist_ends_no_arm(tmp_path):
    """It turns on the body that carries the last joint, so that the tree forks before the hand."""
    gear = make.link("gear", make.inertial(0.01), make.shape('<cylinder radius="0.01" length="0.01"/>'))
    turn = make.joint("drive", "link5", "gear", xyz="0 0.03 0", axis="0 0 1", limit=ROOM)
    parts = base(), *six(), gear, turn, *fingers(tmp_path, "link6")
    with pytest.raises(UserError, match=r"an arm, and 1 joint beside it \(drive\)\. Choose --chain base:link6"):
        imported(tmp_path, *parts)
    _, report = imported(tmp_path, *parts, chain="base:link6")
    assert report.robot.arm.joints == tuple(f"a{i}" for i in range(1, 7)) and report.robot.gripper.joints == ("left",)


def test_endless_fingers_are_bounded(tmp_path):
    """Two jaws that turn without limits: open and closed lie within a quarter turn."""
    make.box(tmp_path / "in" / "jaw.stl", (-0.01, -0.005, 0), (0.01, 0.005, 0.08))
    jaws = [
        part
        for name, y, axis in (("one", 0.03, "-1 0 0"), ("two", -0.03, "1 0 0"))
        for part in (
            make.link(name, make.inertial(0.05), make.mesh("jaw.stl")),
            make.joint(
                f"{name}_turn", "link6", name, "continuous", xyz=f"0 {y} 0.05", axis=axis, limit='effort="2" velocity="2"'
            ),
        )
    ]
    _, report = imported(tmp_path, base(), *six(), *jaws)
    gripper = report.robot.gripper
    assert gripper.joints == ("one_turn", "two_turn")
    assert np.abs(gripper.open + gripper.close).max() <= math.pi / 2 + 1e-9


def test_hand_of_many_joints_is_held(tmp_path):
    """Four fingers of five joints each are no gripper; one of their tips is not the tool."""
    parts = []
    for f in range(4):
        above = "link6"
        for k in range(5):
            name = f"finger{f}_{k}"
            parts.append(make.link(name, make.inertial(0.01), make.shape('<box size="0.01 0.01 0.02"/>', xyz="0 0 0.01")))
            parts.append(make.joint(f"j_{name}", above, name, xyz=f"{0.02 * f if k == 0 else 0} 0 0.03", axis="0 1 0"))
            above = name
    palm = make.link("hand_grasp_frame"), make.joint("g", "link6", "hand_grasp_frame", "fixed", xyz="0 0 0.1")
    model, report = imported(tmp_path, base(), *six(), *parts, *palm)
    assert report.robot.gripper.joints == () and len(report.robot.arm.joints) == 6
    assert any("20 joints: held still" in w for w in report.warnings)
    np.testing.assert_allclose(model.site("ee").pos, [0, 0, 0.1])


@pytest.mark.parametrize("tool", ["tool0", "my_tcp", "end_effector_link", "ee_link", "robot/ee_arm_link"])
def test_tool_frame_wins_though_something_hangs_on_it(tmp_path, tool):
    """A camera and an IMU hang on the flange, further out and later in the file; the tool's frame is the grasp point."""
    frames = [make.link(n) for n in (tool, "camera_link", "camera_color_frame", "imu_frame")]
    joints = [
        make.joint("t", "link6", tool, "fixed", xyz="0 0 0.08"),
        make.joint("c", tool, "camera_link", "fixed", xyz="0 0.05 0"),
        make.joint("o", "camera_link", "camera_color_frame", "fixed", xyz="0 0 0.02"),
        make.joint("i", tool, "imu_frame", "fixed", xyz="0 0 0.03"),
    ]
    model, _ = imported(tmp_path, base(), *six(), *frames, *joints)
    np.testing.assert_allclose(model.site("ee").pos, [0, 0, 0.08], atol=1e-9)


def test_last_link_is_no_camera(tmp_path):
    frames = [make.link(n) for n in ("camera_link", "camera_depth_optical_frame")]
    joints = [
        make.joint("c", "link6", "camera_link", "fixed", xyz="0 0.05 0"),
        make.joint("o", "camera_link", "camera_depth_optical_frame", "fixed", xyz="0 0 0.02"),
    ]
    model, _ = imported(tmp_path, base(), *six(), *frames, *joints)
    assert model.site("ee").bodyid[0] == model.body("link6").id and not model.site("ee").pos.any()


@pytest.mark.parametrize(
    ("name", "end", "gripper"), [("hand_flange", "1.2", ("roll",)), ("hand_flange", "3.4", ()), ("link_fngr", "1.2", ("roll",))]
)
def test_a_hand_that_turns_at_the_wrist_is_no_jaw(tmp_path, name, end, gripper):
    limit = f'lower="-{end}" upper="{end}" effort="5" velocity="1"'
    hand = make.link(name, make.inertial(0.1), make.shape('<box size="0.05 0.05 0.02"/>'))
    _, report = imported(tmp_path, base(), *six(), hand, make.joint("roll", "link6", name, xyz="0 0 0.08", limit=limit))
    assert report.robot.gripper.joints == gripper and len(report.robot.arm.joints) == 7 - len(gripper)


def test_the_flange_of_no_telling_name_lies_on_the_last_axis(tmp_path):
    """``end_link`` is on it, 8 cm out; the later ``dummy_mount`` beside it."""
    joints = [
        make.joint("e", "link6", "end_link", "fixed", xyz="0 0 0.08"),
        make.joint("d", "link6", "dummy_mount", "fixed", xyz="0 -0.09 0", rpy="1.5707963 1.5707963 0"),
    ]
    model, report = imported(tmp_path, base(), *six(), make.link("end_link"), make.link("dummy_mount"), *joints)
    np.testing.assert_allclose(model.site("ee").pos, [0, 0, 0.08], atol=1e-9)
    assert any(n.text.startswith("grasp point: link 'end_link', the last one") for n in report.notes)


def test_fingers_meet_at_the_nearest_named_frame(tmp_path):
    """Of two frames by the name of the end effector, the flange's, on which the gripper hangs, is not the grasp point."""
    flange = make.link("ee_arm_link"), make.joint("f", "link6", "ee_arm_link", "fixed", xyz="0 0 0.02")
    grasp = make.link("ee_gripper_link"), make.joint("g", "ee_arm_link", "ee_gripper_link", "fixed", xyz="0 0 0.13")
    model, _ = imported(tmp_path, base(), *six(), *flange, *grasp, *fingers(tmp_path, "ee_arm_link"))
    np.testing.assert_allclose(model.site("ee").pos, [0, 0, 0.15], atol=1e-9)


def test_tool_points_along_its_own_axis(tmp_path):
    """A last joint that turns about x, with the tool in front along x: pointing down then turns x to -z."""
    parts = six()[:-2]
    turn = make.link("end", make.inertial(0.3), make.shape('<box size="0.06 0.04 0.04"/>', xyz="0.03 0 0"))
    model, report = imported(tmp_path, base(), *parts, turn, make.joint("roll", "link5", "end", xyz="0.05 0 0", axis="1 0 0"))
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, np.array(report.robot.down))
    np.testing.assert_allclose(matrix.reshape(3, 3)[:, 0], [0, 0, -1], atol=1e-6)


def test_a_hand_points_down_the_way_round_that_it_is_at_home(tmp_path):
    """Half a turn of the wrist at home, and what is called pointing down is turned by as much."""
    downs = []
    for name, turn in (("one", 0.0), ("other", 2.9)):
        folder = tmp_path / name
        given = {"a1": 0.0, "a2": 0.4, "a3": 1.4, "a4": 0.0, "a5": 1.34, "a6": turn}  # the hand down
        model, report = imported(folder, base(), *six(), *fingers(folder, "link6"), home=given)
        hand, down = at_home(model, report).site(report.robot.ee_site).xmat.reshape(3, 3), np.zeros(9)
        mujoco.mju_quat2Mat(down, np.array(report.robot.down))
        assert (hand.T @ down.reshape(3, 3))[1, 1] > 0.9  # the axis along which the fingers open
        downs.append(report.robot.down)
    assert set(downs) == {(0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0)}


def test_home_is_amid_the_workspace_and_away_from_limits(tmp_path):
    """An elbow whose limit is at 0, where the arm would be stretched out as well."""
    model, report = imported(
        tmp_path, base(), *six(elbow='lower="0" upper="2.8" effort="80" velocity="2"'), *fingers(tmp_path, "link6")
    )
    robot, data = report.robot, at_home(model, report)
    site = data.site(robot.ee_site)
    np.testing.assert_allclose(site.xpos, np.mean(robot.workspace, axis=1), atol=5e-3)
    fingers_along = site.xmat.reshape(3, 3) @ [0, 0, 1]
    assert fingers_along @ [0, 0, -1] > math.cos(0.05)  # the hand points down
    for name, value in zip(robot.arm.joints, robot.arm.home, strict=True):
        lower, upper = model.joint(name).range
        assert min(value - lower, upper - value) > 0.05 * (upper - lower), name
    jacobian = np.zeros((6, model.nv))
    mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], model.site(robot.ee_site).id)
    assert np.linalg.svd(jacobian[:, :6] * np.array([[1 / 0.7]] * 3 + [[1.0]] * 3))[1][5] > 0.03
    assert "point down in all of it" in " ".join(report.notes.of("robot", "arm"))


def two_arms(folder: Path) -> list[str]:
    """A torso with two arms with grippers, a head and two wheels."""
    turn = {"type": "continuous", "limit": 'effort="5" velocity="2"'}
    parts = [base()]
    for tag, y in (("r_", -0.2), ("l_", 0.2)):
        parts += [*six(tag=tag, foot=f"0 {y} 0.4"), *fingers(folder, f"{tag}link6", tag)]
        parts += [
            make.link(f"{tag}wheel", make.inertial()),
            make.joint(f"{tag}roll", "base", f"{tag}wheel", axis="0 1 0", **turn),
        ]
    return [*parts, make.link("head", make.inertial()), make.joint("head_pan", "base", "head", xyz="0 0 0.8")]


def test_two_arms_are_a_choice(tmp_path):
    parts = two_arms(tmp_path)
    with pytest.raises(UserError) as error:
        imported(tmp_path, *parts)
    text = str(error.value)
    assert "2 arms" in text and "--chain base:r_link6, --chain base:l_link6" in text and "r_roll, l_roll, head_pan" in text
    model, report = imported(tmp_path, *parts, chain="base:l_link6")
    assert report.robot.arm.joints == tuple(f"l_a{i}" for i in range(1, 7)) and report.robot.gripper.joints == ("l_left",)
    assert model.njnt == 8 and report.mass == pytest.approx(report.mass_read)  # the rest is there, and still


def test_legs_and_casters_are_no_choice_before_an_arm(tmp_path):
    """A dog with four legs and an arm, whose last frame is a camera's; two casters turn about three endless axes each."""
    turn = {"type": "continuous", "limit": 'effort="5" velocity="2"'}
    parts = [base()]
    for tag in ("a_", "b_", "c_", "d_"):
        links = [make.link(f"{tag}{i}", make.inertial()) for i in (1, 2, 3)]
        chain = [("base", f"{tag}1"), (f"{tag}1", f"{tag}2"), (f"{tag}2", f"{tag}3")]
        parts += [*links, *(make.joint(f"{tag}j{child[-1]}", parent, child, xyz="0 0 -0.1") for parent, child in chain)]
    for tag in ("e_", "f_"):
        links = [make.link(f"{tag}{i}", make.inertial()) for i in (1, 2, 3)]
        chain = [("base", f"{tag}1"), (f"{tag}1", f"{tag}2"), (f"{tag}2", f"{tag}3")]
        parts += [*links, *(make.joint(f"{tag}j{child[-1]}", parent, child, **turn) for parent, child in chain)]
    eye = make.link("hand_camera_frame"), make.joint("eye", "link6", "hand_camera_frame", "fixed", xyz="0 0.05 0")
    with pytest.raises(UserError, match="it has 5 arms, and 6 joints beside them .*Choose --chain base:link6, --chain base:a_3"):
        imported(tmp_path, *parts, *six(), *eye)


def test_a_hand_with_a_thumb_of_three_joints_ends_the_arm(tmp_path):
    """The thumb is long enough for an arm, but two fingers of two joints stand beside it."""
    parts = []
    for name, y, count in (("thumb", -0.04, 3), ("index", 0.04, 2), ("middle", 0.02, 2)):
        above = "link6"
        for k in range(count):
            box = make.shape('<box size="0.01 0.01 0.03"/>', xyz="0 0 0.015")
            parts.append(make.link(f"{name}{k}", make.inertial(0.01), box))
            at = f"0 {y} 0.05" if k == 0 else "0 0 0.03"
            parts.append(make.joint(f"{name}_j{k}", above, f"{name}{k}", xyz=at, axis="1 0 0"))
            above = f"{name}{k}"
    _, report = imported(tmp_path, base(), *six(), *parts)
    assert report.robot.arm.joints == tuple(f"a{i}" for i in range(1, 7))


def test_two_short_arms_are_no_hand(tmp_path):
    """Two SCARAs of four joints on one stand have as few joints as fingers, but are as long as arms."""
    parts = [base()]
    for tag, y in (("upper_", 0.1), ("lower_", -0.1)):
        links = ["base", *(f"{tag}{k}" for k in range(4))]
        parts += [make.link(name, make.inertial(), make.shape('<box size="0.05 0.05 0.05"/>')) for name in links[1:]]
        at = [f"0 {y} 0.2", "0.2 0 0", "0.2 0 0", "0 0 0"]
        parts += [make.joint(f"{tag}j{k}", links[k], links[k + 1], xyz=at[k], axis="0 0 1") for k in range(4)]
    with pytest.raises(UserError, match="more than an arm: it has 2 arms. Choose --chain base:upper_3, --chain base:lower_3"):
        imported(tmp_path, *parts)


def test_fix_holds_joints_where_told(tmp_path):
    head = make.link("head", make.inertial()), make.joint("head_pan", "base", "head", xyz="0 0.2 0.3", axis="0 0 1", limit=ROOM)
    eye = make.link("eye"), make.joint("e", "head", "eye", "fixed", xyz="0.1 0 0")
    with pytest.raises(UserError, match=r"beside it \(head_pan\).*--chain base:link6.*--fix head_pan\[=VALUE\]"):
        imported(tmp_path, base(), *six(), *head, *eye)
    model, report = imported(tmp_path, base(), *six(), *head, *eye, fix={"head_pan": math.pi / 2})
    assert len(report.robot.arm.joints) == 6
    np.testing.assert_allclose(model.site("eye").pos, [0, 0.3, 0.3], atol=1e-9)


def test_fix_holds_followers_too(tmp_path):
    model, report = imported(tmp_path, base(), *six(), *fingers(tmp_path, "link6"), fix={"left": 0.02})
    assert model.njnt == 6 and report.robot.gripper.joints == ()
    at = [model.body("link6").id == model.site(f"{n}_finger").bodyid[0] for n in ("left", "right")]
    assert at == [True, True]
    np.testing.assert_allclose([model.site(f"{n}_finger").pos[1] for n in ("left", "right")], [0.02, -0.02], atol=1e-9)


def test_chain_and_fix_refuse_what_is_not_there(tmp_path):
    path = make.write(tmp_path / "in", make.robot(base(), *six()))
    every = [flag for i in range(1, 7) for flag in ("--fix", f"a{i}")]
    for argv, message in (
        (["--chain", "base"], "BASE:TIP"),
        (["--chain", "base:link9"], "link9.*did you mean"),
        (["--chain", "link3:link1"], "does not hang on link3"),
        (["--chain", "link6:link6"], "no joint moves"),
        (["--fix", "a9"], "a9.*choose from"),
        (["--fix", "a1=x"], "takes JOINT or JOINT=VALUE"),
        (["--fix", "a1=3.5"], "beyond its limits"),
        (every, "no joint is left"),
    ):
        with pytest.raises(UserError, match=message) as error:
            main([str(path), "--out", str(tmp_path / "out"), *argv])
        assert "\n" not in str(error.value) and not (tmp_path / "out").exists()


def test_pedestal_stands_on_the_floor_beside_the_table(tmp_path):
    """A column of 0.8 m below the base's frame: the floor is down there, and the drawn table begins in front of it."""
    column = make.shape('<box size="0.2 0.2 0.8"/>', xyz="0 0 -0.4")
    _, report = imported(tmp_path, base(column), *six())
    robot = report.robot
    assert robot.base_pos[2] == 0 and robot.floor == pytest.approx(-0.8, abs=1e-3)
    objects = scene.around(robot, scene.SceneCfg())
    assert objects.table_center[0] - objects.table_size[0] / 2 > 0.1  # not in the column
    model = scene.build(robot, objects, scene.SimCfg())
    assert model.geom("floor").pos[2] + model.geom("floor").size[2] == pytest.approx(-0.8, abs=2e-3)


def test_arm_on_a_stand_has_the_table_at_its_foot(tmp_path):
    """A stand of 0.5 m with its frame amid it, mounted so that it stands on the ground: not on the table, but beside it."""
    stand = make.link("stand", make.inertial(50), make.shape('<box size="0.2 0.2 0.5"/>'))
    world = make.link("world"), make.joint("fix", "world", "stand", "fixed", xyz="0 0 0.25")
    foot = make.joint("on", "stand", "base", "fixed", xyz="0 0 0.255")
    _, report = imported(tmp_path, *world, stand, foot, base(), *six())
    robot, note = report.robot, "\n".join(report.notes.of("robot", "arm"))
    assert robot.base_pos == pytest.approx((0, 0, -0.255)) and robot.floor == pytest.approx(-0.505, abs=1e-3)
    assert "a pedestal, on the floor beside the table, its top at the table's height" in note
    objects = scene.around(robot, scene.SceneCfg())
    model = scene.build(robot, objects, scene.SimCfg())
    assert objects.table_center[0] - objects.table_size[0] / 2 > 0.1  # not in the stand
    assert model.geom("floor").pos[2] + model.geom("floor").size[2] == pytest.approx(robot.floor, abs=2e-3)
    assert robot.workspace[2][0] + robot.base_pos[2] > 0.05


@pytest.mark.parametrize(("height", "kept"), [(0.5, True), (0.0, False), (3.0, False)])
def test_arm_that_hangs_does_so_in_reach_of_the_table(tmp_path, height, kept):
    """Upside down: its stand, which is then above it, is no pedestal; where it would hang too low or high it is moved."""
    column = make.shape('<box size="0.2 0.2 0.5"/>', xyz="0 0 -0.25")
    world = make.link("world"), make.joint("fix", "world", "base", "fixed", xyz=f"0 0 {height}", rpy="3.14159265 0 0")
    _, report = imported(tmp_path, *world, base(column), *six())
    robot, note = report.robot, "\n".join(report.notes.of("robot", "arm"))
    assert robot.floor == 0 and robot.base_pos[2] == (pytest.approx(height) if kept else pytest.approx(0.58, abs=0.1))
    assert "pedestal" not in note and "tilted by 180 degrees: it hangs from a plate" in note
    assert f"{robot.base_pos[2]:.2f} m above the table" in note and ("where that is in reach" in note) != kept
    model = scene.build(robot, scene.around(robot, scene.SceneCfg()), scene.SimCfg())
    assert model.geom("plate").pos[2] - model.geom("plate").size[2] == pytest.approx(robot.base_pos[2], abs=2e-3)
    assert robot.workspace and robot.workspace[2][0] + robot.base_pos[2] > 0.04


def test_tall_robot_has_the_table_below_its_shoulder(tmp_path):
    """A shoulder 1 m above the floor, an arm of about 0.8 m: the table is 0.3 arms lower, and the workspace above it."""
    _, report = imported(tmp_path, base(make.shape('<box size="0.3 0.3 0.9"/>', xyz="0 0 0.45")), *six(foot="0 0 1.0"))
    robot = report.robot
    assert robot.floor == pytest.approx(robot.base_pos[2]) and -0.9 < robot.floor < -0.6
    assert robot.workspace[2][0] + robot.base_pos[2] > 0.05


def test_camera_looks_at_where_the_arm_works(tmp_path):
    _, report = imported(tmp_path, base(), *six())
    objects = registry.env_cfg("reach", robot=tmp_path / "out").scene
    center = np.mean(report.robot.workspace, axis=1)
    # in the line from the base to the far end of the workspace, and far enough to see both
    assert np.linalg.norm(np.array(objects.look_at)[:2] - center[:2] / 2) < 0.2 and 0 < objects.look_at[2] < center[2] + 0.1
    assert objects.view_distance > np.linalg.norm(center)


def test_opening_and_pads_are_known(tmp_path):
    """Fingers 20 x 10 x 60 mm whose inner faces are 2 x 5 cm apart when open; the pads are their outer 40%."""
    imported(tmp_path, base(), *six(), *fingers(tmp_path, "link6"))
    robot = robot_file.read(tmp_path / "out")
    assert robot.opening == pytest.approx(0.10, abs=1e-3)
    np.testing.assert_allclose(robot.pad, [0.024, 0.02, 0.01], atol=2e-3)


def test_buffers_hold_the_worst_case(tmp_path):
    model, _ = imported(tmp_path, base(), *six(), *fingers(tmp_path, "link6"))
    sim = registry.env_cfg("reach", robot=tmp_path / "out").sim
    # nothing meets anything: limits of six joints and of the driving finger, and the coupling of two
    assert (sim.contacts_per_env, sim.constraints_per_env, sim.ls_iterations) == (1, 8, 6)
    robot = robot_file.read(tmp_path / "out")
    sim = contacts.sized(robot, scene.SceneCfg(), scene.SimCfg())
    model = scene.build(robot, scene.SceneCfg(), scene.SimCfg(), visuals=False)
    assert sim.contacts_per_env == sum(p.contacts for p in contacts.contact_pairs(model)) > 16  # two pads on a cube
    assert sim.ls_iterations == 50


def test_default_drives_do_not_overshoot(tmp_path):
    """At reach's physics step of 1/60 s; a finger that another follows by a soft coupling hardly does."""
    imported(tmp_path, base(), *six(), *fingers(tmp_path, "link6"))
    robot = robot_file.read(tmp_path / "out")
    model = tuning.drives_model(robot, scene.SimCfg(dt=1 / 60))
    for response in tuning.respond(model, robot.home, 0.05, seconds=3.0):
        assert response.overshoot < (0.03 if response.joint == "left" else 0.02), response.joint


def test_fingers_never_point_back_at_the_wrist(tmp_path):
    """The last link's frame lies 4 cm beyond the tips of the fingers, whose bodies begin behind it."""
    parts = [*six(), *fingers(tmp_path, "link6", at="0 0 -0.1")]
    parts[10] = parts[10].replace('<box size="0.05 0.05 0.08"/>', '<box size="0.05 0.05 0.02"/>')
    frames = [p.replace('xyz="0 0 0.05"', 'xyz="0 0 0.25"') if 'name="a6"' in p else p for p in parts]
    model, report = imported(tmp_path, base(), *frames)
    hand = np.zeros(3)
    mujoco.mju_rotVecQuat(hand, np.array([0.0, 0.0, 1.0]), np.array(report.robot.down))
    np.testing.assert_allclose(hand, [0, 0, -1], atol=1e-6)  # z, from the wrist to the tips
    assert report.robot.pick is not None
    assert model.site("ee").pos[2] == pytest.approx(-0.1 + 0.06 - 0.4 * 0.06 / 2, abs=2e-3)


def test_a_palm_ends_where_the_pads_begin(tmp_path):
    """A hull to plan with, 8 cm about the palm, reaches 2 cm beyond the tips, which are 16 cm from the flange."""
    hull = make.link("hull", make.shape('<sphere radius="0.08"/>', xyz="0 0 0.1"))
    weld = make.joint("h", "link6", "hull", "fixed", xyz="0 0 0")
    model, report = imported(tmp_path, base(), *six(), hull, weld, *fingers(tmp_path, "link6"))
    palm = model.geom("hull")
    assert any("reached beyond the fingers" in note for note in report.notes.of("link", "hull"))
    assert palm.type[0] == mujoco.mjtGeom.mjGEOM_BOX
    assert palm.pos[2] + palm.size[0] == pytest.approx(0.16 - 0.4 * 0.06, abs=2e-3)  # the pads are the outer 40%
    assert report.robot.pick is not None


def test_a_robot_without_masses_is_filled_with_water(tmp_path):
    """Its links are boxes of known size. A link that says its mass keeps it."""
    weightless = [
        p[: p.index("<inertial>")] + p[p.index("</inertial>") + 11 :] if "<inertial>" in p else p for p in [base(), *six()]
    ]
    _, report = imported(tmp_path / "none", *weightless)
    assert report.mass_read == 0 and report.mass == pytest.approx(1000 * (0.1**3 + 6 * 0.05 * 0.05 * 0.08), rel=0.03)
    _, report = imported(tmp_path / "some", base(), *weightless[1:])
    assert report.mass == pytest.approx(5 + 6 * 1000 * 0.05 * 0.05 * 0.08, rel=0.03)


def test_efforts_of_one_at_every_joint_are_none(tmp_path):
    ones = [p.replace('effort="80"', 'effort="1"') for p in six()]
    _, report = imported(tmp_path / "all", base(), *ones)
    robot = report.robot
    np.testing.assert_allclose(robot.arm.effort, np.array(robot.arm.stiffness) / 2, rtol=1e-4)
    one = [p.replace('effort="80"', 'effort="1"') if 'name="a6"' in p else p for p in six()]
    _, report = imported(tmp_path / "one", base(), *one)
    assert report.robot.arm.effort == (80.0,) * 5 + (1.0,)


@pytest.mark.parametrize("driven", [1, 4])
def test_a_hand_alone_is_no_arm(tmp_path, driven):
    parts = [base()]
    for side in ("left", "right"):
        above = "base"
        for k in range(driven):
            joint = make.joint(f"{side}_j{k}", above, f"{side}{k}", xyz="0 0 0.04", axis="0 1 0")
            parts += [make.link(f"{side}{k}", make.inertial(0.01)), joint]
            above = f"{side}{k}"
    with pytest.raises(UserError, match=f"is not an arm: 2 branches of at most {driven} driven joint.*Import it with an arm"):
        imported(tmp_path, *parts)


def test_an_upright_base_in_the_air_is_put_on_the_table(tmp_path):
    """Mounted 0.75 m up in its cell, of which nothing is drawn; hung from above it stays where it is."""
    for name, rpy, height in (("up", "0 0 1", 0.0), ("hung", "3.14159265 0 0", 0.75)):
        mount = make.link("world"), make.joint("m", "world", "base", "fixed", xyz="0 0 0.75", rpy=rpy)
        _, report = imported(tmp_path / name, *mount, base(), *six())
        assert report.robot.base_pos[2] == pytest.approx(height, abs=1e-3)


def test_the_workspace_lies_in_front_though_chance_leaves_cells_out(tmp_path, monkeypatch):
    """An arm that turns all round has as much room on every side, however few poses are drawn."""
    for seed in range(3):
        draw = np.random.default_rng
        monkeypatch.setattr(cloud, "SAMPLES", 3_000)
        monkeypatch.setattr(np.random, "default_rng", lambda _, seed=seed, draw=draw: draw(seed))
        _, report = imported(tmp_path / str(seed), base(), *six())
        monkeypatch.undo()
        assert report.robot.workspace[0][0] > 0.1 and report.robot.workspace[1][0] < 0 < report.robot.workspace[1][1]


def test_drives_overcome_the_joints_own_damping_and_friction(tmp_path):
    """Light wrists: alone they would get 400 times 0.01 to 0.02 kg m2, against which 20 N m s/rad creeps for seconds."""
    losses = '<dynamics damping="20" friction="1.5"/>'
    parts = [p.replace("</joint>", losses + "</joint>") if 'name="a6"' in p else p for p in six()]
    model, report = imported(tmp_path, base(), *parts)
    stiffness, damping = report.robot.arm.stiffness[5], report.robot.arm.damping[5]
    assert stiffness == pytest.approx(200)  # time constant 20 / 200 s
    assert damping == 0 and model.joint("a6").damping[0] == 20
    assert report.robot.arm.stiffness[4] < 50 and report.robot.arm.damping[4] > 0  # the others by their inertia
    stuck = [p.replace('damping="20"', 'damping="0"').replace('friction="1.5"', 'friction="3"') for p in parts]
    _, report = imported(tmp_path / "stuck", base(), *stuck)
    assert report.robot.arm.stiffness[5] == pytest.approx(3 / 0.01)


def test_pads_lie_along_the_tools_axis(tmp_path):
    """A tool's frame half a radian off where the fingers seem to point: the pads are fitted along its axis."""
    tool = make.link("my_tcp"), make.joint("t", "link6", "my_tcp", "fixed", xyz="0 0 0.148", rpy="0 0.5 0")
    model, report = imported(tmp_path, base(), *six(), *fingers(tmp_path, "link6"), *tool)
    for name in ("left_finger_pad", "right_finger_pad"):
        along = np.zeros(3)
        mujoco.mju_rotVecQuat(along, np.array([1.0, 0.0, 0.0]), model.geom(name).quat)  # the first axis of a pad's box
        np.testing.assert_allclose(along, [math.sin(0.5), 0, math.cos(0.5)], atol=1e-6)
    assert report.robot.opening == pytest.approx(0.1, abs=2e-3)
