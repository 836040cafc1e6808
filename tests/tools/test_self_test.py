"""The self-test that an import ends with: what it says of a robot that works, and of those that do not."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import urdf_files as make

from mjx_nero import __main__
from mjx_nero.control.pick_place import PHASES
from mjx_nero.errors import UserError
from mjx_nero.sim import robot_file, touch
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tools import motion
from mjx_nero.tools.self_test import checks, result

LIST = (40, 30, 10, 20, 30, 80, 30, 20, 30, 10)  # control steps of the phases


@pytest.fixture(scope="module")
def imported(tmp_path_factory) -> tuple[Path, str]:
    """The folder of an arm with two fingers, and what the command said."""
    folder = tmp_path_factory.mktemp("arm")
    path = make.write(folder / "in", make.robot(make.base(), *make.six(), *make.fingers(folder, "link6")))
    with pytest.MonkeyPatch.context() as patch:
        said: list[str] = []
        patch.setattr("mjx_nero.runs.console.line", lambda screen, text, style="": said.append(text))
        __main__.main(["import-urdf", str(path), "--out", str(folder / "out")])
    return folder / "out", "\n".join(said)


@pytest.fixture
def robot(imported) -> RobotCfg:
    return robot_file.read(imported[0])


def test_import_ends_with_it(imported):
    folder, said = imported
    line = next(text for text in said.splitlines() if text.startswith("self-test: "))
    assert line == (
        "self-test: the gripper opens and closes; home touches nothing; "
        "the script grasps the cube in 8 of 8 tries and places it in 8"
    )
    report = json.loads((folder / "report.json").read_text())
    assert report["self_test"]["line"] == line and report["self_test"]["passed"] is True
    assert report["self_test"]["good"] == report["self_test"]["tries"] == 8 and report["links"] and report["files"]


def test_inspect_repeats_it(imported, capsys, tmp_path):
    out = tmp_path / "all.json"
    __main__.main(["inspect", "--robot", str(imported[0]), "--json", str(out)])
    assert "the script grasps the cube in 8 of 8 tries" in " ".join(capsys.readouterr().out.split())
    assert json.loads(out.read_text())["self_test"]["passed"] is True
    __main__.main(["inspect", str(imported[0]), "--no-self-test"])
    assert "self-test" not in capsys.readouterr().out


def test_an_import_over_another_replaces_its_result(imported, tmp_path):
    """The report changes, and is still what an import has written."""
    path = make.write(tmp_path / "in", make.arm(3))
    for flags in (["--no-self-test"], ["--force", "--no-self-test"]):
        __main__.main(["import-urdf", str(path), "--out", str(tmp_path / "out"), *flags])
    assert "self_test" not in json.loads((tmp_path / "out" / "report.json").read_text())


def test_without_a_gripper_it_reaches(tmp_path):
    path = make.write(tmp_path / "in", make.robot(make.base(), *make.six()))
    __main__.main(["import-urdf", str(path), "--out", str(tmp_path / "out")])
    found = json.loads((tmp_path / "out" / "report.json").read_text())["self_test"]
    assert (found["script"], found["good"], found["tries"], found["reason"]) == ("reach", 8, 8, "")
    assert found["line"] == "self-test: home touches nothing; the arm reaches 8 of 8 points of its workspace"


def test_gripper_that_stops(robot):
    """A drive of 0.1 mN moves fingers of 50 g by millimetres."""
    weak = dataclasses.replace(robot.gripper, effort=(1e-4,))
    said = checks._gripper(dataclasses.replace(robot, gripper=weak))
    assert said.startswith("the gripper stops at ") and " of 0.01 " in said and "at its effort limit" in said
    lazy = dataclasses.replace(robot.gripper, damping=(1e4,), effort=(1e4,))
    assert "its drive lags by" in checks._gripper(dataclasses.replace(robot, gripper=lazy))
    slow = dataclasses.replace(robot.gripper, speed=(1e-9,))
    assert "speed" in checks._gripper(dataclasses.replace(robot, gripper=slow))
    assert checks._gripper(robot) == ""
    with pytest.raises(UserError, match="dt"):
        checks._gripper(dataclasses.replace(robot, max_step=1e-12))


def test_less_than_half_a_millimetre_of_a_fingers_way_is_no_fault(robot, monkeypatch):
    def said(end):
        moves = [motion.Move("left", 0.01, 0.0, end, time=None, fastest=0.1, saturation=0.0)]
        monkeypatch.setattr(motion, "gripper_moves", lambda robot, sim: moves)
        return checks._gripper(robot)

    assert said(0.0004) == "" and said(0.0006).startswith("the gripper stops at 0.0006 of 0 ")


def test_home_that_touches(robot):
    assert checks._home(robot) == ""
    low = dataclasses.replace(robot, arm=dataclasses.replace(robot.arm, home=(0.0, 2.0, 0.0, 0.0, 0.0, 0.0)))
    assert "'left_finger' touches the table" in checks._home(low) and checks._home(low).endswith("look at home")
    folded = dataclasses.replace(robot, arm=dataclasses.replace(robot.arm, home=(0.0, 0.0, 2.9, 0.0, 1.5, 0.0)))
    assert touch.at_home(folded)["link2", "link6"] > 0.03 and "'link2' lies 33 mm within 'link6'" in checks._home(folded)


def test_robot_without_opening_says_what_to_give(robot):
    tried = checks._tried(dataclasses.replace(robot, opening=0.0), checks.TRIES)
    assert tried["script"] == "reach" and tried["good"] == 8 and "opens is unknown: give opening" in tried["reason"]


def test_arm_of_too_many_joints_is_not_tried(robot):
    long = dataclasses.replace(robot.arm, joints=tuple(f"j{i}" for i in range(checks.MOST_JOINTS + 1)))
    tried = checks._tried(dataclasses.replace(robot, arm=long), checks.TRIES)
    assert tried["tries"] == 0 and "no try" in tried["reason"]


def test_tries_that_fail(robot):
    """Whose robot.yaml puts the lowest height to grasp at 6 cm above the right one: it closes on nothing."""
    x, y, (low, high) = robot.pick
    tried = checks._tried(dataclasses.replace(robot, pick=(x, y, (low + 0.06, high + 0.06))), checks.TRIES)
    assert tried["good"] == 0 and tried["failures"] == {"close": checks.TRIES} and tried["reason"] == checks.SEEN["close"]


def seen(phase: str) -> dict[str, np.ndarray]:
    """What is watched of a try that fails in a phase."""
    ends, n = np.cumsum(LIST) - 1, sum(LIST)
    out = {"away": np.zeros(n), "cube": np.zeros((n, 3)), "apart": np.full(n, 0.5), "held": np.zeros(n, bool)}
    grasped = slice(ends[3], ends[6] + 1)
    if phase in ("above pick", "down"):
        out["away"][ends[0] if phase == "above pick" else ends[2]] = 0.034
    elif phase == "pushed":
        out["cube"][ends[1] :, 0] = 0.02
    elif phase == "close":
        out["apart"][ends[2] :] = 0.0
    elif phase == "across":
        out["held"][ends[3] : ends[4]] = True
    elif phase == "place":
        out["held"][grasped] = True
    return out


@pytest.mark.parametrize(
    ("phase", "named", "text"),
    [
        ("above pick", "above pick", "34 mm from its place over the cube: look at pick and home"),
        ("down", "down", "34 mm from the cube"),
        ("pushed", "down", "pushes the cube away"),
        ("close", "close", "close beside the cube"),
        ("up", "up", "slips out"),
        ("across", "across", "lost on its way"),
        ("place", "place", "does not stay where it belongs"),
    ],
)
def test_phase_of_a_failure(phase, named, text):
    tried = seen(phase)
    found, said = checks._failure(tried, np.cumsum(LIST) - 1, bool(tried["held"].any()))
    assert found == named and text in said and len(LIST) == len(PHASES)


def test_line_says_all():
    found = result.Result("", "", "pick_place", 8, 3, 2, {"down": 5, "place": 1}, "look at pick", True, 1.0)
    assert not found.passed and found.line == (
        "self-test: the gripper opens and closes; home touches nothing; the script grasps the cube in 3 of 8 tries and places it "
        "in 2; 5 fail at 'down', 1 fails at 'place'; look at pick"
    )
