"""Computes the terms of ``mdp.observations`` that are available on an arm, from its feedback and the objects' positions."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.arm import Feedback
from mjx_nero.deploy.body import Body, matrix, product
from mjx_nero.deploy.places import Place, Places
from mjx_nero.errors import UserError

Pictures = Callable[[Feedback, float], Mapping[str, np.ndarray]]


def no_pictures(feedback: Feedback, now: float) -> Mapping[str, np.ndarray]:
    """Returns the pictures for a policy without cameras: none."""
    return {}


@dataclasses.dataclass(frozen=True)
class Seen:
    """The quantities that terms read at one step.

    Attributes:
        position, velocity, home, targets: of the joints [rad or m; rad/s or m/s].
        action: the last action.
        ee, ee_quat: pose of the end effector in the robot's root frame [m], wxyz.
        goal, goal_quat: the commanded pose in the same frame.
        objects: poses of the objects by name, in the same frame.
    """

    position: np.ndarray
    velocity: np.ndarray
    home: np.ndarray
    targets: np.ndarray
    action: np.ndarray
    ee: np.ndarray
    ee_quat: np.ndarray
    goal: np.ndarray
    goal_quat: np.ndarray
    objects: Mapping[str, Place]


def _ways(seen: Seen, objects: list[str], limit: float) -> np.ndarray:
    ways = np.stack([seen.objects[name].position - seen.ee for name in objects])
    far = np.linalg.norm(ways, axis=1, keepdims=True)
    return (ways * np.minimum(1.0, limit / np.maximum(far, 1e-6))).reshape(-1)


def rotation_vector(quat: np.ndarray) -> np.ndarray:
    """Converts a rotation (wxyz) to axis times angle, at most half a turn [rad]."""
    quat = -quat if quat[0] < 0 else quat
    sine = float(np.linalg.norm(quat[1:]))
    return quat[1:] * (2 * np.arctan2(sine, quat[0]) / sine if sine > 1e-6 else 2.0)


def _turn(seen: Seen) -> np.ndarray:
    return rotation_vector(product(seen.ee_quat * [1, -1, -1, -1], seen.goal_quat))


_FOLDS = 100  # more need too much memory, and differ by less than 4 degrees


def _object_turn(seen: Seen, fold: int = 1, object: str = "cube") -> np.ndarray:
    """Computes the shortest rotation of an object to the goal; the object has a ``fold``-fold symmetry about z."""
    halves = np.pi * np.arange(min(fold, _FOLDS)) / fold
    turns = [np.array([np.cos(h), 0.0, 0.0, np.sin(h)]) for h in halves]
    back = seen.objects[object].quaternion * [1, -1, -1, -1]
    ways = [rotation_vector(product(product(seen.goal_quat, turn), back)) for turn in turns]
    return min(ways, key=lambda way: float(np.linalg.norm(way)))


# Name of a term in ``mdp.observations`` -> function of a step and the term's parameters.
TERMS: dict[str, Callable[..., np.ndarray]] = {
    "joint_pos": lambda seen: seen.position,
    "joint_pos_rel": lambda seen: seen.position - seen.home,
    "joint_vel_rel": lambda seen: seen.velocity,
    "target_error": lambda seen: seen.targets - seen.position,
    "last_action": lambda seen: seen.action,
    "command": lambda seen: seen.goal,
    "pose_command": lambda seen: np.concatenate([seen.goal, seen.goal_quat]),
    "goal_position": lambda seen: seen.goal,
    "goal_orientation": lambda seen: seen.goal_quat,
    "ee_position": lambda seen: seen.ee,
    "ee_orientation": lambda seen: seen.ee_quat,
    "ee_to_goal": lambda seen: seen.goal - seen.ee,
    "ee_turn_to_goal": _turn,
    "object_position": lambda seen, object="cube": seen.objects[object].position,
    "object_orientation": lambda seen, object="cube": seen.objects[object].quaternion,
    "object_heading": lambda seen, object="cube": matrix(seen.objects[object].quaternion)[:2, 0],
    "ee_to_object": lambda seen, object="cube": seen.objects[object].position - seen.ee,
    "ee_to_objects": lambda seen, objects, limit: _ways(seen, objects, limit),
    "object_turn_to_goal": _object_turn,
    "object_to_goal": lambda seen, object="cube": seen.goal - seen.objects[object].position,
}


class Observer:
    """Computes a policy's observations.

    Args:
        metadata: metadata of the policy.
        goal: position in the robot's root frame [m], optionally followed by an orientation (wxyz); None: the middle of the task's
            region.
        places: source of object positions.
        pictures: source of the pictures of the policy's cameras, by name, for a feedback and a time [s].

    Attributes:
        objects: names of the objects that the policy observes.

    Raises:
        UserError: the policy observes something that is not available on an arm, or the task has no goal.
    """

    def __init__(
        self,
        metadata: Mapping[str, Any],
        body: Body,
        goal: list[float] | None,
        places: Places,
        pictures: Pictures = no_pictures,
    ):
        self._terms, self._body, self._places, self.pictures = metadata["observations"], body, places, pictures
        self._home = np.array(metadata["joints"]["home"], float)
        if any("term" not in term for term in self._terms):
            raise UserError("the file does not say which terms it observes: export the policy again")
        if unknown := [t["term"] for t in self._terms if t["term"] not in TERMS]:
            raise UserError(f"the policy observes {', '.join(unknown)}, not available on an arm: train with {', '.join(TERMS)}")
        params = [term["params"] for term in self._terms]
        named = [name for p in params for name in (*([p["object"]] if "object" in p else []), *p.get("objects", ()))]
        self.objects = tuple(dict.fromkeys(named))
        if unknown := [name for name in self.objects if name not in metadata["objects"]]:
            raise UserError(
                f"the policy observes {', '.join(unknown)}, which differs between episodes: deploy works with fixed objects only"
            )
        self.goal, self.goal_quat = _goal(metadata["command"], goal)

    def __call__(self, feedback: Feedback, targets: np.ndarray, action: np.ndarray, now: float) -> dict[str, np.ndarray]:
        """Computes the observations, by the names of the policy's terms.

        Args:
            targets: the joints' targets in effect [rad or m].
            action: the last action.
            now: the time [s].

        Raises:
            ValueError: an object is lost.
        """
        ee, ee_quat = self._body.ee(feedback.position)
        objects = {name: self._places.find(name, now) for name in self.objects}
        kept = (feedback.position, feedback.velocity, self._home, targets, action, ee - self._body.base, ee_quat)
        seen = Seen(*kept, self.goal, self.goal_quat, objects)
        return {term["name"]: TERMS[term["term"]](seen, **term["params"]) for term in self._terms}


def _goal(command: Mapping[str, Any], given: list[float] | None) -> tuple[np.ndarray, np.ndarray]:
    """Returns the goal's position [m] and orientation (wxyz)."""
    still = np.array([1.0, 0.0, 0.0, 0.0])
    if command.get("quat"):
        still = np.array(command["quat"], float)
    elif all(axis in command for axis in ("roll", "pitch", "yaw")):
        roll, pitch, yaw = (float(np.mean(command[axis])) / 2 for axis in ("roll", "pitch", "yaw"))
        turns = [np.array([np.cos(h), *(np.sin(h) * np.eye(3)[i])]) for i, h in enumerate((roll, pitch, yaw))]
        still = product(turns[2], product(turns[1], turns[0]))
    if given is None:
        if not all(axis in command for axis in "xyz"):
            raise UserError("the task has no region for goals: pass --goal X,Y,Z")
        return np.array([np.mean(command[axis]) for axis in "xyz"]), still
    if len(given) not in (3, 7):
        raise UserError("--goal takes x,y,z [m], optionally followed by an orientation w,x,y,z")
    turned = np.array(given[3:], float) if len(given) == 7 else still
    if not 0.99 < np.linalg.norm(turned) < 1.01:
        raise UserError("--goal takes an orientation of length 1 (w,x,y,z)")
    return np.array(given[:3], float), turned
