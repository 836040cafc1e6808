"""Logs of real runs become episodes: rows by hand, and what is wrong with a log."""

import numpy as np
import pytest

from mjx_nero.data import episode as names
from mjx_nero.data import open_dataset
from mjx_nero.tasks import registry
from mjx_nero.tools.demos import logs

JOINTS = registry.robot("so_arm101").joints


def table(rows: list[tuple]) -> str:
    """Rows of (time, targets or None, positions or None, whether the policy acted, fault)."""
    head = ["time", *(f"{what}.{j}" for what in ("target", "position", "velocity") for j in JOINTS)]
    head += ["inferring", "inferred", "limited", "held", "action.0"]
    lines = ["# so101_reach on so101", ",".join(head)]
    for time, told, at, acted, held in rows:
        cells = [str(time)]
        for values in (told, at, None):
            cells += [""] * len(JOINTS) if values is None else [str(values)] * len(JOINTS)
        lines.append(",".join([*cells, *(["0.1", "0.2"] if acted else ["", ""]), "", held, "0.5" if acted else ""]))
    return "\n".join(lines) + "\n"


ROWS = [
    (0.0, 0.1, None, False, ""),  # in force at the beginning
    (0.01, None, 0.11, False, ""),
    (0.02, 0.2, None, False, ""),  # on the way home: no policy acted
    (0.03, None, 0.12, False, ""),
    (0.04, 0.3, None, True, ""),
    (0.05, None, 0.13, False, ""),
    (0.06, None, 0.14, False, ""),
    (0.073, 0.4, None, True, ""),
    (0.08, None, 0.15, False, ""),
    (0.106, 0.5, None, True, ""),
    (0.11, 0.5, None, True, "stop"),  # it holds from here on
    (0.15, 0.6, None, True, ""),
]


def test_steps_by_hand(tmp_path):
    path = tmp_path / "log.csv"
    path.write_text(table(ROWS) + "0.2,0.7")  # killed as it wrote
    at, told, dt = logs.steps(path, JOINTS)
    np.testing.assert_allclose(at[:, 0], [0.12, 0.14, 0.15])
    np.testing.assert_allclose(told[:, 5], [0.3, 0.4, 0.5])
    assert dt == pytest.approx(0.033)


def test_logs_become_a_data_set_once(call, tmp_path):
    """Degrees, and the gripper from 0 to 100, as LeRobot's own SO-101 has them."""
    for i, shift in enumerate((0.0, 0.001)):
        rows = [(t, a and a + shift, b and b + shift, c, d) for t, a, b, c, d in ROWS]
        (tmp_path / f"log{i}.csv").write_text(table(rows))
    argv = ["demos", "--env", "so101_reach", "--form", "arrays", "--out", "real"]
    code, out, err = call("mjx_nero", *argv, "--log", "log0.csv")
    assert code == 0 and "real: 1 episodes, 3 steps; 1 new, from 1 logs" in out, err
    code, out, err = call("mjx_nero", *argv, "--log", "log0.csv", "--log", "log1.csv")
    assert code == 0 and "real: 2 episodes, 6 steps; 1 new, from 2 logs" in out, err
    found = open_dataset(tmp_path / "real")
    assert found.schema.robot == "so101_follower" and found.schema.features["action"].units == ("deg",) * 5 + ("%",)
    assert set(found.schema.features) == {names.STATE, names.ACTION, names.EXECUTED, names.DONE}
    np.testing.assert_allclose(found.column("action")[:3, 0], np.degrees([0.3, 0.4, 0.5]), rtol=1e-5)
    assert found.column(names.DONE)[:, 0].tolist() == [False, False, True] * 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "needs exactly one column time"),
        (table(ROWS).replace("target.wrist_roll", "torque.wrist_roll"), "needs exactly one column target.wrist_roll"),
        (table(ROWS).replace("target.wrist_roll", "target.wrist"), "has columns of 'wrist', which so_arm101 lacks: pass"),
        (table(ROWS[:4]), "has 0 policy steps, and an episode needs two: give a log of 'deploy --log'"),
        (table(ROWS).replace("0.4,0.4", "0.4,nan"), "log.csv line 10 takes a number up to 10000, got 'nan'"),
        (table(ROWS).replace("0.4,0.4", "0.4,", 1), "log.csv line 10 takes a number up to 10000, got ''"),
        (table(ROWS).replace("0.06,,", "0.06,"), "line 9 has"),
        ("\x00", "needs exactly one column time"),
    ],
)
def test_what_is_wrong_with_a_log(text, message, call, tmp_path):
    (tmp_path / "log.csv").write_text(text)
    code, _, err = call("mjx_nero", "demos", "--env", "so101_reach", "--out", "real", "--log", "log.csv")
    assert code == 2 and message in err and err.count("\n") == 1
    assert not (tmp_path / "real").exists()
