"""What a policy's output means, as data: for runtimes and frameworks that don't know this package."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero.bounds import unwrapped
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.mdp import actions as terms
from mjx_nero.mdp.terms import Term
from mjx_nero.sim.robot import DriveCfg, RobotCfg
from mjx_nero.types import UserError

_GRIPPERS = {terms.BinaryGripper: "binary", terms.ContinuousGripper: "continuous"}  # one entry for all joints


def parts(env: ManipulationEnv) -> list[dict[str, Any]]:
    """How the action becomes position targets of the drives: the task's action terms, in their order.

    Those with ``joints`` read entries of the action. ``joint_position``: ``offset + scale * action`` [rad, m], an entry a joint.
    ``joint_velocity``: likewise, of set-points, as ``mdp.actions.JointVelocity`` has it: shares of the drives' speeds, smoothed
    with the time constant ``time`` [s], at most ``ahead`` [s] of full speed before the joints; targets lead by ``lag`` [s].
    ``binary``: ``close`` for an entry below minus ``hysteresis``, ``open`` from plus that on, between as it was (at first open),
    one for all the joints. ``continuous``: from ``close`` at -1 to ``open`` at 1, likewise. The others change what is there:
    ``anti_windup`` (targets ``of`` some joints that turn back start at most ``ahead`` [s] of full speed behind the joints),
    ``speed_limit`` (they move at most as fast as the drives), ``delay`` (in control steps, the least and the most) and
    ``low_pass`` (time constant [s]) of the action.

    Raises:
        UserError: a term that only this package knows.
    """
    return [part for name, term in env.cfg.actions.items() for part in _part(env, name, term)]


def _part(env: ManipulationEnv, name: str, term: Term) -> list[dict[str, Any]]:
    robot, kind = env.cfg.robot, unwrapped(term.func)
    if kind is terms.JointPosition:
        drives = _drives(robot, term)
        of = {"joints": list(drives.joints), "scale": term.params["scale"], "offset": list(drives.home)}
        return [{"name": name, "type": "joint_position", **of}]
    if kind is terms.JointVelocity:
        drives, given = _drives(robot, term), {key: term.params[key] for key in ("time", "ahead")}
        return [{"name": name, "type": "joint_velocity", "joints": list(drives.joints), **given, "lag": list(drives.lead)}]
    if kind is terms.DriveTargets:
        of = {"joints": list(robot.joints), "scale": 1.0, "offset": [0.0] * len(robot.joints)}
        return [{"name": name, "type": "joint_position", **of}]
    if kind in _GRIPPERS:
        of = {"joints": list(robot.gripper.joints), "open": list(robot.gripper.open), "close": list(robot.gripper.close)}
        return [{"name": name, "type": _GRIPPERS[kind], **of, **term.params}] if robot.gripper.joints else []
    if kind is terms.SpeedLimit:
        limited = _drives(robot, term).joints if term.params["group"] else robot.joints
        return [{"name": name, "type": "speed_limit", "of": list(limited)}]
    if kind is terms.AntiWindup:
        of = {"of": list(_drives(robot, term).joints), "ahead": term.params["ahead"]}
        return [{"name": name, "type": "anti_windup", **of}]
    if kind is terms.Delay:
        return [{"name": name, "type": "delay", "steps": list(term.params["steps"])}]
    if kind is terms.LowPass:
        return [{"name": name, "type": "low_pass", "time": term.params["time"]}]
    raise UserError(f"the action term {name} ({term.name}) is one that only this package knows")


def _drives(robot: RobotCfg, term: Term) -> DriveCfg:
    return robot.arm if term.params["group"] == "arm" else robot.gripper


def bounds(env: ManipulationEnv) -> tuple[np.ndarray, np.ndarray]:
    """The actions that take each joint to its limits; beyond them nothing more happens. A gripper's one action is in +-1."""
    low: list[float] = []
    high: list[float] = []
    for part in (part for part in parts(env) if "joints" in part):
        if part["type"] != "joint_position":
            n = 1 if part["type"] in _GRIPPERS.values() else len(part["joints"])
            low, high = [*low, *[-1.0] * n], [*high, *[1.0] * n]
            continue
        limits = np.array([env.physics_model.joint(name).range for name in part["joints"]]).T
        ends = np.sort((limits - part["offset"]) / part["scale"], axis=0)
        low, high = [*low, *ends[0]], [*high, *ends[1]]
    return np.array(low, np.float32), np.array(high, np.float32)


def for_targets(env: ManipulationEnv, targets: jax.Array, joint_pos: jax.Array) -> jax.Array:
    """The action that gives position targets of the drives: so a controller can act where a policy would.

    A gripper without an action of its own stays where it is; a binary one opens or closes, whichever is nearer; a continuous one
    opens as far as comes nearest.

    Args:
        targets: [..., joints], in the order of ``RobotCfg.joints`` [rad or m].
        joint_pos: where the joints are, likewise.
    """
    out, every = [], parts(env)
    robot, late = env.cfg.robot, max((part["steps"][1] for part in every if part["type"] == "delay"), default=0)
    speed = np.array(robot.arm.speed + robot.gripper.speed, np.float32)
    for part in (part for part in every if "joints" in part):
        ids = np.array([robot.joints.index(name) for name in part["joints"]])
        want = targets[..., ids]
        if part["type"] == "binary":
            to_open, to_close = (jnp.abs(want - jnp.array(part[end])).sum(-1) for end in ("open", "close"))
            out.append(jnp.where(to_close < to_open, -1.0, 1.0)[..., None])
        elif part["type"] == "continuous":
            out.append(terms.opening(want, np.array(part["open"]), np.array(part["close"]))[..., None])
        elif part["type"] == "joint_velocity":  # as slowly as velocities follow: faster would swing
            slow = 2 * (part["time"] + late * env.dt)
            out.append(jnp.clip((want - joint_pos[..., ids]) / (slow * speed[ids]), -1.0, 1.0))
        else:
            out.append((want - jnp.array(part["offset"])) / part["scale"])
    return jnp.concatenate(out, axis=-1)
