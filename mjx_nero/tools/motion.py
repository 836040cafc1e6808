"""Moves every joint to its limits, in simulation."""

import dataclasses

import mujoco
import numpy as np

from mjx_nero.sim import scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg

_NEAR = 0.01  # share of a joint's range within which a target counts as reached
_REST, _AFTER = 3.0, 4.0  # waiting time before a movement, and after its target has arrived [s]
_LONGEST = 60.0  # maximum time of a movement [s]: a robot's file may declare very slow drives


@dataclasses.dataclass(frozen=True)
class Move:
    """A joint's movement to a target that moves at the drive's speed limit.

    Attributes:
        start, target, end: positions [rad or m].
        time: until the joint stays within 1% of its range of the target [s]; None: never.
        fastest: maximum speed [rad/s or m/s].
        saturation: share of time during which the drive was at its effort limit.
    """

    joint: str
    start: float
    target: float
    end: float
    time: float | None
    fastest: float
    saturation: float


def moves(robot: RobotCfg, sim: SimCfg) -> tuple[Move, ...]:
    """Moves every joint to its limits, and closes and opens the gripper, in MuJoCo's C library.

    Position targets change once per control step, at the drives' speed limits, as in an environment; contacts are off. The arm's
    joints move one at a time, from home; the gripper's move together, from one end to the other. Joints without limits are
    skipped.
    """
    model, home, out = _alone(robot, sim), np.array(robot.home), []
    for i, name in enumerate(robot.arm.joints):
        for end in model.joint(name).range if model.jnt_limited[model.joint(name).id] else ():
            target = home.copy()
            target[i] = end
            out += _move(model, robot, sim, home, target, [i])
    return (*out, *gripper_moves(robot, sim))


def gripper_moves(robot: RobotCfg, sim: SimCfg) -> tuple[Move, ...]:
    """Closes, then opens the gripper, as ``moves`` does; one movement per joint. Empty without a gripper."""
    if not robot.gripper.joints:
        return ()
    model, home, n = _alone(robot, sim), np.array(robot.home), len(robot.arm.joints)
    opened, closed = (np.concatenate([home[:n], ends]) for ends in (robot.gripper.open, robot.gripper.close))
    fingers = list(range(n, len(home)))
    ways = (opened, closed), (closed, opened)
    return tuple(move for start, end in ways for move in _move(model, robot, sim, start, end, fingers))


def _alone(robot: RobotCfg, sim: SimCfg) -> mujoco.MjModel:
    """Builds the robot with its drives, without contacts."""
    model = scene.build(robot, SceneCfg(objects={}, table=False), sim, visuals=False)
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    return model


def _move(
    model: mujoco.MjModel, robot: RobotCfg, sim: SimCfg, start: np.ndarray, target: np.ndarray, moving: list[int]
) -> list[Move]:
    data, dt = mujoco.MjData(model), sim.dt * sim.decimation
    at, dof = ([int(getattr(model.joint(j), kind)[0]) for j in robot.joints] for kind in ("qposadr", "dofadr"))
    data.qpos[at], data.ctrl[:] = robot.home, start
    mujoco.mj_step(model, data, round(_REST / sim.dt))
    speed = np.array(robot.arm.speed + robot.gripper.speed)
    seconds = min(float(np.max(np.abs(target - start)[moving] / speed[moving])) + _AFTER, _LONGEST)
    begin, path, speeds, full = data.qpos[at].copy(), [], [], []
    limit = np.array(robot.arm.effort + robot.gripper.effort) * (1 - 1e-6)
    for _ in range(round(seconds / dt)):
        data.ctrl[:] += np.clip(target - data.ctrl, -speed * dt, speed * dt)
        for _ in range(sim.decimation):
            mujoco.mj_step(model, data)
            path.append(data.qpos[at].copy())
            speeds.append(np.abs(data.qvel[dof]))
            full.append(np.abs(data.actuator_force) >= limit)
    positions, out = np.array(path), []
    for i in moving:
        width = float(np.ptp(model.joint(robot.joints[i]).range)) or abs(target[i] - start[i])
        away = np.flatnonzero(~(np.abs(positions[:, i] - target[i]) <= _NEAR * width))
        steps = away[-1] + 1 if len(away) else 0
        out.append(
            Move(
                robot.joints[i],
                float(begin[i]),
                float(target[i]),
                float(positions[-1, i]),
                float((steps + 1) * sim.dt) if steps < len(positions) else None,
                float(np.max(speeds, axis=0)[i]),
                float(np.mean(full, axis=0)[i]),
            )
        )
    return out
