"""Obstacles: (key, view, *, params) -> boxes by name, drawn once an episode's start and goal are. Those that are not named stay
where the scene has them, below the table."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from mjx_nero import math
from mjx_nero.config.bounds import Positive, PositiveRange, Range
from mjx_nero.types import Key, ObstacleView, UserError, View

_UP = np.array([0.0, 0.0, 1.0], np.float32)
_PARKED, _SMALL = np.array([0.0, 0.0, -0.5], np.float32), np.full(3, 0.05, np.float32)  # as ``scene.ObstacleCfg`` has it
_BELOW, _ABOUT = (0.06, 0.1), (-0.03, 0.02)  # [m] of a shelf: its board below the goal, the end's top about the goal's height
_DEEP = 0.05  # [m] a shelf's board reaches that much farther behind the goal than before it
Box = tuple[Float[Array, "3"], Float[Array, "3"]]  # centre, and edges along the way, across it and up [m]


@dataclasses.dataclass(frozen=True)
class _Site:
    """A place on the straight way from start to goal, and the sizes drawn for what is to stand there; lengths in m.

    Attributes:
        goal: the end of the way.
        along, side: horizontal unit vectors, to the goal and to the left of it.
        at: the point on the way.
        high: height of the top there.
        ceiling: the highest that any top may be.
        thick: along the way.
        wide: across it.
        board: thickness of a shelf's board.
        room: what start and goal have to themselves on every side.
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
    """One of ``kinds`` between start and goal, turned to face the straight way from one to the other; nothing where these are too
    close for it.

    - ``wall``: a slab that stands on the table,
    - ``bar``: a beam in the air,
    - ``posts``: two posts that stand side by side, too close to each other to pass between them, or with room for it,
    - ``shelf``: a board below the goal, with an upright end that faces the start.

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
    """A box where it fits, else one that is not there."""
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


# Kind -> its two boxes, by two keys.
_MAKERS = {"wall": _wall, "bar": _bar, "posts": _posts, "shelf": _shelf}
KINDS = tuple(_MAKERS)


def _box(centre: Float[Array, "3"], low, up, *edges) -> Box:
    """From the height ``low`` to ``up``, with horizontal edges along the way and across it."""
    return jnp.append(centre[:2], (low + up) / 2), jnp.stack([*edges, up - low])


def _parked() -> Box:
    """A box that is not there."""
    return jnp.asarray(_PARKED), jnp.asarray(_SMALL)


def _uniform(key: Key, bounds: tuple[float, float]) -> Float[Array, ""]:
    return jax.random.uniform(key, minval=bounds[0], maxval=bounds[1])
