"""Appearance randomization: (key, model, *, params) -> {field: (rows, values)}, like ``mdp.randomization``, on the drawn model.

Rows are cameras, lights, geoms and materials. The physics has a model of its own, so none of this affects it.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Places, PositiveRange, Share
from mjx_nero.mdp.randomization import Drawn, Model
from mjx_nero.types import Key


def camera_pose(key: Key, model: Model, *, cameras: tuple[str, ...], offset: NonNegative, turn: NonNegative) -> Drawn:
    """Moves cameras by up to ``offset`` [m] along each axis, and turns them by up to ``turn`` [rad] about each of their axes."""
    rows = model.rows("camera", cameras)
    k_offset, k_turn = jax.random.split(key)
    pos = model.fields["cam_pos"][rows] + offset * _within(k_offset, (len(rows), 3))
    turned = jax.vmap(math.quat_exp)(turn * _within(k_turn, (len(rows), 3)))
    quat = jax.vmap(math.quat_mul)(model.fields["cam_quat"][rows], turned)
    return {"cam_pos": (rows, pos), "cam_quat": (rows, quat)}


def camera_fovy(key: Key, model: Model, *, cameras: tuple[str, ...], scale: PositiveRange) -> Drawn:
    """Scales the cameras' vertical fields of view, by a uniform factor for each."""
    rows = model.rows("camera", cameras)
    return {
        "cam_fovy": (rows, model.fields["cam_fovy"][rows] * jax.random.uniform(key, rows.shape, minval=scale[0], maxval=scale[1]))
    }


def lights(key: Key, model: Model, *, turn: NonNegative, brightness: PositiveRange, tint: Share, dark: Share = 0.0) -> Drawn:
    """Varies every light: direction, brightness and colour.

    Each turns by up to ``turn`` about each axis [rad]; its brightness gets a uniform factor, each channel a factor of up to 1 +-
    ``tint``; and it is off with probability ``dark``.
    """
    rows = np.arange(len(model.fields["light_dir"]))
    k_turn, k_bright, k_tint, k_dark = jax.random.split(key, 4)
    turned = jax.vmap(math.quat_exp)(turn * _within(k_turn, (len(rows), 3)))
    direction = jax.vmap(math.rotate)(turned, model.fields["light_dir"][rows])
    factor = jax.random.uniform(k_bright, (len(rows), 1), minval=brightness[0], maxval=brightness[1])
    factor *= 1 - jax.random.bernoulli(k_dark, dark, (len(rows), 1))
    color = model.fields["light_diffuse"][rows] * factor * (1 + tint * _within(k_tint, (len(rows), 3)))
    return {"light_diffuse": (rows, color), "light_dir": (rows, direction)}


def colors(key: Key, model: Model, *, geoms: tuple[str, ...], change: Share, shade: PositiveRange = (1.0, 1.0)) -> Drawn:
    """Moves the colours of geoms towards random ones by a uniform share of up to ``change``, and multiplies them by ``shade``."""
    rows = model.rows("geom", geoms)
    return {"geom_rgba": (rows, _recolored(key, model.fields["geom_rgba"][rows], change, shade))}


def materials(key: Key, model: Model, *, change: Share, shade: PositiveRange = (1.0, 1.0)) -> Drawn:
    """Varies the colours of all materials (the robot's) as ``colors`` varies those of geoms."""
    rows = np.arange(len(model.fields["mat_rgba"]))
    return {"mat_rgba": (rows, _recolored(key, model.fields["mat_rgba"][rows], change, shade))}


def photographs(
    key: Key, model: Model, *, geoms: tuple[str, ...], share: Share = 1.0, shade: PositiveRange = (0.6, 1.2)
) -> Drawn:
    """Shows a random photograph of ``SceneCfg.photographs`` on each geom, with probability ``share`` and multiplied by ``shade``.

    Without photographs it does nothing.
    """
    if not (shown := _materials(model, "photograph_")).size:
        return {}
    rows = model.rows("geom", geoms)
    k_which, k_there, k_shade = jax.random.split(key, 3)
    there = jax.random.bernoulli(k_there, share, rows.shape)
    plain = jax.random.uniform(k_shade, (len(rows), 1), minval=shade[0], maxval=shade[1]) * jnp.ones((1, 3))
    rgba = model.fields["geom_rgba"][rows]
    seen = rgba.at[:, :3].set(jnp.where(there[:, None], jnp.minimum(plain, 1.0), rgba[:, :3]))
    return {"geom_matid": (rows, _chosen(k_which, model, rows, shown, there)), "geom_rgba": (rows, seen)}


