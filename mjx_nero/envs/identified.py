"""Applies what ``identify`` measured on a real arm to a task: drive gains, ranges for randomization, and a delay."""

import dataclasses
import math
import pathlib
from collections.abc import Mapping
from typing import Any

from mjx_nero import files
from mjx_nero.config import values
from mjx_nero.config.bounds import LATEST
from mjx_nero.envs.task import EnvCfg
from mjx_nero.mdp import actions, randomization
from mjx_nero.mdp.terms import Term
from mjx_nero.types import UserError

DRIVE = ("stiffness", "damping", "armature", "friction")  # numbers of a joint, all above zero


@dataclasses.dataclass(frozen=True)
class Numbers:
    """A number with its 95% interval."""

    value: float
    low: float
    high: float


@dataclasses.dataclass(frozen=True)
class Joint:
    """The measured parameters of a joint's drive (see ``identify.plant.Drives``); ``deploy --check`` measures offsets alone."""

    offset: Numbers
    stiffness: Numbers | None = None
    damping: Numbers | None = None
    armature: Numbers | None = None
    friction: Numbers | None = None


@dataclasses.dataclass(frozen=True)
class Identified:
    """The content of an identification file; joints by name."""

    robot: str
    delay: Numbers
    joints: Mapping[str, Joint]


def read(path: pathlib.Path) -> Identified:
    """Reads an identification file. The file may be untrusted.

    Raises:
        UserError: the file is missing or malformed.
    """
    content = files.read_yaml(path)
    try:
        found = values.read(Identified, content, "")
    except UserError as error:
        raise UserError(f"{path}: {error}") from None
    for name, number in {"delay": found.delay, **_numbers(found)}.items():
        least, wanted = (math.ulp(0.0), "0 < low") if name.endswith(DRIVE) else (-1e6, "low")
        if not least <= number.low <= number.value <= number.high <= 1e6:
            raise UserError(
                f"{path}: {name} takes {wanted} <= value <= high up to 1e6, got {values.short(dataclasses.astuple(number))}"
            )
    return found


def _numbers(found: Identified) -> dict[str, Any]:
    return {
        f"joints.{j}.{f.name}": number
        for j, joint in found.joints.items()
        for f in dataclasses.fields(joint)
        if (number := getattr(joint, f.name)) is not None
    }


def applied(cfg: EnvCfg) -> EnvCfg:
    """Returns the task with the drives of its identification file.

    Estimates become the robot's gains. 95% intervals become ranges, drawn before all other randomization. The delay is rounded to
    whole control steps. Encoder offsets are not applied: the real arm subtracts them.

    Raises:
        UserError: the file is missing, malformed or for another robot.
    """
    if not cfg.identified:
        return cfg
    path = pathlib.Path(cfg.identified)
    found, arm = read(path), cfg.robot.arm
    if found.robot != cfg.robot.name or set(found.joints) != set(arm.joints):
        raise UserError(
            f"{path} is for {found.robot} with joints {', '.join(found.joints)}, but this task's robot is {cfg.robot.name}"
        )
    joints = [found.joints[name] for name in arm.joints]
    late = dataclasses.replace(cfg, actions=_late(cfg, found.delay))
    known = [n for n in DRIVE if all(getattr(j, n) is not None for j in joints)]
    if not known:
        return late
    if len(known) < len(DRIVE):
        raise UserError(f"{path} needs {', '.join(DRIVE)} of every joint, or of none")
    ranges = {n: tuple((getattr(j, n).low, getattr(j, n).high) for j in joints) for n in DRIVE}
    gains: dict[str, Any] = {n: tuple(getattr(j, n).value for j in joints) for n in ("stiffness", "damping")}
    return dataclasses.replace(
        late,
        robot=dataclasses.replace(cfg.robot, arm=dataclasses.replace(arm, **gains)),
        randomization={"identified": Term(randomization.drives, params={"joints": arm.joints, **ranges}), **cfg.randomization},
    )


def _late(cfg: EnvCfg, delay: Numbers) -> dict[str, Term]:
    """Adds the delay to the actions, in whole control steps, widening the task's own delay where needed."""
    dt, terms = cfg.sim.dt * cfg.sim.decimation, dict(cfg.actions)
    # Round to the nearest step, or take both neighbours where the interval lies between them.
    steps = max(0, math.floor(delay.low / dt + 0.25)), max(0, math.ceil(delay.high / dt - 0.25))
    if steps[1] > LATEST:
        raise UserError(
            f"{cfg.identified}: delay is up to {delay.high:g} s, {steps[1]:,} control steps: at most {LATEST} are simulated"
        )
    mine = next((name for name, term in terms.items() if term.func is actions.Delay), None)
    if mine is None:
        return {"delay": Term(actions.Delay, params={"steps": steps}), **terms} if steps[1] else terms
    low, high = terms[mine].params["steps"]
    wider = {**terms[mine].params, "steps": (min(low, steps[0]), max(high, steps[1]))}
    return {**terms, mine: dataclasses.replace(terms[mine], params=wider)}
