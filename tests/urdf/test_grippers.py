"""How a gripper is measured: which shapes meet over its swing, where it points, how far it opens, and what it cannot know.

Each URDF here has the structure of a public robot whose gripper an earlier rule misread."""

import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import urdf_files as make
from urdf_files import SLIDE, base, fingers, six

from mjx_nero.sim import grasp, robot_file, scene
from mjx_nero.tools.import_urdf import main
from mjx_nero.types import UserError
from mjx_nero.urdf import Report, import_urdf


def imported(folder: Path, *parts: str, **options) -> tuple[mujoco.MjModel, Report]:
    report = import_urdf(make.write(folder / "in", make.robot(*parts)), folder / "out", **options)
    return scene.robot_model(robot_file.read(folder / "out")), report


def pointing(model: mujoco.MjModel, report: Report) -> tuple[np.ndarray, np.ndarray]:
    """Where the hand points and along what it opens [3], in the body of the grasp point."""
    site, turn, down = model.site(report.robot.ee_site), np.zeros(9), np.zeros(9)
    mujoco.mju_quat2Mat(turn, site.quat)
    mujoco.mju_quat2Mat(down, np.array(report.robot.down))
    local = turn.reshape(3, 3) @ down.reshape(3, 3).T
    return local @ [0.0, 0.0, -1.0], local @ [0.0, 1.0, 0.0]


def warned(report: Report, text: str) -> bool:
    return any(text in line for line in report.warnings)


def jaw(folder: Path, limit: str = 'lower="0" upper="1.9" effort="3" velocity="2"', kind: str = "revolute") -> list[str]:
    """A jaw that turns about y, 2 cm beside a fixed one: both 9 cm long along z, and closed at 0 they lie face to face.

    The fixed one belongs to a link with a motor, whose middle is far from where the two meet.
    """
    make.box(folder / "in" / "motor.stl", (-0.03, -0.02, 0.0), (0.03, 0.02, 0.05))
    make.box(folder / "in" / "fixed.stl", (-0.03, -0.01, 0.05), (-0.02, 0.01, 0.14))
    make.box(folder / "in" / "moving.stl", (-0.02, -0.01, 0.0), (-0.01, 0.01, 0.09))
    return [
        make.link("gripper_body", make.inertial(0.2), make.mesh("motor.stl"), make.mesh("fixed.stl")),
        make.joint("weld", "link6", "gripper_body", "fixed", xyz="0 0 0.02"),
        make.link("jaw", make.inertial(0.05), make.mesh("moving.stl")),
        make.joint("grip", "gripper_body", "jaw", kind, xyz="0 0 0.05", axis="0 1 0", limit=limit),
    ]


def test_a_jaw_that_swings_wide_points_along_the_fixed_one(tmp_path):
    """Over 109 degrees: the chord of its tip would be 54 degrees off where it meets the other."""
    model, report = imported(tmp_path, base(), *six(), *jaw(tmp_path))
    robot = report.robot
    assert robot.gripper.open == (1.9,) and robot.gripper.close == (0.0,)
    approach, opening = pointing(model, report)
    assert np.degrees(np.arccos(approach[2])) < 12 and abs(opening[0]) > np.cos(np.radians(12))
    assert 0.06 < robot.opening < 0.16 and robot.closed < 2e-3
    pad = model.geom("gripper_body_pad")
    assert 0.02 + 0.08 < pad.pos[2] < 0.02 + 0.14 and pad.pos[0] == pytest.approx(-0.025, abs=4e-3)


def test_the_fixed_jaw_of_a_long_link_is_where_the_other_one_meets_it(tmp_path):
    """The forearm itself, 30 cm long, ends in the jaw: its own middle is no place to grip."""
    parts = six()
    make.box(tmp_path / "in" / "arm.stl", (-0.03, -0.02, -0.3), (0.03, 0.02, 0.05))
    make.box(tmp_path / "in" / "tip.stl", (-0.03, -0.01, 0.05), (-0.02, 0.01, 0.14))
    make.box(tmp_path / "in" / "moving.stl", (-0.02, -0.01, 0.0), (-0.01, 0.01, 0.09))
    parts[-2] = make.link("link6", make.inertial(0.4), make.mesh("arm.stl"), make.mesh("tip.stl"))
    parts += [
        make.link("jaw", make.inertial(0.05), make.mesh("moving.stl")),
        make.joint(
            "gripper", "link6", "jaw", xyz="0 0 0.05", axis="0 1 0", limit='lower="0" upper="1.5" effort="3" velocity="2"'
        ),
    ]
    model, report = imported(tmp_path, base(), *parts)
    assert report.robot.gripper.open == (1.5,) and report.robot.gripper.close == (0.0,)
    assert 0.08 < model.geom("link6_pad").pos[2] < 0.14 and 0.08 < model.site("ee").pos[2] < 0.14
    assert pointing(model, report)[0][2] > np.cos(np.radians(12))


