"""Domain randomization terms: (key, model, *, params) -> {field: (rows, values)}, applied in order at every reset.

Fields are those of MuJoCo's ``mjModel``; each term reads the values that the term before left. The rows that a term draws must
not depend on the key. Constants derived from masses (inverse weights, subtree masses) are recomputed.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.config.bounds import NonNegative, NonNegativeRange, PositiveRange
from mjx_nero.types import Key, UserError

Drawn = dict[str, tuple[np.ndarray, Array]]


@dataclasses.dataclass(frozen=True)
class Model:
    """The parts of the compiled model that terms read.

    Attributes:
        fields: arrays by MuJoCo's names. Rows are bodies, geoms, degrees of freedom or actuators.
        index: row numbers by name, for each kind: ``body``, ``geom``, ``dof`` (by its joint), ``joint`` and ``actuator``.
    """

    fields: Mapping[str, Array]
    index: Mapping[str, Mapping[str, int]]

    def rows(self, kind: str, names: Sequence[str]) -> np.ndarray:
        """Looks up row numbers by name.

        Raises:
            UserError: the model lacks one of the names.
        """
        known = self.index[kind]
        if unknown := [name for name in names if name not in known]:
            raise UserError(f"the model has no {kind} {', '.join(map(repr, unknown))}: choose from {', '.join(known)}")
        return np.array([known[name] for name in names])


def mass(key: Key, model: Model, *, bodies: tuple[str, ...], scale: PositiveRange) -> Drawn:
    """Scales masses and inertias by one uniform factor per body."""
    rows = model.rows("body", bodies)
    (factor,) = _uniform(key, len(rows), scale)
    return _scaled(model, rows, body_mass=factor, body_inertia=factor[:, None])


def friction(
    key: Key,
    model: Model,
    *,
    geoms: tuple[str, ...],
    slide: PositiveRange,
    spin: PositiveRange | None = None,
    roll: PositiveRange | None = None,
) -> Drawn:
    """Draws friction coefficients per geom: sliding uniform, spinning and rolling [m] log-uniform. None keeps the model's.

    Where two geoms meet, the geom of higher priority decides; at equal priority, the larger coefficient does.
    """
    rows, values = model.rows("geom", geoms), model.fields["geom_friction"]
    columns = list(_uniform(key, len(rows), slide, np.log(spin or (1.0, 1.0)), np.log(roll or (1.0, 1.0))))
    for column, bounds in ((1, spin), (2, roll)):
        columns[column] = values[rows, column] if bounds is None else jnp.exp(columns[column])
    return {"geom_friction": (rows, jnp.stack(columns, axis=1))}


def gains(
    key: Key,
    model: Model,
    *,
    actuators: tuple[str, ...],
    stiffness: PositiveRange = (1.0, 1.0),
    damping: PositiveRange = (1.0, 1.0),
    effort: PositiveRange = (1.0, 1.0),
) -> Drawn:
    """Scales stiffness, damping and effort of position drives by uniform factors per drive."""
    rows = model.rows("actuator", actuators)
    kp, kd, force = _uniform(key, len(rows), stiffness, damping, effort)
    factors = jnp.stack([jnp.ones_like(kp), kp, kd], axis=1)
    gain, bias = model.fields["actuator_gainprm"][rows], model.fields["actuator_biasprm"][rows]
    drawn = {
        "actuator_gainprm": (rows, gain.at[:, 0].multiply(kp)),
        "actuator_biasprm": (rows, bias.at[:, :3].multiply(factors)),
    }
    if effort != (1.0, 1.0):
        drawn |= _scaled(model, rows, actuator_forcerange=force[:, None])
    return drawn


def joints(
    key: Key,
    model: Model,
    *,
    joints: tuple[str, ...],
    armature: PositiveRange = (1.0, 1.0),
    damping: PositiveRange = (1.0, 1.0),
    friction: NonNegativeRange = (0.0, 0.0),
) -> Drawn:
    """Scales armature and damping of hinges and slides by uniform factors per joint.

    Args:
        armature, damping: ranges of the factors.
        friction: dry friction (MuJoCo's ``frictionloss``) as a share of the drive's effort. (0, 0) keeps the model's.
    """
    rows = model.rows("dof", joints)
    inertia, damp, dry = _uniform(key, len(rows), armature, damping, friction)
    drawn = _scaled(model, rows, dof_armature=inertia, dof_damping=damp)
    if friction != (0.0, 0.0):
        effort = model.fields["actuator_forcerange"][model.rows("actuator", joints), 1]
        drawn["dof_frictionloss"] = (rows, effort * dry)
    return drawn


def passive_joints(
    key: Key,
    model: Model,
    *,
    joints: tuple[str, ...],
    armature: PositiveRange = (1.0, 1.0),
    damping: PositiveRange = (1.0, 1.0),
    friction: PositiveRange = (1.0, 1.0),
    upper: PositiveRange = (1.0, 1.0),
) -> Drawn:
    """Scales properties of hinges and slides without drives, such as a drawer's, by uniform factors per joint.

    Args:
        joints: names; a fixture's joint is called ``fixture/joint``.
        armature, damping, friction, upper: ranges of the factors. ``friction`` scales dry friction (``frictionloss``), ``upper``
            the upper limit.
    """
    dofs, rows = model.rows("dof", joints), model.rows("joint", joints)
    *factors, farther = _uniform(key, len(dofs), armature, damping, friction, upper)
    ranges = {"dof_armature": armature, "dof_damping": damping, "dof_frictionloss": friction}
    varied = {name: factor for (name, bounds), factor in zip(ranges.items(), factors, strict=True) if bounds != (1.0, 1.0)}
    drawn = _scaled(model, dofs, **varied)
    if upper != (1.0, 1.0):
        drawn["jnt_range"] = (rows, model.fields["jnt_range"][rows].at[:, 1].multiply(farther))
    return drawn


def center_of_mass(key: Key, model: Model, *, bodies: tuple[str, ...], offset: NonNegative) -> Drawn:
    """Moves centres of mass by up to ``offset`` along each body axis [m]."""
    rows = model.rows("body", bodies)
    moved = jax.random.uniform(key, (len(rows), 3), minval=-offset, maxval=offset)
    return {"body_ipos": (rows, model.fields["body_ipos"][rows] + moved)}


def size(key: Key, model: Model, *, object: str = "cube", scale: PositiveRange) -> Drawn:
    """Scales an object's lengths by one uniform factor. The mass stays; the inertia follows the size."""
    sides = tuple(name for name in (f"{object}_side",) if name in model.index["geom"])  # only a can has one
    geoms, body = model.rows("geom", (object, *sides)), model.rows("body", (object,))
    ((factor,),) = _uniform(key, 1, scale)
    return _scaled(model, geoms, geom_size=factor, geom_rbound=factor) | _scaled(model, body, body_inertia=factor**2)


def color(key: Key, model: Model, *, geoms: tuple[str, ...]) -> Drawn:
    """Draws a colour for each geom, for pictures. It is never green, the goal's colour."""
    rows = model.rows("geom", geoms)
    hue = jax.random.uniform(key, (len(rows), 1), minval=0.55, maxval=1.12)  # [turns] from blue through red to orange
    # A channel is full within a sixth of a turn of its own hue, and least beyond a third.
    far = jnp.abs(jnp.mod(hue - jnp.array([0.0, 1.0, 2.0]) / 3 + 0.5, 1.0) - 0.5)
    rgb = 0.2 + 0.65 * jnp.clip(2.0 - 6.0 * far, 0.0, 1.0)
    return {"geom_rgba": (rows, jnp.concatenate([rgb, jnp.ones_like(hue)], axis=1))}


def gravity_compensation(key: Key, model: Model, *, bodies: tuple[str, ...], scale: NonNegativeRange) -> Drawn:
    """Scales the share of each body's weight that the drives carry, by uniform factors per body."""
    rows = model.rows("body", bodies)
    return _scaled(model, rows, body_gravcomp=_uniform(key, len(rows), scale)[0])


def encoder_bias(key: Key, model: Model, *, actuators: tuple[str, ...], bias: NonNegative) -> Drawn:
    """Biases each encoder by up to ``bias`` [rad or m]: drives pull the biased readings, not the true positions, to the targets.

    ``View.encoder_bias`` holds the draw, and ``sensors.Encoders`` adds it to observations. List this term after ``gains``.
    """
    rows = model.rows("actuator", actuators)
    drawn = jax.random.uniform(key, (len(rows),), minval=-bias, maxval=bias)
    stiffness, terms = model.fields["actuator_gainprm"][rows, 0], model.fields["actuator_biasprm"][rows]
    return {"actuator_biasprm": (rows, terms.at[:, 0].set(-stiffness * drawn))}


def drives(
    key: Key,
    model: Model,
    *,
    joints: tuple[str, ...],
    stiffness: tuple[PositiveRange, ...],
    damping: tuple[PositiveRange, ...],
    armature: tuple[PositiveRange, ...],
    friction: tuple[NonNegativeRange, ...],
) -> Drawn:
    """Draws parameters of position drives and joints uniformly, from one range per joint. ``identify`` writes such ranges.

    Args:
        stiffness: ranges [N m/rad or N/m].
        damping: ranges for drive and joint together [N m s/rad or N s/m].
        armature: ranges [kg m2 or kg].
        friction: ranges of dry friction [N m or N].
    """
    actuators, dofs = model.rows("actuator", joints), model.rows("dof", joints)
    kp, kd, inertia, dry = _uniform(key, len(joints), *(np.array(part).T for part in (stiffness, damping, armature, friction)))
    gain, bias = model.fields["actuator_gainprm"][actuators], model.fields["actuator_biasprm"][actuators]
    return {
        "actuator_gainprm": (actuators, gain.at[:, 0].set(kp)),
        "actuator_biasprm": (actuators, bias.at[:, 1].set(-kp).at[:, 2].set(-kd)),
        "dof_damping": (dofs, jnp.zeros_like(kd)),
        "dof_armature": (dofs, inertia),
        "dof_frictionloss": (dofs, dry),
    }


def _scaled(model: Model, rows: np.ndarray, **factors: Array) -> Drawn:
    """Multiplies rows of the named fields by factors."""
    return {name: (rows, model.fields[name][rows] * factor) for name, factor in factors.items()}


def _uniform(key: Key, n: int, *bounds) -> Float[Array, "parts n"]:
    """Draws ``n`` numbers for each pair of bounds, all in one draw: on a GPU each draw costs several kernels."""
    low, high = (np.stack([np.broadcast_to(b[end], n) for b in bounds]).astype(np.float32) for end in (0, 1))
    return jax.random.uniform(key, (len(bounds), n), minval=low, maxval=high)
