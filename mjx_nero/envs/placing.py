"""Things of meshes in tasks that place: where they belong, when they count as standing and as left, and the script."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import mujoco
import numpy as np

from mjx_nero.config import bounds
from mjx_nero.envs.task import EnvCfg
from mjx_nero.envs.tasks.building import AWAY
from mjx_nero.envs.tasks.lift_any import LIFTED, NEAR, expert
from mjx_nero.mdp import towers
from mjx_nero.mdp.terms import Term
from mjx_nero.sim.objects import shapes
from mjx_nero.sim.scene import ObjectCfg

LONGER = 3.0  # [s] that the script takes longer than with a box: it lowers what it holds slowly
OVER, DONE = 0.03, 0.004  # [m] heights over its place: from where a thing comes straight down, and where the hand opens
MEETS = 0.01  # [m] below half of it the hand yields to what the thing stands on
T = TypeVar("T", bound=Term)


def places(condition: Term) -> bool:
    """True if the success of a task is one object at the goal, left alone."""
    if bounds.unwrapped(condition.func) is not towers.left_alone:
        return False
    tower = condition.params["place"].tower
    return tower[0] == towers.GOAL and len(tower) == 2


def unturned(quat: np.ndarray) -> tuple[float, float, float, float]:
    """The orientation without its turn about the vertical, which comes last (wxyz)."""
    w, x, y, z = quat
    half = -np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)) / 2
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, np.array([np.cos(half), 0.0, 0.0, np.sin(half)]), np.asarray(quat, float))
    w, x, y, z = (round(float(v), 6) for v in out / np.linalg.norm(out))
    return w, x, y, z


def applied(cfg: EnvCfg, name: str, item: ObjectCfg) -> EnvCfg:
    """Returns the task with the thing at the goal as it lies at the start, but for its heading."""
    (solid,), (w, x, y, z) = item.solids, item.quat
    roll, pitch = np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)), np.arcsin(np.clip(2 * (w * y - z * x), -1.0, 1.0))
    height = round(item.rest_height - cfg.robot.base_pos[2], 4)
    still = {"z": (height,) * 2, "roll": (round(float(roll), 6),) * 2, "pitch": (round(float(pitch), 6),) * 2}
    was = cfg.success.condition.params["place"]
    reach = float(np.linalg.norm(shapes.box(solid)[1]) / 2)
    place = dataclasses.replace(
        was, minimal_height=LIFTED, grasp_radius=NEAR, clearance=round(reach + cfg.robot.pad[0] / 2 + AWAY, 4)
    )
    turns = int(was.within[2] < np.pi)
    grip = expert(cfg.robot, name, item)["grasp_thing"]
    put = {f"pick.{key}": value for key, value in grip.items()}
    put |= {"over": OVER, "top": MEETS, "done": DONE, "turns": turns, "away": round(place.clearance + AWAY, 4)}
    ends = dataclasses.replace(
        cfg.success, condition=_there(cfg.success.condition, place), distance=_there(cfg.success.distance, place)
    )
    return dataclasses.replace(
        cfg,
        episode_length_s=cfg.episode_length_s + LONGER,
        command=dataclasses.replace(cfg.command, params={**cfg.command.params, **still}),
        rewards=_all_there(cfg.rewards, place),
        success=ends,
        controllers={"put_thing": put},
    )


def _there(term: T, place: towers.Place) -> T:
    own: dict[str, Any] = {"place": place} if "place" in term.params else {}
    return dataclasses.replace(term, params={**term.params, **own})


def _all_there(terms: Mapping[str, T], place: towers.Place) -> dict[str, T]:
    return {key: _there(term, place) for key, term in terms.items()}
