"""Episodes from logs of real runs (``deploy --log``), one per log, with the features of ``demos --holds arm``."""

import csv
import functools
import hashlib
import pathlib
from collections.abc import Sequence

import numpy as np

import mjx_nero
from mjx_nero.config.values import short
from mjx_nero.data import Episode, Schema, writer
from mjx_nero.data import episode as names
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.identify.log import number, numbered
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.tasks import registry
from mjx_nero.tools.demos import making
from mjx_nero.tools.demos.cfg import DemosCfg

MAX_BYTES = 256_000_000
_JITTER = 0.2  # share of a step by which a log may differ from the others


def write(cfg: DemosCfg, logs: Sequence[pathlib.Path], out: pathlib.Path) -> None:
    """Writes the logs that are not in the data set yet, one episode each.

    Raises:
        UserError: a log is damaged or from another arm, or the folder holds something else.
    """
    env = ManipulationEnv(registry.env_cfg(cfg.env_name, cfg.preset, cfg.robot), impl="native")
    shown, robot = making.units_of(env, cfg.units), env.cfg.robot
    read = [steps(path, robot.joints, robot) for path in logs]
    dt = float(np.median([step for _, _, step in read]))
    for path, (_, _, step) in zip(logs, read, strict=True):
        if abs(step - dt) > _JITTER * dt:
            raise UserError(
                f"{path} has a step of {1000 * step:.1f} ms, the others of {1000 * dt:.1f} ms: write it to another data set"
            )
    rate = 1 / env.dt if abs(dt - env.dt) < _JITTER * env.dt else round(1 / dt)
    kept = {name: each for name, each in making.features(env, shown, "joints").items() if name in making.ARM}
    about = {
        "env": cfg.env_name,
        "preset": cfg.preset,
        "robot": robot.name,
        "agent": "deploy",
        "holds": "arm",
        "actions": "joints",
        "units": shown.to_json(),
        "version": mjx_nero.__version__,
    }
    schema = Schema(rate, making.robot_type(robot.name, shown), cfg.task or making.sentence(cfg.env_name), kept, about)
    with writer(out, schema, cfg.form) as form:
        there = set(form.numbers.tolist())
        new = [
            made
            for path, (at, told, _) in zip(logs, read, strict=True)
            if (made := _episode(path, shown, at, told)).number not in there
        ]
        if new:
            form.put(new)
        count, frames = len(form.lengths), int(form.lengths.sum())
    print(f"{out}: {count} episodes, {frames} steps; {len(new)} new, from {len(logs)} logs")


def _episode(path: pathlib.Path, shown: making.units.Units, at: np.ndarray, told: np.ndarray) -> Episode:
    """Makes an episode of a log. Its number is a hash of its content, so that no log is added twice."""
    done = np.arange(len(at))[:, None] == len(at) - 1
    state, action = (shown.shown(x).astype(np.float32) for x in (at, told))
    number = int.from_bytes(hashlib.sha256(at.tobytes() + told.tobytes()).digest()[:6], "big")
    arrays = {names.STATE: state, names.ACTION: action, names.EXECUTED: action, names.DONE: done}
    return Episode(arrays, True, number)


def steps(path: pathlib.Path, joints: Sequence[str], robot: RobotCfg | None = None) -> tuple[np.ndarray, np.ndarray, float]:
    """Reads the joint positions before each policy step and the drives' targets in it, up to the first fault.

    Args:
        robot: the robot whose log it must be; None: any with these joints.

    Returns:
        positions and targets [steps, joints] [rad or m], and the length of a step [s].

    Raises:
        UserError: the file is not a log of these joints, or the policy made fewer than two steps in it.
    """
    at: list[float] | None = None
    rows: list[tuple[float, list[float], list[float]]] = []
    for line, cells in _table(path, joints, robot):
        read = functools.partial(number, where=f"{path} line {line}", empty=False)
        if cells["position." + joints[0]]:
            at = [read(cells[f"position.{joint}"]) for joint in joints]
        if cells.get("held"):
            break
        if cells["target." + joints[0]] and cells.get("inferred") and at is not None:
            rows.append((read(cells["time"]), at, [read(cells[f"target.{joint}"]) for joint in joints]))
    if len(rows) < 2:
        raise UserError(f"{path} has {len(rows)} policy steps, and an episode needs two: give a log of 'deploy --log'")
    times, positions, targets = (np.array(column) for column in zip(*rows, strict=True))
    return positions, targets, float(np.median(np.diff(times)))


def _table(path: pathlib.Path, joints: Sequence[str], robot: RobotCfg | None) -> list[tuple[int, dict[str, str]]]:
    """Returns the rows of a log, each with its line number, by column name."""
    lines = numbered(path, MAX_BYTES, robot)
    rows = list(csv.reader(line for _, line in lines))
    head = rows[0] if rows else []
    for name in ["time", "inferred", *(f"{what}.{joint}" for what in ("target", "position") for joint in joints)]:
        if head.count(name) != 1:
            raise UserError(f"{path} needs exactly one column {name}: its first line is {short(','.join(head))}")
    out = []
    for (line, _), cells in zip(lines[1:], rows[1:], strict=True):
        if len(cells) != len(head):
            if line == lines[-1][0]:
                break  # the program was killed while it wrote this line
            raise UserError(f"{path} line {line} has {len(cells)} cells, the first line {len(head)}")
        out.append((line, dict(zip(head, cells, strict=True))))
    return out
