"""Reset events: (key, start, *, params) -> start, applied in order at every reset."""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.config.bounds import Counts, NonNegative, Places, Positive, Range
from mjx_nero.types import Bank, Key, Start, UserError


def object_position_uniform(key: Key, start: Start, *, x: Places, y: Places, z: Places, object: str = "cube") -> Start:
    """Puts the object at a uniform ``x`` and ``y`` in the world, ``z`` above its height in the scene [m]."""
    low, high = jnp.array([x, y, z]).T
    height = start.object_pos_w[object] * jnp.array([0.0, 0.0, 1.0])
    pos = height + jax.random.uniform(key, (3,), minval=low, maxval=high)
    return dataclasses.replace(start, object_pos_w={**start.object_pos_w, object: pos})


def object_apart_from_goal(key: Key, start: Start, *, x: Places, y: Places, apart: NonNegative, object: str = "cube") -> Start:
    """Puts the object at a uniform ``x`` and ``y`` in the world, at least ``apart`` from the goal along the table [m].

    Of sixteen random places, it takes the first that is far enough, or else the farthest.
    """
    low, high = jnp.array([x, y]).T
    places = jax.random.uniform(key, (16, 2), minval=low, maxval=high)
    away = jnp.linalg.norm(places - start.goal_pos_w[:2], axis=1)
    place = places[jnp.argmax(jnp.minimum(away, apart))]  # all that are far enough tie, and argmax takes the first
    pos = jnp.append(place, start.object_pos_w[object][2])
    return dataclasses.replace(start, object_pos_w={**start.object_pos_w, object: pos})


