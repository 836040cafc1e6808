"""Model fields that differ between worlds: those that ``mdp.randomization`` draws, and those derived from them."""

from collections.abc import Callable, Iterable, Mapping

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.mdp.curriculum import toward
from mjx_nero.mdp.randomization import Drawn, Model
from mjx_nero.types import Key, UserError

# Fields that a term may draw: all backends read them at every step.
DRAWABLE = (
    "body_mass body_inertia body_ipos body_gravcomp geom_size geom_rbound geom_friction geom_rgba dof_armature dof_damping "
    "dof_frictionloss jnt_range actuator_gainprm actuator_biasprm actuator_forcerange"
).split()
Fields = dict[str, Array]
Terms = Mapping[str, Callable[[Key, Model], Drawn]]


class Draws:
    """Draws fields of a model by terms, one after another.

    Args:
        kind: name of the terms' group in messages.
        terms: by name, each ``(key, model) -> {field: (rows, values)}``.
        nominal: the fields that may differ, with the model's values.
        index: rows by name, see ``mdp.randomization.Model``.

    Attributes:
        rows: field -> all rows that the terms draw. Fields that are empty in the model are left out.

    Raises:
        UserError: a term names something that the model lacks, or draws a field that cannot differ.
    """

    def __init__(self, kind: str, terms: Terms, nominal: dict[str, np.ndarray], index: Mapping[str, Mapping[str, int]]):
        self._terms, self.nominal, self._index = terms, nominal, index
        self.rows: dict[str, set[int]] = {}

        def note(key: Key) -> None:
            for name, term in terms.items():
                for field, (drawn, _) in term(key, self._model({})).items():
                    if field not in nominal:
                        raise UserError(f"{kind}.{name} draws {field}: only {', '.join(nominal)} may differ")
                    if nominal[field].size:
                        self.rows.setdefault(field, set()).update(map(int, drawn))

        jax.eval_shape(lambda: note(jax.random.PRNGKey(0)))  # only the rows matter, so nothing has to be compiled

    def _model(self, drawn: Fields) -> Model:
        return Model({**{name: jnp.asarray(value) for name, value in self.nominal.items()}, **drawn}, self._index)

    def __call__(self, keys: Iterable[Key], given: Mapping[str, Array]) -> Fields:
        """Returns ``given`` with what the terms draw, by one key each."""
        drawn = dict(given)
        for key, term in zip(keys, self._terms.values(), strict=True):
            for field, (rows, values) in term(key, self._model(drawn)).items():
                if field in self.rows:
                    drawn[field] = drawn.get(field, jnp.asarray(self.nominal[field])).at[rows].set(values)
        return drawn


