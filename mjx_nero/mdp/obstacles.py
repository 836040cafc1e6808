"""Obstacles: (key, view, *, params) -> boxes by name, drawn once an episode's start and goal are. Those that are not named stay
where the scene has them, below the table."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.bounds import Positive, PositiveRange, Range
from mjx_nero.types import Key, ObstacleView, UserError, View

KINDS = ("wall", "bar", "posts", "shelf")
_UP = np.array([0.0, 0.0, 1.0], np.float32)
_PARKED, _SMALL = np.array([0.0, 0.0, -0.5], np.float32), np.full(3, 0.05, np.float32)  # as ``scene.ObstacleCfg`` has it
Box = tuple[Float[Array, "3"], Float[Array, "3"]]  # centre, and edges along the way, across it and up [m]


def across(
    key: Key,
    view: View,
    *,
    kinds: tuple[str, ...] = KINDS,
    names: tuple[str, str] = ("one", "two"),
    thickness: PositiveRange,
    width: PositiveRange,
    above: Range,
    top: Positive,
    room: Positive,
    object: str | None = None,
) -> dict[str, ObstacleView]:
    """One of ``kinds`` between start and goal, turned to face the straight way from one to the other:

    - ``wall``: a slab that stands on the table,
    - ``bar``: a beam in the air,
    - ``posts``: two posts that stand side by side, too close to each other to pass between them, or with room for it,
    - ``shelf``: a board below the goal, with an upright end that faces the start.

    Where start and goal are too close for any of it, nothing stands there.

    Args:
        kinds: drawn from, each as likely.
        names: of the two boxes that it takes at most.
        thickness: of all but the shelf's board, whose is the lowest [m].
        width: across the way [m].
        above: how far the top is above the straight way there [m].
        top: the highest that anything may be above the robot's foot [m].
        room: what start and goal have to themselves on every side [m].
        object: what goes to the goal; None: the end effector.

    Raises:
        UserError: there is no such kind.
    """
    if not kinds or set(kinds) - set(KINDS):
        raise UserError(f"obstacles.params.kinds takes some of {', '.join(KINDS)}, got {', '.join(kinds) or 'none'}")
    start = view.ee_pos_w if object is None else view.objects[object].pos_w
    goal, k = view.goal_pos_w, jax.random.split(key, 7)
    way = goal - start
    length = jnp.linalg.norm(way[:2])
    along = jnp.append(way[:2] / jnp.maximum(length, 1e-6), 0.0)
    side = jnp.array([-along[1], along[0], 0.0])

    thick, wide = _uniform(k[0], thickness), _uniform(k[1], width)
    keep = (room + thick / 2) / jnp.maximum(length, 1e-6)
    share = keep + (1 - 2 * keep) * jax.random.uniform(k[2])
    at = start + share * way
    high = jnp.minimum(at[2] + _uniform(k[3], above), view.root_pos_w[2] + top)
    gap = _uniform(k[4], (0.5, 1.0)) * wide
    deep = room + 0.05

    def box(centre, low, up, *edges) -> Box:
        return jnp.append(centre[:2], (low + up) / 2), jnp.stack([*edges, up - low])

    parked: Box = (jnp.asarray(_PARKED), jnp.asarray(_SMALL))
    board = goal[2] - _uniform(k[5], (0.06, 0.1))
    end = goal - (room + thick / 2) * along
    ends = jnp.minimum(goal[2] + _uniform(k[5], (-0.03, 0.02)), view.root_pos_w[2] + top)
    made: dict[str, tuple[Box, Box]] = {
        "wall": (box(at, 0.0, high, thick, wide), parked),
        "bar": (box(at, high - thick, high, thick, wide), parked),
        "posts": tuple(box(at + sign * gap / 2 * side, 0.0, high, thick, thick) for sign in (-1, 1)),  # type: ignore[dict-item]
        "shelf": (
            box(goal + (deep - room) / 2 * along, board - thickness[0], board, deep + room, wide),
            box(end, 0.0, ends, thick, wide),
        ),
    }
    kind = jax.random.randint(k[6], (), 0, len(kinds))
    fits = length > 2 * room + thick
    out, facing = {}, math.axis_angle(jnp.asarray(_UP), jnp.arctan2(along[1], along[0]))
    for i, name in enumerate(names):
        centre, edges = (jnp.stack([made[each][i][part] for each in kinds])[kind] for part in (0, 1))
        there = fits & (centre[2] > 0)
        out[name] = ObstacleView(pos_w=jnp.where(there, centre, _PARKED), quat_w=facing, size=jnp.where(there, edges, _SMALL))
    return out


def _uniform(key: Key, bounds: tuple[float, float]) -> Float[Array, ""]:
    return jax.random.uniform(key, minval=bounds[0], maxval=bounds[1])
