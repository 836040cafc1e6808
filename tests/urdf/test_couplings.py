"""Joints that move together: couplings outside of <mimic>, followers without limits, fingers that stay behind."""

from pathlib import Path

import pytest
import urdf_files as make

from mjx_nero.types import UserError
from mjx_nero.urdf import Report, import_urdf

PLUGIN = (
    '<gazebo><plugin name="m" filename="libroboticsgroup_gazebo_mimic_joint_plugin.so"><joint>{0}</joint>'
    "<mimicJoint>{1}</mimicJoint><multiplier>{2}</multiplier><offset>0.0</offset></plugin></gazebo>"
)
CONTROL = (
    '<ros2_control name="r" type="system"><joint name="{1}"><param name="mimic">{0}</param>'
    '<param name="multiplier">{2}</param></joint></ros2_control>'
)
TRANSMISSION = CONTROL.replace("ros2_control", "transmission")
OWN = '<mimic joint="left"/>'


def two_fingers(folder: Path, *more: str, own: str = "", limit: str = "") -> str:
    """Six joints, then two slides ``left`` and ``right``; ``own``: what the second one's joint holds, beside its ``limit``."""
    parts = make.fingers(folder, "link6")
    wide = f"<limit {make.SLIDE['limit']}/>"
    right = parts[3].replace(OWN, own).replace(wide, f"<limit {limit}/>" if limit else "" if own else wide)
    return make.robot(make.base(), *make.six(), *parts[:3], right, *more)


def imported(folder: Path, text: str, **options) -> Report:
    return import_urdf(make.write(folder / "in", text), folder / "out", **options)


@pytest.mark.parametrize("stated", [PLUGIN, CONTROL, TRANSMISSION], ids=["gazebo", "ros2_control", "transmission"])
def test_couplings_outside_of_mimic(tmp_path, stated):
    report = imported(tmp_path, two_fingers(tmp_path, stated.format("left", "right", "1.0")))
    assert report.robot.gripper.joints == ("left",) and report.robot.opening == pytest.approx(0.1, abs=1e-3)
    assert report.joints["right"]["mimic"] == {"joint": "left", "multiplier": 1.0, "offset": 0.0}
    assert any("read as its <mimic>" in note for note in report.notes.of("joint", "right")) and not report.warnings


def test_without_them_both_fingers_are_driven(tmp_path):
    assert imported(tmp_path, two_fingers(tmp_path)).robot.gripper.joints == ("left", "right")


@pytest.mark.parametrize(
    ("stated", "own", "said"),
    [
        (PLUGIN.format("right", "left", "1"), OWN, "which follows it: left out"),  # the other way round than the URDF
        (PLUGIN.format("right", "right", "1"), "", "which follows it: left out"),
        (PLUGIN.format("lefd", "right", "1"), "", "which is not there: left out"),
        (PLUGIN.format("left", "right", "3"), OWN, ""),  # the URDF's own goes first
        (PLUGIN.format("left", "rigth", "1"), OWN, ""),  # of another simulator's joint
    ],
)
def test_couplings_that_do_not_fit_are_left_out(tmp_path, stated, own, said):
    report = imported(tmp_path, two_fingers(tmp_path, stated, own=own, limit=make.SLIDE["limit"]))
    follows = {name: row["mimic"] for name, row in report.joints.items() if "mimic" in row}
    assert follows == ({"right": {"joint": "left", "multiplier": 1.0, "offset": 0.0}} if own else {})
    assert not said or any(said in note.text for note in report.notes)


def test_a_ring_of_couplings_is_cut(tmp_path):
    ring = (PLUGIN.format(a, b, "1") for a, b in (("left", "right"), ("right", "a6"), ("a6", "left")))
    report = imported(tmp_path, two_fingers(tmp_path, *ring))
    assert {name for name, row in report.joints.items() if "mimic" in row} == {"right", "a6"}


def test_a_factor_that_is_no_number_ends_in_one_line(tmp_path):
    with pytest.raises(UserError, match="joint 'right': mimic multiplier='two' is not numbers") as error:
        imported(tmp_path, two_fingers(tmp_path, PLUGIN.format("left", "right", "two")))
    assert "\n" not in str(error.value) and not (tmp_path / "out").exists()


@pytest.mark.parametrize("limit", ["", 'effort="5" velocity="1"', 'lower="0" upper="0"'], ids=["none", "no range", "empty range"])
def test_a_follower_needs_no_limits(tmp_path, limit):
    report = imported(tmp_path, two_fingers(tmp_path, own='<mimic joint="left" multiplier="0.5" offset="0.01"/>', limit=limit))
    assert report.joints["right"]["limits"] == pytest.approx([0.015, 0.035]) and not report.warnings


def test_a_finger_that_stays_behind_is_named(tmp_path):
    report = imported(tmp_path, two_fingers(tmp_path), gripper=["left"])
    (warning,) = (text for text in report.warnings if "twin" in text)
    assert warning.startswith("joint right: held still while its twin 'left' moves")
    assert '<mimic joint="left"/>' in warning and "--gripper left,right" in warning


def test_what_is_no_twin_is_not_named(tmp_path):
    """A horn that turns beside two coupled slides is held still, and no finger."""
    horn = make.link("horn", make.inertial(0.01), make.shape('<box size="0.03 0.005 0.005"/>'))
    spin = make.joint("turner", "link6", "horn", xyz="0 0 0.05", axis="0 0 1", limit=make.ROOM)
    report = imported(tmp_path, two_fingers(tmp_path, horn, spin, own=OWN))
    assert report.joints["turner"]["merged"] and not report.warnings
