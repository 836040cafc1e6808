"""Measures step responses of drives, in MuJoCo's C library."""

import dataclasses
import math
from collections.abc import Sequence

import mujoco
import numpy as np

from mjx_nero.identify.model import driven, leaders, pose_model, ranges

SECONDS = 5.0  # length of a response: several time constants of the slowest drive in the package
_SHARE = 0.1  # maximum step as a share of the joint's range: 5 mm on a finger's slide of 50 mm
_BAND = 0.02  # share of the motion within which a joint counts as settled


@dataclasses.dataclass(frozen=True)
class Response:
    """A joint's response to a step of its drive's target.

    Attributes:
        joint: name of the joint.
        step: step of the target [rad or m].
        time: time since the step [n] [s].
        position: motion since the step [n] [rad or m].
        force: force of the drive during each physics step [n - 1] [N m or N].
        error: target minus position at the end, sag by gravity included [rad or m].
        effort: the drive's effort limit [N m or N].
    """

    joint: str
    step: float
    time: np.ndarray
    position: np.ndarray
    force: np.ndarray
    error: float
    effort: float

    @property
    def share(self) -> np.ndarray:
        """Position as a share of the final position [n]; NaN if the joint does not move."""
        end = self.position[-1]
        return self.position / end if abs(end) > 1e-6 * abs(self.step) else np.full_like(self.position, np.nan)

    @property
    def rise(self) -> float:
        """Time from 10% to 90% of the step [s]."""
        return self._first(0.9) - self._first(0.1)

    @property
    def overshoot(self) -> float:
        """Motion beyond the end, as a share of the step."""
        return float(np.max(self.share)) - 1.0

    @property
    def settling(self) -> float:
        """Time until the joint stays within 2% of the step [s]; inf if it still moves at the end."""
        share = self.share
        outside = np.flatnonzero(~(np.abs(share - 1) <= _BAND))
        last = outside[-1] if len(outside) else -1
        return float(self.time[last + 1]) if last < 0.9 * len(share) else math.inf

    @property
    def saturation(self) -> float:
        """Share of the time until settled during which the drive is at its effort limit."""
        full = np.abs(self.force) >= self.effort * (1 - 1e-6)
        return float(np.mean(full[self.time[1:] <= max(self.settling, self.time[1])]))

    def _first(self, level: float) -> float:
        share = self.share
        above = np.flatnonzero(share >= level)
        if not len(above):
            return math.nan
        k = above[0]
        return float(np.interp(level, share[k - 1 : k + 1], self.time[k - 1 : k + 1]))


def steps(model: mujoco.MjModel, pose: Sequence[float], step: float) -> np.ndarray:
    """Returns the drives' target steps [nu]: ``step``, at most a tenth of a joint's range, away from its nearer end."""
    (joints, _), (leader, ratio), at = driven(model), leaders(model), np.asarray(pose)
    lower, upper = ranges(model)[joints].T
    size = np.minimum(step, _SHARE * (upper - lower)) * np.where(at - lower > upper - at, -1, 1)
    first = np.array([np.flatnonzero(leader == c)[0] for c in leader])  # coupled joints step together
    return size[first] * ratio / ratio[first]


def respond(model: mujoco.MjModel, pose: Sequence[float], step: float, seconds: float = SECONDS) -> tuple[Response, ...]:
    """Measures the step responses of all drives, one after another, while the others hold ``pose``. Coupled joints step together.

    Args:
        model: model with position drives on joints.
        pose: positions that the drives hold before the step [nu] [rad or m].
        step: see ``steps``.
        seconds: length of each response [s].
    """
    data, (joints, _) = mujoco.MjData(model), driven(model)
    at = model.jnt_qposadr[joints]
    held, change, (leader, _) = np.asarray(pose, float), steps(model, pose, step), leaders(model)
    pose_model(model, data, held)
    n = max(2, round(seconds / model.opt.timestep))
    for _ in range(n):  # until the joints sag under gravity
        mujoco.mj_step(model, data)
    rest = data.qpos.copy(), data.qvel.copy(), data.qacc_warmstart.copy()
    out: dict[int, Response] = {}
    efforts = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf)
    for c in np.unique(leader):
        data.qpos[:], data.qvel[:], data.qacc_warmstart[:] = rest
        data.ctrl[:] = held + np.where(leader == c, change, 0)
        path, force = [data.qpos[at].copy()], []
        for _ in range(n):
            mujoco.mj_step(model, data)
            path.append(data.qpos[at].copy())
            force.append(data.actuator_force.copy())
        positions, forces = np.array(path), np.array(force)
        for i in map(int, np.flatnonzero(leader == c)):
            out[i] = Response(
                joint=model.joint(joints[i]).name,
                step=float(change[i]),
                time=model.opt.timestep * np.arange(n + 1),
                position=positions[:, i] - positions[0, i],
                force=forces[:, i],
                error=float(data.ctrl[i] - positions[-1, i]),
                effort=float(efforts[i]),
            )
    return tuple(out[i] for i in range(model.nu))
