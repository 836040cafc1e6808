"""The inertia and weight that drives move, over the workspace."""

import dataclasses

import mujoco
import numpy as np

from mjx_nero.identify.model import driven, leaders, moves, pose_model, ranges

_POSES = 500


@dataclasses.dataclass(frozen=True)
class Load:
    """The load of a drive over the workspace.

    Attributes:
        joint: name of the joint.
        light, heavy: 5th and 95th percentile of the inertia [kg m^2 or kg].
        gravity: largest static load [N m or N].
        effort: the drive's effort limit [N m or N].
        friction: the joint's own damping [N m s/rad or N s/m].
    """

    joint: str
    light: float
    heavy: float
    gravity: float
    effort: float
    friction: float


def loads(model: mujoco.MjModel) -> tuple[Load, ...]:
    """Measures each drive's load over random poses within the joint limits.

    Joints that are coupled by equality constraints move together, so their drives share inertia and load.
    """
    data, (joints, dofs), ways = mujoco.MjData(model), driven(model), moves(model)
    leader, ratio = leaders(model)
    together = leader[:, None] == leader
    # With equal gains, a drive carries ratio / sum(ratio^2) of a force and 1 / sum(ratio^2) of an inertia of the common motion.
    squares = np.where(together, ratio**2, 0).sum(axis=1)
    lower, upper = ranges(model)[joints].T
    rng, full = np.random.default_rng(0), np.zeros((model.nv, model.nv))
    inertia, gravity = np.zeros((2, _POSES, model.nu))
    for k in range(_POSES):
        pose_model(model, data, rng.uniform(lower, upper))
        mujoco.mj_fullM(model, data, full)
        inertia[k] = np.einsum("ac,ab,bc->c", ways, full, ways)[leader] / squares
        gravity[k] = np.abs((data.qfrc_bias - data.qfrc_gravcomp) @ ways)[leader] * np.abs(ratio) / squares
    light, heavy = np.percentile(inertia, [5, 95], axis=0)
    efforts = np.where(model.actuator_forcelimited, model.actuator_forcerange[:, 1], np.inf)
    columns = (light, heavy, gravity.max(axis=0), efforts, model.dof_damping[dofs])
    return tuple(Load(model.joint(j).name, *map(float, row)) for j, *row in zip(joints, *columns, strict=True))