class Randomization:
    """Draws the fields of one world.

    Args:
        model: compiled scene.
        terms: by name, each ``(key, model) -> {field: (rows, values)}``.

    Attributes:
        names: names of the fields that differ between worlds.

    Raises:
        UserError: a term names something that the model lacks, or draws a field that cannot differ.
    """

    def __init__(self, model: mujoco.MjModel, terms: Terms):
        self._count = len(terms)
        hinges = {model.joint(j).name: int(model.jnt_dofadr[j]) for j in range(model.njnt) if model.jnt_type[j] >= 2}
        index = {
            "body": {model.body(i).name: i for i in range(1, model.nbody)},
            "geom": {model.geom(i).name: i for i in range(model.ngeom)},
            "dof": hinges,
            "joint": {name: model.joint(name).id for name in hinges},
            "actuator": {model.actuator(i).name: i for i in range(model.nu)},
        }
        self._draws = Draws("randomization", terms, nominal(model, DRAWABLE), index)
        rows = self._draws.rows
        _make_room(model, rows)
        bodies = rows.get("body_mass", set()) | rows.get("body_inertia", set()) | rows.get("body_ipos", set())
        trees = {int(model.body_treeid[b]) for b in bodies} | {int(model.dof_treeid[d]) for d in rows.get("dof_armature", ())}
        self._trees = [_Tree(model, tree) for tree in sorted(trees - {-1})]
        self._derived = nominal(model, _DERIVED) if trees else {}
        self.names = tuple(rows) + tuple(self._derived)

    def __call__(self, key: Key, level: Float[Array, ""] | None = None, given: Mapping[str, Array] | None = None) -> Fields:
        """Draws the fields of one world; empty without terms. ``level``: see ``types.LEVEL``.

        Args:
            given: fields that differ for another reason, such as an object's shape (``meshes.bank``).
        """
        given = given or {}
        drawn = self._draws(jax.random.split(key, self._count) if self._count else (), given)
        plain: Fields = {**{name: jnp.asarray(value) for name, value in self._draws.nominal.items()}, **given}
        drawn = {name: toward(level, plain[name], values) for name, values in drawn.items()}
        now = {**plain, **drawn}
        derived = {name: jnp.asarray(given.get(name, value)) for name, value in self._derived.items()}
        for tree in self._trees:
            for name, (rows, values) in tree(now, moved="body_ipos" in drawn).items():
                derived[name] = derived[name].at[rows].set(values)
        if derived:
            derived["body_subtreemass"] = derived["body_subtreemass"].at[0].set(jnp.sum(now["body_mass"]))
        return {**drawn, **derived}


def nominal(model: mujoco.MjModel, names: Iterable[str]) -> dict[str, np.ndarray]:
    """Fields of the model by name, as int32 if they hold integers, otherwise as float32."""
    found = {name: np.array(getattr(model, name)) for name in names}
    return {name: x.astype(np.int32 if np.issubdtype(x.dtype, np.integer) else np.float32) for name, x in found.items()}