def test_the_fixed_jaw_may_be_a_link_of_its_own(tmp_path):
    """The jaw's joint hangs on the motor; the link that it closes on is welded to that beside it."""
    parts = jaw(tmp_path)
    parts[0] = make.link("gripper_body", make.inertial(0.2), make.mesh("motor.stl"))
    tooth = (
        make.link("tooth", make.inertial(0.02), make.mesh("fixed.stl")),
        make.joint("w", "gripper_body", "tooth", "fixed", xyz="0 0 0"),
    )
    model, report = imported(tmp_path, base(), *six(), *parts, *tooth)
    assert set(grasp.pads(model)) == {"jaw_pad", "tooth_pad"}
    assert report.robot.opening > 0.06


def test_massless_tip_frames_are_no_fingers(tmp_path):
    """Frames beyond the fingers, which joints carry, cross over: by them open and closed would be reversed."""
    tips = []
    for side, y in (("left", -0.2), ("right", 0.2)):
        follow = '<mimic joint="left" multiplier="0.01"/>'
        tips.append(make.link(f"{side}_tip"))
        tips.append(make.joint(f"{side}_end", f"{side}_finger", f"{side}_tip", xyz=f"0 {y} 0.1", axis="1 0 0", inner=follow))
    model, report = imported(tmp_path, base(), *six(), *fingers(tmp_path, "link6"), *tips)
    robot = report.robot
    assert robot.gripper.open == (0.05,) and robot.gripper.close == (0.01,)
    assert set(grasp.pads(model)) == {"left_finger_pad", "right_finger_pad"}
    assert robot.opening == pytest.approx(0.1, abs=1e-3) and robot.closed == pytest.approx(0.02, abs=1e-3)


def test_of_a_linkage_the_bodies_grip_that_meet(tmp_path):
    """Beside each finger hangs a bar, deeper in the tree, that parts as far but never comes near the other."""
    bars = []
    for side, y in (("left", 0.03), ("right", -0.03)):
        make.box(tmp_path / "in" / f"{side}_bar.stl", (-0.005, y - 0.005, 0), (0.005, y + 0.005, 0.03))
        follow = '<mimic joint="left" multiplier="0.01"/>'
        bars.append(make.link(f"{side}_bar", make.inertial(0.01), make.mesh(f"{side}_bar.stl")))
        bars.append(make.joint(f"{side}_pin", f"{side}_finger", f"{side}_bar", xyz="0 0 0", axis="1 0 0", inner=follow))
    model, report = imported(tmp_path, base(), *six(), *fingers(tmp_path, "link6"), *bars)
    assert set(grasp.pads(model)) == {"left_finger_pad", "right_finger_pad"}
    assert report.robot.opening == pytest.approx(0.1, abs=1e-3)