def scatter(
    key: Key,
    start: Start,
    *,
    objects: tuple[str, ...],
    count: Counts,
    x: Places,
    y: Places,
    pitch: Positive,
    jitter: NonNegative,
    away: tuple[float, float],
) -> Start:
    """Puts some of the objects on the table, picks the commanded one, and parks the others far away.

    The commanded object lies at a uniform point of the box ``x``, ``y`` in the world. The others lie in the eight cells of a grid
    around it. All are turned about the vertical at random. Every choice of objects, cells and command is equally likely.

    Args:
        objects: up to nine; ``start.target`` is the index of the commanded one.
        count: least and greatest number of objects on the table.
        x, y: ranges of the commanded object [m].
        pitch: distance between neighbouring cells [m].
        jitter: greatest offset of an object from its cell's middle, along x and y [m]. Two objects are at least ``pitch - 2
            jitter`` apart.
        away: x and y of the first parking place; the next ones lie ``pitch`` further along x [m].

    Raises:
        UserError: there are more objects than cells, or fewer objects than ``count`` asks for.
    """
    n = len(objects)
    if not 1 <= count[0] <= count[1] <= n <= 9:
        raise UserError(
            f"scatter takes up to 9 objects and a count from 1 to their number, got {n} objects and the count {count}"
        )
    k_rank, k_count, k_at, k_cell, k_jitter, k_turn = jax.random.split(key, 6)
    rank = jnp.argsort(jax.random.uniform(k_rank, (n,)))  # rank 0 is commanded; the next ranks are on the table
    there = rank < jax.random.randint(k_count, (), count[0], count[1] + 1)
    low, high = jnp.array([x, y]).T
    at = jax.random.uniform(k_at, (2,), minval=low, maxval=high)
    cells = jnp.array([(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j], jnp.float32)
    cells = pitch * cells[jnp.argsort(jax.random.uniform(k_cell, (8,)))]
    cells += jax.random.uniform(k_jitter, (8, 2), minval=-jitter, maxval=jitter)
    lying = at + jnp.concatenate([jnp.zeros((1, 2)), cells])[rank]
    parked = jnp.array(away) + pitch * jnp.stack([jnp.arange(n), jnp.zeros(n)], axis=1)
    place = jnp.where(there[:, None], lying, parked)
    turns = jax.random.uniform(k_turn, (n,), minval=-jnp.pi, maxval=jnp.pi)
    pos, quat = dict(start.object_pos_w), dict(start.object_quat_w)
    for i, name in enumerate(objects):
        pos[name] = jnp.append(place[i], pos[name][2])
        quat[name] = math.quat_mul(math.axis_angle(jnp.array([0.0, 0.0, 1.0]), turns[i]), quat[name])
    return dataclasses.replace(start, object_pos_w=pos, object_quat_w=quat, target=jnp.argmin(rank))


def objects_apart(key: Key, start: Start, *, objects: tuple[str, ...], x: Places, y: Places, apart: Positive) -> Start:
    """Puts objects at uniform ``x`` and ``y`` in the world, at least ``apart`` from one another along the longer side [m].

    The draw is exact and needs no retry. It shortens that side by the gaps, sorts uniform points on the rest, puts the gaps back,
    and deals the points to the objects in random order.

    Raises:
        UserError: the objects do not fit.
    """
    sides, n = (x, y), len(objects)
    along = int(y[1] - y[0] > x[1] - x[0])
    free = sides[along][1] - sides[along][0] - (n - 1) * apart
    if free < 0:
        raise UserError(f"{n} objects {apart:g} m apart need {(n - 1) * apart:g} m, but x {x} and y {y} are shorter")
    k_along, k_aside, k_order = jax.random.split(key, 3)
    place = sides[along][0] + free * jnp.sort(jax.random.uniform(k_along, (n,))) + apart * jnp.arange(n)
    aside = jax.random.uniform(k_aside, (n,), minval=sides[1 - along][0], maxval=sides[1 - along][1])
    at = jnp.stack([place, aside][:: 1 - 2 * along])[:, jax.random.permutation(k_order, n)]
    pos = {name: jnp.append(at[:, i], start.object_pos_w[name][2]) for i, name in enumerate(objects)}
    return dataclasses.replace(start, object_pos_w={**start.object_pos_w, **pos})


def object_yaw_uniform(key: Key, start: Start, *, yaw: Range, object: str = "cube") -> Start:
    """Turns the object about the vertical by a uniform angle [rad]."""
    angle = jax.random.uniform(key, (), minval=yaw[0], maxval=yaw[1])
    quat = math.quat_mul(math.axis_angle(jnp.array([0.0, 0.0, 1.0]), angle), start.object_quat_w[object])
    return dataclasses.replace(start, object_quat_w={**start.object_quat_w, object: quat})


def joints_by_scale(key: Key, start: Start, *, low: float, high: float) -> Start:
    """Multiplies every joint position by a uniform factor from ``low`` to ``high``. Isaac Lab's ``reset_joints_by_scale``."""
    joint_pos = start.joint_pos
    return dataclasses.replace(start, joint_pos=joint_pos * jax.random.uniform(key, joint_pos.shape, minval=low, maxval=high))


def joint_turned(key: Key, start: Start, *, joint: int, by: Range) -> Start:
    """Moves one joint, counted from 0, by a uniform offset [rad or m]. The caller clips to the joint ranges."""
    offset = jax.random.uniform(key, minval=by[0], maxval=by[1])
    return dataclasses.replace(start, joint_pos=start.joint_pos.at[joint].add(offset))


def visited(key: Key, start: Start, *, bank: Bank, chances: Float[Array, " phases"]) -> Start:
    """Replaces the start by a state that an expert has visited, with the given probabilities.

    Args:
        bank: visited states, one per row.
        chances: probabilities of the usual start and of each of the expert's phases (``curriculum.chances``).
    """
    phases, n = len(chances) - 1, len(bank.arrived)
    which, at = jax.random.uniform(key, (2,))
    phase = jnp.minimum(jnp.sum(which >= jnp.cumsum(chances)), phases)
    row = jnp.maximum(phase - 1, 0) + phases * (at * (n // phases)).astype(jnp.int32)
    found, arrived = jax.tree.map(lambda x: x[row], (bank.start, bank.arrived))
    goal = {name: jnp.where(arrived, getattr(found, name), getattr(start, name)) for name in ("goal_pos_w", "goal_quat_w")}
    found = dataclasses.replace(found, phase=phase, **goal)
    return jax.tree.map(lambda there, usual: jnp.where(phase > 0, there, usual), found, start)
