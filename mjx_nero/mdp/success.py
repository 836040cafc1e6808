"""Success: (View, *, params) -> whether the task is done at this step; the distance that it is about; how long it holds."""

import dataclasses

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from mjx_nero import math
from mjx_nero.config.bounds import Count, Positive
from mjx_nero.types import Key, UserError, View


def object_distance(view: View, *, object: str = "cube") -> Float[Array, ""]:
    """From the object to the goal [m]."""
    return jnp.linalg.norm(view.goal_pos_w - view.objects[object].pos_w)


def ee_distance(view: View) -> Float[Array, ""]:
    """From the end effector to the goal [m]."""
    return jnp.linalg.norm(view.goal_pos_w - view.ee_pos_w)


def ee_angle(view: View) -> Float[Array, ""]:
    """From the end effector's orientation to the goal's, the short way [rad]."""
    between = math.quat_mul(math.quat_conj(view.ee_quat_w), view.goal_quat_w)
    return 2.0 * jnp.arctan2(jnp.linalg.norm(between[1:]), jnp.abs(between[0]))


def object_at_goal(view: View, *, threshold: Positive, object: str = "cube") -> Bool[Array, ""]:
    """The object within ``threshold`` [m] of the goal."""
    return object_distance(view, object=object) < threshold


def ee_at_goal(view: View, *, threshold: Positive) -> Bool[Array, ""]:
    """The end effector within ``threshold`` [m] of the goal."""
    return ee_distance(view) < threshold


def ee_at_pose(view: View, *, threshold: Positive, angle: Positive) -> Bool[Array, ""]:
    """The end effector within ``threshold`` [m] and ``angle`` [rad] of the goal."""
    return ee_at_goal(view, threshold=threshold) & (ee_angle(view) < angle)


def object_placed(
    view: View, *, threshold: Positive, max_speed: Positive, clearance: float, object: str = "cube"
) -> Bool[Array, ""]:
    """The object within ``threshold`` [m] of the goal, slower than ``max_speed`` [m/s], and let go of: the grasp point is at
    least ``clearance`` [m] away."""
    still = jnp.linalg.norm(view.objects[object].linvel_w) < max_speed
    free = jnp.linalg.norm(view.ee_pos_w - view.objects[object].pos_w) > clearance
    return object_at_goal(view, threshold=threshold, object=object) & still & free


def touched(view: View) -> Bool[Array, ""]:
    """An obstacle is touched, or the robot touches itself.

    Raises:
        UserError: the scene does not measure it.
    """
    if "touch" not in view.readings:
        raise UserError("terms of touch need scene.obstacles or scene.self_collision, and this task has neither")
    return view.readings["touch"] > 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class AtGoalUntouched:
    """At the goal, and nothing has been touched since the start (``View.readings``).

    Attributes:
        threshold: how near to the goal [m].
        object: what has to be there; None: the end effector.
    """

    threshold: Positive
    object: str | None = None

    def init(self, key: Key, view: View) -> Bool[Array, ""]:
        """Nothing yet."""
        return jnp.zeros((), bool)

    def step(self, memory: Bool[Array, ""], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
        """Whether anything has been touched, and whether this is success."""
        memory = memory | touched(view)
        distance = ee_distance(view) if self.object is None else object_distance(view, object=self.object)
        return memory, (distance < self.threshold) & ~memory


def object_turn(view: View, *, fold: Count, object: str = "cube") -> Float[Array, "3"]:
    """The rotation vector that turns the object to the goal's orientation, in the world's axes [rad]; of an object that looks the
    same ``fold`` times in a full turn about its z axis, the shortest of those that do."""
    goal, seen = view.goal_quat_w, view.objects[object].quat_w
    turned = [math.axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(2 * jnp.pi * i / fold)) for i in range(fold)]
    ways = jnp.stack([math.quat_log(math.quat_mul(math.quat_mul(goal, turn), math.quat_conj(seen))) for turn in turned])
    return ways[jnp.argmin(jnp.linalg.norm(ways, axis=1))]


def object_at_pose(view: View, *, threshold: Positive, angle: Positive, fold: Count = 1, object: str = "cube") -> Bool[Array, ""]:
    """The object within ``threshold`` [m] and ``angle`` [rad] of the goal (see ``object_turn``)."""
    turned = jnp.linalg.norm(object_turn(view, fold=fold, object=object)) < angle
    return object_at_goal(view, threshold=threshold, object=object) & turned


@dataclasses.dataclass(frozen=True)
class Hold:
    """Remembers for how many steps, up to now, something has been true without a break.

    Attributes:
        steps: after so many it counts.
    """

    steps: int

    def init(self, key: Key, view: View) -> Int[Array, ""]:
        """None yet."""
        return jnp.zeros((), jnp.int32)

    def step(self, memory: Int[Array, ""], met: Bool[Array, ""]) -> tuple[Int[Array, ""], Bool[Array, ""]]:
        """One more, or none again; and whether it counts."""
        memory = jnp.where(met, memory + 1, 0)
        return memory, memory >= self.steps
