"""Finds goals and objects that no hand comes near, by random postures."""

import itertools
from collections.abc import Iterator

import mujoco
import numpy as np

from mjx_nero.envs.task import EnvCfg
from mjx_nero.mdp.terms import Term
from mjx_nero.sim import team

NEAR, POSTURES = 0.2, 2000  # how near to a place one of so many postures comes [m]


def beyond(cfg: EnvCfg, model: mujoco.MjModel) -> str:
    """Describes the first region of a goal or an object that is partly out of every hand's reach; empty if none is.

    It is not an error: what is thrown, rolls or is pushed by something else may go there.

    Args:
        model: the scene.
    """
    regions: list[tuple[str, Term, np.ndarray]] = [("command", cfg.command, np.array(cfg.robot.base_pos))]
    moved = [(f"events.{name}", term) for name, term in cfg.events.items() if {"object", "objects"} & term.params.keys()]
    regions += [(name, term, np.zeros(3)) for name, term in moved]
    corners = {name: _corners(term) + origin for name, term, origin in regions if {"x", "y"} <= term.params.keys()}
    if not corners:
        return ""
    away = {name: np.full(len(places), np.inf) for name, places in corners.items()}
    for hand in _hands(cfg, model):
        for name, places in corners.items():
            away[name] = np.minimum(away[name], np.linalg.norm(hand - places, axis=1))
        if all(found.max() <= NEAR for found in away.values()):  # most tasks: a few hundred postures do
            return ""
    name, found = next((name, found) for name, found in away.items() if found.max() > NEAR)
    worst = int(np.argmax(found))
    at = ", ".join(f"{x:.2f}" for x in corners[name][worst])
    return f"{name}.params is out of reach: no hand comes nearer than {found[worst]:.2f} m to ({at}), check x, y and z"


def _corners(term: Term) -> np.ndarray:
    """Returns the corners of a term's box [8, 3]; without ``z``, it lies on the table."""
    return np.array(list(itertools.product(*(term.params.get(axis, (0.0, 0.0)) for axis in "xyz"))), float)


def _hands(cfg: EnvCfg, model: mujoco.MjModel) -> Iterator[np.ndarray]:
    """Yields places of the grasp points of all robots in the world [3], at home and in random postures."""
    robots, data, rng = team.of(cfg.robot, cfg.scene.robots), mujoco.MjData(model), np.random.default_rng(0)
    joints = [model.joint(name) for name in team.joints(robots)]
    at = [joint.qposadr[0] for joint in joints]
    low, high = np.array([joint.range if joint.limited[0] else (-np.pi, np.pi) for joint in joints]).T
    for posture in (team.home(robots), *rng.uniform(low, high, (POSTURES, len(joints)))):
        data.qpos[at] = posture
        mujoco.mj_kinematics(model, data)
        for robot in robots.values():
            yield data.site(robot.ee_site).xpos