def test_pads_lie_face_to_face_where_they_hold_the_cube(tmp_path):
    """Fingers that each turn about a hinge: closed they are turned by 50 degrees against one another."""
    parts = []
    for side, sign in (("left", 1), ("right", -1)):
        make.box(tmp_path / "in" / f"{side}.stl", (-0.01, min(0, sign * 0.01), 0), (0.01, max(0, sign * 0.01), 0.1))
        limit = 'lower="-0.4" upper="0.8" effort="3" velocity="2"'
        inner = '<mimic joint="left"/>' if side == "right" else ""
        parts.append(make.link(f"{side}_finger", make.inertial(0.05), make.mesh(f"{side}.stl")))
        frame = {"xyz": f"0 {sign * 0.04} 0.05", "axis": f"{-sign} 0 0"}
        parts.append(make.joint(side, "link6", f"{side}_finger", limit=limit, inner=inner, **frame))
    model, report = imported(tmp_path, base(), *six(), *parts)
    robot = report.robot
    hand = grasp._Hand(robot)
    edge = grasp.edge(robot.opening, robot.pad, robot.closed)
    turned = {}
    for name, share in (("held", hand.share(edge)), ("closed", 0.0)):
        hand.move(share)
        faces = [hand.data.geom(i).xmat.reshape(3, 3) for i in hand.pads]
        turned[name] = np.degrees(np.arccos(np.abs(faces[0].T @ faces[1]).max(0).min()))
    assert robot.gripper.open == (0.8,) and turned["held"] < 4 < 20 < turned["closed"]
    hand.move(hand.share(edge))
    middle = np.mean([hand.data.geom(i).xpos for i in hand.pads], axis=0)
    np.testing.assert_allclose(hand.data.site(robot.ee_site).xpos, middle, atol=2e-3)


def test_closed_is_where_the_shapes_meet_though_limits_go_on(tmp_path):
    """Limits that let the jaw pass right through the fixed one."""
    model, report = imported(tmp_path, base(), *six(), *jaw(tmp_path, 'lower="-0.6" upper="1.2" effort="3" velocity="2"'))
    (open,), (close,) = report.robot.gripper.open, report.robot.gripper.close
    assert open == pytest.approx(1.2, abs=0.11) and abs(close) < 0.2
    assert report.robot.opening > 0.05 and report.robot.closed < 0.01


def test_a_jaw_without_limits_closes_where_its_shape_meets_another(tmp_path):
    limit = 'effort="3" velocity="2"'
    model, report = imported(tmp_path, base(), *six(), *jaw(tmp_path, limit, "continuous"))
    robot = report.robot
    assert robot.gripper.joints == ("grip",) and len(robot.arm.joints) == 6
    assert abs(robot.gripper.close[0]) < 0.2 and 0.8 < robot.gripper.open[0] < 1.8
    assert robot.opening > 0.045 and robot.closed < 0.01


def test_a_wrist_without_limits_is_no_jaw_but_may_be_named_one(tmp_path):
    turn = make.link("gripper", make.inertial(0.1), make.shape('<cylinder radius="0.03" length="0.06"/>', xyz="0 0 0.03"))
    joint = make.joint("roll", "link6", "gripper", "continuous", xyz="0 0 0.08", limit='effort="3" velocity="2"')
    _, report = imported(tmp_path, base(), *six(), turn, joint)
    assert report.robot.gripper.joints == ()
    assert "--gripper roll --open roll=VALUE --closed roll=VALUE" in " ".join(report.notes.of("robot", "arm"))


def test_a_jaw_without_limits_that_meets_nothing_is_said(tmp_path):
    turn = make.link("gripper", make.inertial(0.1), make.shape('<cylinder radius="0.03" length="0.06"/>', xyz="0 0 0.03"))
    joint = make.joint("roll", "link6", "gripper", "continuous", xyz="0 0 0.08", limit='effort="3" velocity="2"')
    _, report = imported(tmp_path, base(), *six(), turn, joint, gripper=["roll"])
    assert warned(report, "joint roll: it has no limits, and its link meets nothing")
    assert warned(report, "--open roll=VALUE and --closed roll=VALUE")


def test_an_opening_that_is_unknown_is_said_and_what_to_give(tmp_path):
    """Both fingers slide the same way: they never part."""
    parts = [p.replace('axis xyz="0 -1 0"', 'axis xyz="0 1 0"') for p in fingers(tmp_path, "link6")]
    _, report = imported(tmp_path, base(), *six(), *parts, gripper=["left"])
    assert report.robot.opening == 0 and report.robot.pick is None
    assert warned(report, "how far its gripper opens is unknown") and warned(
        report, "between left 0.01 and left 0.05 the pads on"
    )
    assert warned(report, "--open left=VALUE --closed left=VALUE") and warned(report, "--gripper names other joints")
    with pytest.raises(UserError, match="is unknown"):
        grasp.cube_for(report.robot)


