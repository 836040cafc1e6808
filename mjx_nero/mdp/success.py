"""Success terms: (View, *, params) -> whether the task is done at this step.

Also the distances that they judge, and how long success must hold.
"""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_nero import math
from mjx_nero.config.bounds import Count, Positive
from mjx_nero.mdp.memory import Latch
from mjx_nero.types import Key, UserError, View


def object_distance(view: View, *, object: str = "cube") -> Float[Array, ""]:
    """Distance from the object to the goal [m]."""
    return jnp.linalg.norm(view.goal_pos_w - view.objects[object].pos_w)


def ee_distance(view: View) -> Float[Array, ""]:
    """Distance from the end effector to the goal [m]."""
    return jnp.linalg.norm(view.goal_pos_w - view.ee_pos_w)


def ee_angle(view: View) -> Float[Array, ""]:
    """Smallest angle between the end effector's orientation and the goal's [rad]."""
    between = math.quat_mul(math.quat_conj(view.ee_quat_w), view.goal_quat_w)
    return 2.0 * jnp.arctan2(jnp.linalg.norm(between[1:]), jnp.abs(between[0]))


def object_at_goal(view: View, *, threshold: Positive, object: str = "cube") -> Bool[Array, ""]:
    """True if the object is within ``threshold`` [m] of the goal."""
    return object_distance(view, object=object) < threshold


def ee_at_goal(view: View, *, threshold: Positive) -> Bool[Array, ""]:
    """True if the end effector is within ``threshold`` [m] of the goal."""
    return ee_distance(view) < threshold


def ee_at_pose(view: View, *, threshold: Positive, angle: Positive) -> Bool[Array, ""]:
    """True if the end effector is within ``threshold`` [m] and ``angle`` [rad] of the goal."""
    return ee_at_goal(view, threshold=threshold) & (ee_angle(view) < angle)


def object_placed(
    view: View, *, threshold: Positive, max_speed: Positive, clearance: float, object: str = "cube"
) -> Bool[Array, ""]:
    """True if the object rests at the goal and the hand has let go.

    The object is within ``threshold`` [m] of the goal and slower than ``max_speed`` [m/s], and the grasp point is more than
    ``clearance`` [m] away.
    """
    still = jnp.linalg.norm(view.objects[object].linvel_w) < max_speed
    free = jnp.linalg.norm(view.ee_pos_w - view.objects[object].pos_w) > clearance
    return object_at_goal(view, threshold=threshold, object=object) & still & free


def touched(view: View) -> Bool[Array, ""]:
    """True if something touches an obstacle, or the robot touches itself.

    Raises:
        UserError: the scene does not measure touch.
    """
    if "touch" not in view.readings:
        raise UserError("terms of touch need scene.obstacles or scene.self_collision, and this task has neither")
    return view.readings["touch"] > 0


def pads_are_free(view: View, term: str) -> Bool[Array, ""]:
    """True if the finger sensors read no contact.

    Args:
        term: name of the term that asks, for the message.

    Raises:
        UserError: the scene has no finger sensors.
    """
    if "fingers" not in view.readings:
        without = "this task has none, or its backend cannot measure them"
        raise UserError(f"{term} needs 'fingers' among scene.sensors, but {without}")
    return jnp.max(view.readings["fingers"]) == 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class AtGoalUntouched(Latch):
    """Success at the goal, if nothing has been touched since the start (see ``View.readings``).

    Attributes:
        threshold: greatest distance from the goal [m].
        object: the object that must be there. None: the end effector.
    """

    threshold: Positive
    object: str | None = None

    def step(self, memory: Bool[Array, ""], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Records a touch, and returns whether this step is a success."""
        memory = memory | touched(view)
        distance = ee_distance(view) if self.object is None else object_distance(view, object=self.object)
        return memory, (distance < self.threshold) & ~memory


def object_turn(view: View, *, fold: Count, object: str = "cube") -> Float[Array, "3"]:
    """Rotation vector that turns the object to the goal's orientation, in world axes [rad].

    If the object looks the same ``fold`` times in a full turn about its z axis, the shortest such rotation.
    """
    goal, seen = view.goal_quat_w, view.objects[object].quat_w
    turned = [math.axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(2 * jnp.pi * i / fold)) for i in range(fold)]
    ways = jnp.stack([math.quat_log(math.quat_mul(math.quat_mul(goal, turn), math.quat_conj(seen))) for turn in turned])
    return ways[jnp.argmin(jnp.linalg.norm(ways, axis=1))]


def object_at_pose(view: View, *, threshold: Positive, angle: Positive, fold: Count = 1, object: str = "cube") -> Bool[Array, ""]:
    """True if the object is within ``threshold`` [m] and ``angle`` [rad] of the goal (see ``object_turn``)."""
    turned = jnp.linalg.norm(object_turn(view, fold=fold, object=object)) < angle
    return object_at_goal(view, threshold=threshold, object=object) & turned


@dataclasses.dataclass(frozen=True)
class Hold:
    """Counts for how many steps in a row a condition has been true.

    Attributes:
        steps: number of steps in a row that make a success.
    """

    steps: int

    def init(self, key: Key, view: View) -> Int[Array, ""]:
        """Starts at zero."""
        return jnp.zeros((), jnp.int32)

    def step(self, memory: Int[Array, ""], met: Bool[Array, ""]) -> tuple[Int[Array, ""], Bool[Array, ""]]:
        """Adds one, or starts over; returns whether the count is reached."""
        memory = jnp.where(met, memory + 1, 0)
        return memory, memory >= self.steps
