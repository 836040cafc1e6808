"""Targets that excite all parameters to be identified without endangering the arm: sine sweeps about home."""

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_nero.errors import UserError
from mjx_nero.sim import scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg

RATE = 50.0  # rate of the targets [Hz]
_SLOW, _FAST = 0.1, 3.0  # frequencies of the sweeps [Hz]
_SPEED, _RANGE = 0.7, 0.9  # shares of the drives' speeds and the joints' ranges
_STILL = 1.5  # time at rest at the beginning and the end, and again the time to fade in and out [s]
_CLEAR = 0.02  # clearance between links, and over the table [m]


def sweeps(robot: RobotCfg, seconds: float, amplitude: float = 0.5) -> Float[np.ndarray, "m n"]:
    """Makes position targets of the arm's joints at ``RATE`` [rad or m].

    Each joint swings about home (or beside it, if home is near a limit) at a frequency that rises and falls between 0.1 and 3 Hz.
    Each joint has a different period, so that no two move alike. Targets stay within the joint ranges and at most at 70% of the
    drives' speeds. Swings are halved until shapes that are at least two joints and 2 cm apart at home stay 2 cm apart, and as far
    from the table.

    Args:
        seconds: length of the movement [s].
        amplitude: maximum amplitude [rad or m].

    Raises:
        UserError: the time is too short, or there is no room.
    """
    if seconds < 4 * _STILL:
        raise UserError(f"the movement takes at least {4 * _STILL:g} s, got {seconds:g}: pass a larger --seconds")
    model = scene.build(robot, SceneCfg(objects={}), SimCfg())
    time, home = np.arange(round(seconds * RATE)) / RATE, np.array(robot.arm.home)
    low, high = np.array([model.joint(j).range for j in robot.arm.joints]).T
    room = np.minimum(amplitude, _RANGE * (high - low) / 2)
    limits = zip(robot.arm.speed, room, strict=True)
    swings = np.stack([_sweep(time, seconds, i, speed, size) for i, (speed, size) in enumerate(limits)], axis=1)
    for _ in range(6):
        targets = np.clip(home, low + room / _RANGE, high - room / _RANGE) + swings
        if _clear(model, robot, targets[:: round(RATE / 4)]):
            return targets
        swings, room = swings / 2, room / 2
    raise UserError(f"{robot.name} has no room for the movement about its home: give it another home")


def _sweep(time: np.ndarray, seconds: float, joint: int, speed: float, room: float) -> np.ndarray:
    """Makes a sine whose frequency rises and falls. Where the amplitude ``room`` would be too fast, the amplitude is lower."""
    period = seconds / (3.0 + 0.7 * joint)
    share = np.abs((time / period + 0.37 * joint) % 2 - 1)
    frequency = _SLOW * (_FAST / _SLOW) ** share
    phase = 2 * np.pi * np.cumsum(frequency) / RATE + joint
    size = np.minimum(room, _SPEED * speed / (2 * np.pi * frequency))
    fade = np.clip(np.minimum(time, seconds - time) / _STILL - 1, 0, 1)
    return fade * size * np.sin(phase)


def _clear(model: mujoco.MjModel, robot: RobotCfg, targets: np.ndarray) -> bool:
    """Returns whether links that are apart at home stay apart."""
    data = mujoco.MjData(model)
    at = [int(model.joint(j).qposadr[0]) for j in (*robot.arm.joints, *robot.gripper.joints)]
    pictures = ("table_top", "floor", "goal")  # the table itself is a plane
    solid = [g for g in range(model.ngeom) if model.geom(g).name not in pictures]
    weld = model.body_weldid
    below = weld[model.body_parentid[weld]]  # the next body that moves relative to it

    after = np.where(below[below] > 0, below[below], -1)  # the body below that, unless it is the world

    def near(a: int, b: int) -> bool:
        i, j = (int(weld[model.geom_bodyid[g]]) for g in (a, b))
        return i == j or i in (below[j], after[j]) or j in (below[i], after[i])

    pairs = [(a, b) for k, a in enumerate(solid) for b in solid[k + 1 :] if not near(a, b)]
    for k, pose in enumerate([np.array(robot.arm.home), *targets]):
        data.qpos[:], data.qpos[at] = model.qpos0, [*pose, *robot.gripper.home]
        mujoco.mj_kinematics(model, data)
        apart = [mujoco.mj_geomDistance(model, data, a, b, _CLEAR, None) >= _CLEAR for a, b in pairs]
        if not k:
            pairs = [pair for pair, far in zip(pairs, apart, strict=True) if far]
        elif not all(apart):
            return False
    return True