def test_open_and_closed_may_be_given(tmp_path, capsys):
    path = make.write(tmp_path / "in", make.robot(base(), *six(), *fingers(tmp_path, "link6")))
    main([str(path), "--out", str(tmp_path / "out"), "--open", "left=0.03", "--closed", "left=0.02"])
    robot, report = robot_file.read(tmp_path / "out"), json.loads((tmp_path / "out" / "report.json").read_text())
    assert robot.gripper.open == (0.03,) and robot.gripper.close == (0.02,)
    assert robot.opening == pytest.approx(0.06, abs=1e-3) and robot.closed == pytest.approx(0.04, abs=1e-3)
    assert report["gap"] == {"open": robot.opening, "closed": robot.closed}
    assert "40 mm between its pads when closed, 60 mm when open" in capsys.readouterr().out.replace("\n", " ")
    _, report = imported(
        tmp_path / "swapped", base(), *six(), *fingers(tmp_path / "swapped", "link6"), open={"left": 0.01}, closed={"left": 0.05}
    )
    assert report.robot.pick is None and warned(report, "closing moves its pads apart")
    for argv, message in (
        (["--open", "lift=0.03"], "--open names joint 'lift'.*the gripper has left"),
        (["--closed", "right=0.03"], "--closed names joint 'right'.*the gripper has left"),
        (["--open", "left=x"], "--open left"),
        (["--open", "left=0.02", "--closed", "left=0.02"], "open and closed are the same"),
    ):
        with pytest.raises(UserError, match=message) as error:
            main([str(path), "--out", str(tmp_path / "none"), *argv])
        assert "\n" not in str(error.value) and not (tmp_path / "none").exists()


@pytest.mark.parametrize(("lower", "upper"), [(0.036, 0.075), (0.036, 0.0395)])
def test_the_cube_is_larger_than_the_closed_gripper(tmp_path, lower, upper):
    """Fingers that close to 72 mm: a cube of 82 mm where they open to 150; none where they open to 77."""
    parts = [p.replace('lower="0.01" upper="0.05"', f'lower="{lower}" upper="{upper}"') for p in fingers(tmp_path, "link6")]
    _, report = imported(tmp_path, base(), *six(), *parts)
    robot = report.robot
    assert robot.closed == pytest.approx(2 * lower, abs=1e-3)
    if upper > 0.05:
        assert grasp.cube_for(robot).size[0] == pytest.approx(0.082, abs=1e-3)
        assert not warned(report, "no cube fits")
    else:
        assert robot.pick is None and warned(report, "no cube fits between its fingers")
        with pytest.raises(UserError, match=r"closes to 0.072 m and opens to 0.079 m.*no cube fits"):
            grasp.cube_for(robot)


def test_edge_lies_between_closed_and_open():
    pad = (0.02, 0.02, 0.01)
    assert grasp.edge(0.1, pad) == grasp.edge(0.1, pad, 0.0) == pytest.approx(0.04)
    assert grasp.edge(0.1, pad, 0.035) == pytest.approx(0.045)
    assert grasp.edge(0.02, pad) == pytest.approx(0.012)
    assert grasp.edge(0.15, pad, 0.072) == pytest.approx(0.082)
    assert grasp.edge(0.08, pad, 0.072) == 0.0 and grasp.edge(0.0, pad) == 0.0
    for opening in np.linspace(0.005, 0.2, 40):
        for closed in np.linspace(0, 1, 9) * opening:
            edge = grasp.edge(opening, pad, closed)
            assert edge == 0 or closed < edge < opening


def test_two_slides_of_different_signs_each_find_their_ends(tmp_path):
    parts = fingers(tmp_path, "link6")
    parts[3] = make.joint(
        "right",
        "link6",
        "right_finger",
        xyz="0 0 0.1",
        axis="0 1 0",
        **{**SLIDE, "limit": 'lower="-0.05" upper="-0.01" effort="20" velocity="0.2"'},
    )
    _, report = imported(tmp_path, base(), *six(), *parts)
    gripper = report.robot.gripper
    assert gripper.open == (0.05, -0.05) and gripper.close == (0.01, -0.01)
    assert report.robot.opening == pytest.approx(0.1, abs=1e-3)