def _make_room(model: mujoco.MjModel, rows: Mapping[str, set[int]]) -> None:
    """Undoes decisions of MuJoCo's compiler that would make it ignore a drawn field.

    Raises:
        UserError: a decision cannot be undone.
    """
    frictions, bodies, geoms = (sorted(rows.get(name, ())) for name in ("dof_frictionloss", "body_ipos", "geom_size"))
    model.dof_frictionloss[frictions] = np.maximum(model.dof_frictionloss[frictions], 1e-9)  # zero would make no constraint
    if "body_gravcomp" in rows and not model.ngravcomp:
        raise UserError("randomization draws body_gravcomp: this robot has no gravity compensation (robot.gravity_compensation)")
    for body in bodies:  # MuJoCo does not compute coinciding frames separately
        geoms_too = model.geom_sameframe[model.geom_bodyid == body] == mujoco.mjtSameFrame.mjSAMEFRAME_INERTIA
        if model.body_sameframe[body] == mujoco.mjtSameFrame.mjSAMEFRAME_BODY or geoms_too.any():
            name = model.body(body).name
            raise UserError(
                f"randomization draws body_ipos of {name!r}: its centre of mass is its origin or its shape's, and cannot move"
            )
    for geom in geoms:  # bounding boxes rule contacts out: make them large enough for twice the size
        model.geom_aabb[geom, 3:] *= 2
        body = model.geom_bodyid[geom]
        nodes = slice(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
        model.bvh_aabb[nodes, 3:] *= 2


# Fields derived from masses, inertias and armatures. MuJoCo's compiler computes them at ``qpos0`` (mj_setConst).
_DERIVED = ("body_subtreemass", "body_invweight0", "dof_invweight0", "dof_M0")


class _Tree:
    """The constants of one kinematic tree, as functions of its masses, inertias and armatures.

    With the Jacobians of the bodies' centres of mass, J = (Jv, Jr), at ``qpos0``, and M = sum Jv' m Jv + Jr' I Jr + armature:
    a degree of freedom has the inverse weight (M^-1)_ii, a body the means over the axes of J M^-1 J'; those of a ball or a free
    joint are means, too.
    """

    def __init__(self, model: mujoco.MjModel, tree: int):
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        self._bodies, self._dofs = np.flatnonzero(model.body_treeid == tree), np.flatnonzero(model.dof_treeid == tree)
        shape = (len(self._bodies), 3, len(self._dofs))
        self._linear, self._turning, self._spin = (np.zeros(shape, np.float32) for _ in range(3))
        self._frames = data.xmat[self._bodies].reshape(-1, 3, 3).astype(np.float32)
        self._centers = model.body_ipos[self._bodies].astype(np.float32)
        for i, body in enumerate(self._bodies):
            linear, turning = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jacBodyCom(model, data, linear, turning, body)
            self._linear[i] = linear[:, self._dofs]
            self._spin[i] = turning[:, self._dofs]
            self._turning[i] = data.ximat[body].reshape(3, 3).T @ turning[:, self._dofs]  # about the principal axes
        below = [[_carries(model, b, c) for c in self._bodies.tolist()] for b in self._bodies.tolist()]
        self._below = np.array(below, np.float32)
        # mean[i, j]: the share of j's inverse weight in i's
        self._mean = np.eye(len(self._dofs), dtype=np.float32)
        for joint in np.flatnonzero(np.isin(model.jnt_bodyid, self._bodies)):
            at = model.jnt_dofadr[joint] - self._dofs[0]
            for first in {mujoco.mjtJoint.mjJNT_FREE: (at, at + 3), mujoco.mjtJoint.mjJNT_BALL: (at,)}.get(
                model.jnt_type[joint], ()
            ):
                self._mean[first : first + 3, first : first + 3] = 1 / 3
        free = len(self._bodies) == 1 and model.jnt_type[model.body_jntadr[self._bodies[0]]] == mujoco.mjtJoint.mjJNT_FREE
        self._alone = bool(free and not model.body_ipos[self._bodies[0]].any() and not model.dof_armature[self._dofs].any())

    def __call__(self, fields: Mapping[str, Array], moved: bool = False) -> Drawn:
        """Computes the constants.

        Args:
            moved: the centres of mass have moved.
        """
        linear: Array = jnp.asarray(self._linear)
        if moved:
            way = jnp.einsum("bij,bj->bi", self._frames, fields["body_ipos"][self._bodies] - self._centers)
            linear = linear + jnp.cross(self._spin, way[:, :, None], axis=1)
        mass, inertia = fields["body_mass"][self._bodies], fields["body_inertia"][self._bodies]
        armature = fields["dof_armature"][self._dofs]
        matrix = jnp.einsum("b,bki,bkj->ij", mass, linear, linear) + jnp.diag(armature)
        matrix += jnp.einsum("bk,bki,bkj->ij", inertia, self._turning, self._turning)
        if self._alone:  # a free body needs no inverse, which on a GPU would take longer than all the rest
            body = jnp.stack([1 / mass, jnp.mean(1 / inertia, axis=1)], axis=1)
            weight = jnp.repeat(body[0], 3)
        else:
            scale = jax.lax.rsqrt(jnp.diag(matrix))  # entries differ widely in size: metres and radians, cubes and arms
            inverse = jnp.linalg.inv(matrix * scale[:, None] * scale) * scale[:, None] * scale
            weight = jnp.asarray(self._mean) @ jnp.diag(inverse)
            body = jnp.stack([jnp.einsum("bki,ij,bkj->b", part, inverse, part) / 3 for part in (linear, self._turning)], axis=1)
        return {
            "body_subtreemass": (self._bodies, jnp.asarray(self._below) @ mass),
            "body_invweight0": (self._bodies, body),
            "dof_invweight0": (self._dofs, weight),
            "dof_M0": (self._dofs, jnp.diag(matrix)),
        }


def _carries(model: mujoco.MjModel, body: int, other: int) -> bool:
    """True if ``other`` is the body or hangs on it."""
    while other > body:  # parents come before what they carry
        other = int(model.body_parentid[other])
    return other == body
