"""Obstacle terms: (key, view, *, params) -> boxes by name, drawn once an episode's start and goal are known.

Boxes that a term does not name stay where the scene parks them, below the table.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import Positive, PositiveRange, Range
from mjx_nero.types import Key, ObstacleView, UserError, View

_UP = np.array([0.0, 0.0, 1.0], np.float32)
_PARKED, _SMALL = np.array([0.0, 0.0, -0.5], np.float32), np.full(3, 0.05, np.float32)  # as ``ObstacleCfg`` has them
_BELOW, _ABOUT = (0.06, 0.1), (-0.03, 0.02)  # [m] a shelf's board is this far below the goal, its end's top this far above
_DEEP = 0.05  # [m] a shelf's board reaches this much farther behind the goal than in front of it
Box = tuple[Float[Array, "3"], Float[Array, "3"]]  # centre; edges along the path, across it and up [m]


@dataclasses.dataclass(frozen=True)
class _Site:
    """A point on the straight path from start to goal, and the sizes drawn for the obstacle there [m].

    Attributes:
        goal: the end of the path.
        along, side: horizontal unit vectors towards the goal and to its left.
        at: the point on the path.
        high: height of the obstacle's top.
        ceiling: greatest height of any top.
        thick: size along the path.
        wide: size across the path.
        board: thickness of a shelf's board.
        room: free space around start and goal.
    """

    goal: Float[Array, "3"]
    along: Float[Array, "3"]
    side: Float[Array, "3"]
    at: Float[Array, "3"]
    high: Float[Array, ""]
    ceiling: Float[Array, ""]
    thick: Float[Array, ""]
    wide: Float[Array, ""]
    board: float
    room: float


def across(
    key: Key,
    view: View,
    *,
    kinds: tuple[str, ...] = ("wall", "bar", "posts", "shelf"),
    names: tuple[str, str] = ("one", "two"),
    thickness: PositiveRange,
    width: PositiveRange,
    above: Range,
    top: Positive,
    room: Positive,
    object: str | None = None,
) -> dict[str, ObstacleView]:
    """Draws one of ``kinds`` between start and goal, facing the straight path; nothing if the two are too close.

    - ``wall``: a slab that stands on the table,
    - ``bar``: a beam in the air,
    - ``posts``: two posts side by side, with or without room to pass between them,
    - ``shelf``: a board below the goal, with an upright end that faces the start.

    Args:
        kinds: kinds to draw from, all equally likely.
        names: names of the two boxes that make an obstacle.
        thickness: range of the thickness [m]. A shelf's board has the least.
        width: range of the size across the path [m].
        above: range of the top's height above the path [m].
        top: greatest height above the robot's foot [m].
        room: free space around start and goal [m].
        object: the object that travels to the goal; None: the end effector.

    Raises:
        UserError: a kind is unknown.
    """
    if not kinds or set(kinds) - set(KINDS):
        raise UserError(f"obstacles.params.kinds takes some of {', '.join(KINDS)}, got {', '.join(kinds) or 'none'}")
    k = jax.random.split(key, 7)
    start, goal = view.ee_pos_w if object is None else view.objects[object].pos_w, view.goal_pos_w
    length = jnp.linalg.norm((goal - start)[:2])
    along = jnp.append((goal - start)[:2] / jnp.maximum(length, 1e-6), 0.0)
    thick, wide = _uniform(k[0], thickness), _uniform(k[1], width)
    keep = (room + thick / 2) / jnp.maximum(length, 1e-6)
    at = start + (keep + (1 - 2 * keep) * jax.random.uniform(k[2])) * (goal - start)
    side, ceiling = jnp.array([-along[1], along[0], 0.0]), view.root_pos_w[2] + top
    high = jnp.minimum(at[2] + _uniform(k[3], above), ceiling)
    site = _Site(goal, along, side, at, high, ceiling, thick=thick, wide=wide, board=thickness[0], room=room)
    made = [_MAKERS[kind](site, k[4:6]) for kind in kinds]
    kind, fits = jax.random.randint(k[6], (), 0, len(kinds)), length > 2 * room + thick
    facing = math.axis_angle(jnp.asarray(_UP), jnp.arctan2(along[1], along[0]))
    chosen = {}
    for name, *boxes in zip(names, *made, strict=True):
        centre, edges = (jnp.stack(parts)[kind] for parts in zip(*boxes, strict=True))
        chosen[name] = _shown(centre, edges, facing, fits)
    return chosen


def _shown(centre: Float[Array, "3"], edges: Float[Array, "3"], facing: Float[Array, "4"], fits: Bool[Array, ""]) -> ObstacleView:
    """Shows a box if it fits, and parks it otherwise."""
    there = fits & (centre[2] > 0)
    return ObstacleView(pos_w=jnp.where(there, centre, _PARKED), quat_w=facing, size=jnp.where(there, edges, _SMALL))


def _wall(site: _Site, keys: Key) -> tuple[Box, Box]:
    return _box(site.at, 0.0, site.high, site.thick, site.wide), _parked()


def _bar(site: _Site, keys: Key) -> tuple[Box, Box]:
    return _box(site.at, site.high - site.thick, site.high, site.thick, site.wide), _parked()


def _posts(site: _Site, keys: Key) -> tuple[Box, Box]:
    gap = _uniform(keys[0], (0.5, 1.0)) * site.wide
    right, left = (_box(site.at + sign * gap / 2 * site.side, 0.0, site.high, site.thick, site.thick) for sign in (-1, 1))
    return right, left


def _shelf(site: _Site, keys: Key) -> tuple[Box, Box]:
    k_end, k_board = keys
    board, deep = site.goal[2] - _uniform(k_board, _BELOW), site.room + _DEEP
    under = _box(site.goal + (deep - site.room) / 2 * site.along, board - site.board, board, deep + site.room, site.wide)
    top = jnp.minimum(site.goal[2] + _uniform(k_end, _ABOUT), site.ceiling)
    return under, _box(site.goal - (site.room + site.thick / 2) * site.along, 0.0, top, site.thick, site.wide)


# Each builds a kind's two boxes from two keys.
_MAKERS = {"wall": _wall, "bar": _bar, "posts": _posts, "shelf": _shelf}
KINDS = tuple(_MAKERS)


def _box(centre: Float[Array, "3"], low, up, *edges) -> Box:
    """Makes a box from the height ``low`` to ``up``, with horizontal edges along the path and across it."""
    return jnp.append(centre[:2], (low + up) / 2), jnp.stack([*edges, up - low])


def _parked() -> Box:
    """Makes a parked box."""
    return jnp.asarray(_PARKED), jnp.asarray(_SMALL)


def _uniform(key: Key, bounds: tuple[float, float]) -> Float[Array, ""]:
    return jax.random.uniform(key, minval=bounds[0], maxval=bounds[1])