def test_slides_of_a_metre_open_as_far_as_the_hand_is_wide(tmp_path):
    """Limits of +-1 m are placeholders."""
    parts = fingers(tmp_path, "palm", at="0 0 0.05")
    for row, name, axis, lower, upper in ((2, "left", "0 1 0", 0, 1), (3, "right", "0 1 0", -1, 0)):
        metre = f'lower="{lower}" upper="{upper}" effort="20" velocity="0.2"'
        parts[row] = make.joint(name, "palm", f"{name}_finger", xyz="0 0 0.05", axis=axis, **{**SLIDE, "limit": metre})
    palm = make.link("palm", make.inertial(0.2), make.shape('<box size="0.04 0.12 0.04"/>', xyz="0 0 0.02"))
    on = make.joint("mount", "link6", "palm", "fixed", xyz="0 0 0.05")
    _, report = imported(tmp_path, base(), *six(), palm, on, *parts)
    assert report.robot.gripper.open == pytest.approx((0.055, -0.055), abs=2e-3)
    assert report.robot.opening == pytest.approx(0.11, abs=4e-3)
    assert sum("slides by 1 m" in text for text in report.warnings) == 2


def test_a_collision_that_lies_elsewhere_than_the_visual_of_the_same_mesh_is_moved_there(tmp_path):
    """The left finger's collision is turned by half a turn about the finger, so that its back would be its inner face."""

    models, said = {}, {}
    for turn in ("0 0 0", "0 0 3.1416"):
        folder, felt = tmp_path / str(len(models)), make.mesh("left.stl")
        parts = [*six(), *fingers(folder, "link6")]
        both = make.mesh("left.stl", "visual") + felt.replace('rpy="0 0 0"', f'rpy="{turn}"')
        imported(folder, base(), *(part.replace(felt, both) for part in parts))
        models[turn], said[turn] = (folder / "out" / "model.xml").read_text(), (folder / "out" / "report.json").read_text()
    one, other = said.values()
    text = "its collision is its visual's mesh, but elsewhere: moved to the visual"
    assert text not in one and other.count(text) == 1
    assert len(set(models.values())) == 1


def test_a_thumb_that_turns_across_the_palm_is_held_opposite_the_fingers(tmp_path):
    """At 0 it stands beside three fingers, after a quarter turn in front of them. Hands of fewer fingers stay as they are."""
    bend = 'lower="0" upper="1.4" effort="5" velocity="2"'
    bar = make.shape('<box size="0.016 0.016 0.07"/>', xyz="0 0 0.035")
    palm = [make.link("palm", make.inertial(0.2), make.shape('<box size="0.02 0.08 0.08"/>', xyz="0 0 0.04"))]
    palm.append(make.joint("mount", "link6", "palm", "fixed", xyz="0 0 0.2"))
    thumb = [
        make.link("turned", make.inertial(0.02), make.shape('<box size="0.01 0.01 0.01"/>', xyz="0 0.05 0")),
        make.joint("turn", "palm", "turned", xyz="0 0 0.02", limit='lower="-1.5708" upper="0" effort="5" velocity="2"'),
        make.link("thumb", make.inertial(0.02), make.shape('<box size="0.016 0.016 0.09"/>', xyz="0 0 0.045")),
        make.joint("bend", "turned", "thumb", xyz="0 0.06 0", axis="1 0 0", limit=bend),
    ]
    fingers = [
        part
        for k in range(3)
        for part in (
            make.link(f"f{k}", make.inertial(0.02), bar),
            make.joint(f"bend{k}", "palm", f"f{k}", xyz=f"0 {0.025 * (k - 1)} 0.085", axis="0 1 0", limit=bend),
        )
    ]
    _, report = imported(tmp_path, base(), *six(), *palm, *thumb, *fingers)
    assert set(report.robot.gripper.joints) == {"bend", "bend0", "bend1", "bend2"}
    found = re.search(r"turns the thumb: held at (-?[\d.]+), opposite the fingers", " ".join(report.notes.of("joint", "turn")))
    assert found and float(found[1]) < -np.pi / 4  # nearer to in front
    _, report = imported(tmp_path / "fewer", base(), *six(), *palm, *thumb, *fingers[:4])
    assert {"turn", "bend", "bend0", "bend1"} == set(report.robot.gripper.joints)