def patterns(key: Key, model: Model, *, geoms: tuple[str, ...] = (), share: Share) -> Drawn:
    """Shows a random pattern of ``SceneCfg.patterns`` on each geom, in the geom's colour, with probability ``share``.

    Without patterns it does nothing.

    Args:
        geoms: their names. Empty: all of the robot's geoms, which then share one pattern.
    """
    if not (shown := _materials(model, "pattern_")).size:
        return {}
    rows = model.rows("geom", geoms) if geoms else np.array(list(model.index["robot"].values()), int)
    k_which, k_there = jax.random.split(key)
    if geoms:
        there = jax.random.bernoulli(k_there, share, rows.shape)
        return {"geom_matid": (rows, _chosen(k_which, model, rows, shown, there))}
    own, there = model.fields["geom_matid"][rows], jax.random.bernoulli(k_there, share)
    rgba = jnp.where(there, model.fields["mat_rgba"][own], model.fields["geom_rgba"][rows])  # the old material held the colour
    which = jnp.asarray(shown)[jax.random.randint(k_which, (), 0, len(shown))]
    return {"geom_matid": (rows, jnp.where(there, which, own)), "geom_rgba": (rows, rgba)}


def _materials(model: Model, prefix: str) -> np.ndarray:
    return np.array([row for name, row in model.index["material"].items() if name.startswith(prefix)], int)


def _chosen(key: Key, model: Model, rows: np.ndarray, shown: np.ndarray, there: Array) -> Array:
    which = jnp.asarray(shown, jnp.int32)[jax.random.randint(key, rows.shape, 0, len(shown))]
    return jnp.where(there, which, model.fields["geom_matid"][rows])


def places(key: Key, model: Model, *, geoms: tuple[str, ...], x: Places, y: Places, z: Places, there: Share = 1.0) -> Drawn:
    """Puts geoms without collisions at random places, turned about the vertical at random.

    Each one shows with probability ``there``; otherwise it is hidden below the table.
    """
    rows = model.rows("geom", geoms)
    k_pos, k_turn, k_there = jax.random.split(key, 3)
    low, high = (jnp.array(ends) for ends in zip(x, y, z, strict=True))
    pos = low + (high - low) * jax.random.uniform(k_pos, (len(rows), 3))
    pos = pos.at[:, 2].add(jnp.where(jax.random.bernoulli(k_there, there, rows.shape), 0.0, -10.0))
    half = jnp.pi / 2 * _within(k_turn, rows.shape)
    zero = jnp.zeros_like(half)
    return {"geom_pos": (rows, pos), "geom_quat": (rows, jnp.stack([jnp.cos(half), zero, zero, jnp.sin(half)], axis=1))}


def sizes(key: Key, model: Model, *, geoms: tuple[str, ...], scale: PositiveRange) -> Drawn:
    """Scales each edge of drawn geoms by a uniform factor of its own."""
    rows = model.rows("geom", geoms)
    factor = jax.random.uniform(key, (len(rows), 3), minval=scale[0], maxval=scale[1])
    return {"geom_size": (rows, model.fields["geom_size"][rows] * factor)}


def _within(key: Key, shape: tuple[int, ...]) -> Array:
    return jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)


def _recolored(key: Key, rgba: Float[Array, "n 4"], change: float, shade: tuple[float, float]) -> Float[Array, "n 4"]:
    k_color, k_share, k_shade = jax.random.split(key, 3)
    share = change * jax.random.uniform(k_share, (len(rgba), 1))
    color = rgba[:, :3] + share * (jax.random.uniform(k_color, (len(rgba), 3)) - rgba[:, :3])
    color *= jax.random.uniform(k_shade, (len(rgba), 1), minval=shade[0], maxval=shade[1])
    return rgba.at[:, :3].set(jnp.clip(color, 0.0, 1.0))
