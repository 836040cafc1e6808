"""The log of an arm: targets of its drives, and readings of their encoders, in a table that any program can write:

    time,target.joint1,target.joint2,position.joint1,position.joint2
    0.000,0.1,0.5,0.1002,0.4997
    0.005,,,0.1001,0.4998

``time`` [s] ascends. At the time of a row its targets [rad or m] were sent and its positions [rad or m] were read; either may be
empty. The first row has targets. Lines that begin with # are comments; ``# robot: NAME`` says whose log it is.
"""

import dataclasses
import math
import pathlib
from collections.abc import Sequence

import numpy as np

from mjx_nero import files
from mjx_nero.config.values import hint, short
from mjx_nero.errors import UserError
from mjx_nero.sim.robot import RobotCfg

MAX_BYTES, MAX_ROWS = 64_000_000, 500_000
ROBOT = "robot: "  # begins the comment that names the robot
_LARGEST = 1e4  # largest number in a log: an arm's angles, metres and seconds are smaller
SHORTEST, FEWEST = 10.0, 500  # minimum length [s] and number of readings


@dataclasses.dataclass(frozen=True)
class Log:
    """Targets and readings of an arm's joints.

    Attributes:
        sent: times of the targets [m] [s].
        targets: [m, n] [rad or m].
        times: times of the readings [k] [s].
        positions: [k, n] [rad or m].
    """

    sent: np.ndarray
    targets: np.ndarray
    times: np.ndarray
    positions: np.ndarray


def write(path: pathlib.Path, log: Log, joints: Sequence[str], notes: Sequence[str] = ()) -> None:
    """Writes a log.

    Raises:
        UserError: it cannot be written.
    """
    rows: dict[float, list[str]] = {}
    for times, values, first in ((log.sent, log.targets, 0), (log.times, log.positions, len(joints))):
        for time, value in zip(np.round(times, 6).tolist(), values.tolist(), strict=True):
            row = rows.setdefault(time, [""] * (2 * len(joints)))
            row[first : first + len(joints)] = [f"{x:.7g}" for x in value]
    head = ["time", *(f"target.{j}" for j in joints), *(f"position.{j}" for j in joints)]
    lines = [*(f"# {note}" for note in notes), ",".join(head)]
    lines += [",".join([f"{time:.6f}".rstrip("0").rstrip("."), *rows[time]]) for time in sorted(rows)]
    files.write(path, ("\n".join(lines) + "\n").encode())


def read(
    path: pathlib.Path,
    joints: Sequence[str],
    shortest: float = SHORTEST,
    fewest: int = FEWEST,
    robot: RobotCfg | None = None,
) -> Log:
    """Reads a log of a robot's arm. The file is not trusted.

    Args:
        joints: names of the arm's joints, in the order of the result; the file may have another order.
        shortest, fewest: minimum length of the log [s], and minimum number of readings.
        robot: the robot whose log it must be; None: any with these joints.

    Raises:
        UserError: the file does not exist, is too large, or is not a log of these joints; the message names the line.
    """
    lines = numbered(path, MAX_BYTES, robot)
    if len(lines) > MAX_ROWS:
        raise UserError(f"{path} has {len(lines):,} rows, but at most {MAX_ROWS:,} are read: give a shorter log")
    head = [name.strip() for name in lines[0][1].split(",")] if lines else []
    wanted = ["time", *(f"target.{j}" for j in joints), *(f"position.{j}" for j in joints)]
    for name in wanted:
        if head.count(name) != 1:
            raise UserError(
                f"{path} needs exactly one column {name}{hint(name, head)}: its first line is {short(','.join(head))}"
            )
    columns, n, rows = [head.index(name) for name in wanted], len(joints), []
    for i, line in lines[1:]:
        cells = line.split(",")
        if len(cells) != len(head):
            raise UserError(f"{path} line {i} has {len(cells)} cells, the first line {len(head)}")
        row = [number(cells[c], f"{path} line {i} {head[c]}") for c in columns]
        for part in (row[1 : n + 1], row[n + 1 :]):
            if 0 < sum(map(math.isnan, part)) < n:
                raise UserError(f"{path} line {i} has values for some joints and not for others: give all or none")
        rows.append(row)
    table = np.array(rows, float).reshape(-1, 2 * n + 1)
    if not len(table) or np.isnan(table[:, 0]).any() or (np.diff(table[:, 0]) <= 0).any():
        raise UserError(f"{path}: every row needs a time, and times must ascend")
    told, seen = ~np.isnan(table[:, 1]), ~np.isnan(table[:, n + 1])
    if not told[0]:
        raise UserError(f"{path}: the first row needs the targets in effect at its beginning")
    log = Log(table[told, 0], table[told, 1 : n + 1], table[seen, 0], table[seen, n + 1 :])
    if len(log.times) < fewest or log.times[-1] - log.times[0] < shortest:
        raise UserError(f"{path} has {len(log.times)} readings: {fewest} or more over {shortest:g} s or more are needed")
    if table[-1, 0] - table[0, 0] > 3600:
        raise UserError(f"{path} is longer than an hour: a minute is enough")
    return log


def numbered(path: pathlib.Path, limit: int, robot: RobotCfg | None = None) -> list[tuple[int, str]]:
    """Reads the lines of a log that are neither empty nor comments, each with its line number.

    Raises:
        UserError: the file does not exist, is larger than ``limit`` bytes, is not text, or is the log of another robot.
    """
    try:
        text = files.read_bytes(path, limit).decode()
    except UnicodeDecodeError:
        raise UserError(f"{path} is not text: a log is a comma-separated table of numbers") from None
    lines = [(i, line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
    table = [(i, line) for i, line in lines if not line.startswith("#")]
    if robot and table:
        _check_robot(path, robot, [line[1:].strip() for _, line in lines if line.startswith("#")], table[0][1])
    return table


def _check_robot(path: pathlib.Path, robot: RobotCfg, notes: Sequence[str], head: str) -> None:
    """Raises ``UserError`` if a log's comments name another robot, or its columns joints that the robot lacks."""
    named = next((note.removeprefix(ROBOT) for note in notes if note.startswith(ROBOT)), robot.name)
    if named != robot.name:
        raise UserError(f"{path} is a log of {short(named)}, but the robot is {robot.name}: pass the log's own --robot")
    columns = [column.strip().partition(".") for column in head.split(",")]
    if others := sorted({name for what, _, name in columns if what in ("target", "position")} - set(robot.joints)):
        raise UserError(f"{path} has columns of {short(', '.join(others))}, which {robot.name} lacks: pass the log's own --robot")


def number(text: str, where: str, empty: bool = True) -> float:
    """Reads a cell; NaN if it is empty.

    Args:
        where: names the cell in messages.
        empty: whether it may be empty.

    Raises:
        UserError: the cell holds something else, or too large a number.
    """
    text = text.strip().strip('"')
    if not text and empty:
        return math.nan
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not abs(value) <= _LARGEST:
        raise UserError(f"{where} takes a number up to {_LARGEST:g}, got {short(text)}")
    return value
