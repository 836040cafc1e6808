"""Proposes gains for all drives of a robot.

The gains of each drive are chosen as follows:

- Inertia: the diagonal of the joint-space inertia matrix (armature included) over random poses within the joint limits, at the
  95th percentile of the poses. A joint moves this inertia while the other drives hold their joints. While the others swing
  freely, it moves less (the inverse of the inverse's diagonal), so damping for the former is always enough.
- Stiffness: the largest value that two limits allow. A target step of ``step`` needs less than the effort that the largest
  gravity load leaves. The natural frequency stays below one radian per control step, because a faster drive would follow every
  stair of targets that change once per control step. (A drive at its effort limit does not damp, and a light joint then jumps
  within one physics step.)
- Damping: a damping ratio of 0.8 (1.5% overshoot) at that inertia, which is critical at 64% of it and overcritical below. No
  pose overshoots much, and light poses are not slowed for the heaviest one. Stiffness x physics step is added; see
  ``sim.gains``.

With these gains no joint of the package's own arms overshoots by 2% or reaches its effort limit, at home and in random poses.

A gripper's stiffness also sets how hard it grips at a given target: check that before you use its gains.
"""

import dataclasses
import math

import numpy as np

from mjx_nero.errors import UserError
from mjx_nero.identify.load import Load, loads
from mjx_nero.identify.model import drives_model
from mjx_nero.identify.response import Response, respond, steps
from mjx_nero.sim.gains import critical_damping
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SimCfg

_RATIO = 0.8  # damping ratio in the 95th percentile pose
_RESERVE = 0.99  # share of the spare effort that a step may use, so that the limit is never reached


@dataclasses.dataclass(frozen=True)
class Tuning:
    """Gains and step responses before and after; tuples have one entry per joint of the robot.

    Attributes:
        robot, tuned: the robot with its own gains, and with the proposed ones.
        loads: loads that the drives have to move.
        before, after: step responses at home.
    """

    robot: RobotCfg
    tuned: RobotCfg
    loads: tuple[Load, ...]
    before: tuple[Response, ...]
    after: tuple[Response, ...]


def tune(robot: RobotCfg, step: float = 0.1, frequency: float | None = None, sim: SimCfg | None = None) -> Tuning:
    """Proposes gains for all drives of a robot, and measures its step responses with both.

    Args:
        step: step of the target that the drives follow within their effort [rad or m]; at most a tenth of a joint's range.
        frequency: maximum natural frequency [Hz]; None: one radian per control step.
        sim: physics and control step.

    Raises:
        UserError: a number is out of range, the frequency too high for the physics step, or gravity overpowers a drive.
    """
    sim = sim or SimCfg()
    for name, value in (("step", step), ("frequency", frequency)):
        if value is not None and not 0 < value < math.inf:
            raise UserError(f"{name} takes a number above 0, got {value:g}")
    if not 1e-4 <= sim.dt <= 0.1:
        raise UserError(f"dt takes a physics step from 0.0001 to 0.1 s, got {sim.dt:g}")
    frequency = 1 / (2 * math.pi * sim.dt * sim.decimation) if frequency is None else frequency
    if 2 * math.pi * frequency * sim.dt > 1:
        limit = 1 / (2 * math.pi * sim.dt)
        raise UserError(f"a physics step of {sim.dt:g} s cannot follow {frequency:g} Hz: at most {limit:.3g} Hz, or a smaller dt")
    model = drives_model(robot, sim)
    carried = loads(model)
    sizes = np.abs(steps(model, robot.home, step))
    gains = [propose(load, size, frequency, sim.dt) for load, size in zip(carried, sizes, strict=True)]
    stiffness, damping = zip(*gains, strict=True)
    n = len(robot.arm.joints)
    tuned = dataclasses.replace(
        robot,
        arm=dataclasses.replace(robot.arm, stiffness=stiffness[:n], damping=damping[:n]),
        gripper=dataclasses.replace(robot.gripper, stiffness=stiffness[n:], damping=damping[n:]),
    )
    before, after = (respond(m, robot.home, step) for m in (model, drives_model(tuned, sim)))
    return Tuning(robot, tuned, carried, before, after)


def propose(load: Load, step: float, frequency: float, dt: float) -> tuple[float, float]:
    """Returns (stiffness [N m/rad or N/m], damping [N m s/rad or N s/m]); the module's docstring says how they are chosen.

    Args:
        step: step of the target that the drive follows within its effort [rad or m].
        frequency: maximum natural frequency [Hz].
        dt: physics step [s].

    Raises:
        UserError: gravity leaves the drive no effort.
    """
    spare = load.effort - load.gravity
    if spare <= 0:
        raise UserError(
            f"{load.joint}: gravity needs up to {load.gravity:.3g} from a drive limited to {load.effort:.3g}: "
            "raise its effort, or let the robot compensate gravity"
        )
    critical = _RATIO**2 * load.heavy  # the inertia that is damped critically
    stiffness = _round(min(_RESERVE * spare / step, (2 * math.pi * frequency) ** 2 * critical), math.floor)
    return stiffness, _round(critical_damping(stiffness, critical, dt, load.friction), math.ceil)


def gains(robot: RobotCfg) -> dict[str, dict[str, float]]:
    """Returns stiffness, damping, effort and speed by joint, to three significant digits, for ``import-urdf --gains``."""
    out = {}
    for drive in (robot.arm, robot.gripper):
        for i, joint in enumerate(drive.joints):
            fields = {name: getattr(drive, name)[i] for name in ("stiffness", "damping", "effort", "speed")}
            out[joint] = {name: float(f"{value:.3g}") for name, value in fields.items()}
    return out


def _round(value: float, way) -> float:
    """Rounds to three significant digits: stiffness down, to stay within the effort; damping up, to avoid overshoot."""
    if value == 0:
        return 0.0
    unit = 10.0 ** (math.floor(math.log10(value)) - 2)
    return float(f"{way(value / unit + (1e-9 if way is math.floor else -1e-9)) * unit:.3g}")
