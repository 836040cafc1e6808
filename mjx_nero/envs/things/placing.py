"""Mesh objects in tasks that place: where they belong, when they count as standing and as left, and the script."""

import dataclasses

import numpy as np

from mjx_nero.config import bounds
from mjx_nero.envs.task import EnvCfg
from mjx_nero.envs.things.gripping import LIFTED, NEAR, expert
from mjx_nero.mdp import towers
from mjx_nero.mdp.terms import Term
from mjx_nero.sim.scene import ObjectCfg
from mjx_nero.sim.solids import rests, shapes

LONGER = 3.0  # [s] extra time of the script compared with a box: it lowers the thing slowly
OVER, DONE = 0.03, 0.004  # [m] heights over the place: where the straight descent begins, and where the hand opens
STEP = 0.005  # [s] physics step: at 10 ms, flat things that lie on many corners tremble too fast to count as at rest
AWAY = 0.02  # [m] clearance of the pads beside or above an object that the hand has left
MEETS = 0.01  # [m] below half this height, the hand yields to what the thing stands on


def places(condition: Term) -> bool:
    """True if the success of a task is one object at the goal, left alone."""
    if bounds.unwrapped(condition.func) is not towers.left_alone:
        return False
    tower = condition.params["place"].tower
    return tower[0] == towers.GOAL and len(tower) == 2


def tilt(up: np.ndarray) -> tuple[float, float]:
    """Roll and pitch [rad] of a thing without yaw; ``up`` is the world's vertical in the thing's own frame."""
    x, y, z = up
    level = np.hypot(y, z)
    roll = np.arctan2(y, z) if level > 1e-3 else 0.0  # with a vertical x axis, any roll is a turn about the vertical
    return round(float(roll), 6), round(float(np.arctan2(-x, level)), 6)


def tilted(roll: float, pitch: float) -> tuple[float, float, float, float]:
    """Orientation (wxyz) of a thing with this roll and pitch and without yaw."""
    w, x = np.cos(roll / 2), np.sin(roll / 2)
    c, s = np.cos(pitch / 2), np.sin(pitch / 2)
    return float(c * w), float(c * x), float(s * w), float(-s * x)


def applied(cfg: EnvCfg, name: str, item: ObjectCfg) -> EnvCfg:
    """Returns the task for the thing: the goal has the thing's resting height, roll and pitch; only its heading varies."""
    (solid,), (roll, pitch) = item.solids, tilt(rests.up(np.array(item.quat)))
    height = round(item.rest_height - cfg.robot.base_pos[2], 4)
    still = {"z": (height,) * 2, "roll": (roll, roll), "pitch": (pitch, pitch)}
    was = cfg.success.condition.params["place"]
    reach = float(np.linalg.norm(shapes.box(solid)[1]) / 2)
    place = dataclasses.replace(
        was, minimal_height=LIFTED, grasp_radius=NEAR, clearance=round(reach + cfg.robot.pad[0] / 2 + AWAY, 4)
    )
    turns = int(was.within[2] < np.pi)
    grip = expert(cfg.robot, name, item)["grasp_thing"]
    put = {f"pick.{key}": value for key, value in grip.items()}
    put |= {"over": OVER, "top": MEETS, "done": DONE, "turns": turns, "away": round(place.clearance + AWAY, 4)}

    def there(term: Term) -> Term:
        return dataclasses.replace(term, params={**term.params, "place": place}) if "place" in term.params else term

    return dataclasses.replace(
        cfg.changed(there),
        sim=cfg.sim.finer(STEP),
        episode_length_s=cfg.episode_length_s + LONGER,
        command=dataclasses.replace(cfg.command, params={**cfg.command.params, **still}),
        controllers={"put_thing": put},
    )
