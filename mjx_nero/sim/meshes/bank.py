"""Different shapes in different worlds of one batch. The number of an object's shape decides the fields of the model.

All shapes are in the compiled model. A world differs from another in some fields of the model: which mesh each part is, where it
lies in the body, its bounds, and the mass. A part that a shape lacks has no mesh (MuJoCo Warp) or touches nothing (MuJoCo's C
library, where a geom cannot lack a mesh). All shapes share one body, so nothing is parked or hidden elsewhere.
"""

from collections.abc import Callable, Mapping
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero.sim.meshes import body as bodies
from mjx_nero.sim.parts import Fields, Part
from mjx_nero.sim.solids.solid import Solid
from mjx_nero.types import SHAPE, Carry, Sim, Start, View

_GEOMS = ("geom_pos", "geom_quat", "geom_size", "geom_aabb", "geom_rbound")
_OF_C = ("geom_contype", "geom_conaffinity")  # MuJoCo Warp keeps one copy of these for all worlds
_BODIES = ("body_mass", "body_inertia", "body_iquat", "body_subtreemass", "body_invweight0")
_DOFS = ("dof_invweight0", "dof_M0")
FIELDS = ("geom_dataid", *_GEOMS, *_OF_C, *_BODIES, *_DOFS)


class Banks(Part):
    """The banks of a scene's objects.

    Args:
        model: the compiled scene; its bounds are widened to contain every shape.
        objects: configs of the scene's objects.
        drawn: makes the scene's model for pictures.

    Attributes:
        counts: number of shapes of each object with a bank.
    """

    def __init__(self, model: mujoco.MjModel, objects: Mapping[str, Any], drawn: Callable[[], mujoco.MjModel] | None = None):
        self._drawn = drawn
        with_bank = {name: item for name, item in objects.items() if item.shape == "mesh" and item.bank}
        self.counts = {name: 1 + len(item.bank) for name, item in with_bank.items()}
        self.fields, self.seen = (FIELDS, ("geom_rgba",)) if with_bank else ((), ())
        self._tables = {name: _table(model, name, item.solids, item.masses) for name, item in with_bank.items()}
        self._nominal = {name: np.array(getattr(model, name), np.float32) for name in self.fields}
        for name in with_bank:
            _widen(model, name, self._tables[name])

    def blank(self) -> dict[str, Any]:
        """Returns the first shape of each."""
        return {"shape": dict.fromkeys(self.counts, jnp.zeros((), jnp.int32))}

    def start(self, view: View, carry: Carry) -> dict[str, Any]:
        """Returns the shape of each."""
        return {"shape": carry.memory.get(SHAPE, {})}

    def given(self, start: Start) -> Fields:
        """Returns the fields of a world whose objects have the start's shapes."""
        out: Fields = {name: jnp.asarray(value) for name, value in self._nominal.items()}
        for thing, table in self._tables.items():
            for name, (rows, values) in table.items():
                out[name] = out[name].at[rows].set(jnp.asarray(values)[start.shape[thing]])
        if out:
            out["body_subtreemass"] = out["body_subtreemass"].at[0].set(jnp.sum(out["body_mass"]))
        return out

    def memory(self, start: Start) -> dict[str, Any]:
        """Remembers the shapes."""
        return {SHAPE: start.shape} if self.counts else {}

    def scenery(self, sim: Sim, carry: Carry, look: Fields) -> dict[str, Fields]:
        """Returns colours of the drawn geoms that hide all but the episode's shapes."""
        if SHAPE not in carry.memory or not self._drawn:
            return {}
        model = self._drawn()
        rgba = look.get("geom_rgba", jnp.asarray(model.geom_rgba, jnp.float32))
        for name, count in self.counts.items():
            rows = np.array([model.geom(bodies.drawn_name(name, k)).id for k in range(count)])
            rgba = rgba.at[rows, 3].set((jnp.arange(count) == carry.memory[SHAPE][name]).astype(jnp.float32))
        return {"look": {**look, "geom_rgba": rgba}}


def _table(
    model: mujoco.MjModel, name: str, solids: list[Solid], masses: list[float]
) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Field -> rows of the model, and their values for each shape [shapes, rows, ...]."""
    names = bodies.names(name, solids)
    geoms = np.array([model.geom(each).id for each in names])
    thing = np.array([model.body(name).id])
    dofs = int(model.joint(name).dofadr[0]) + np.arange(6)
    found: dict[str, list[np.ndarray]] = {field: [] for field in FIELDS}
    for k, (solid, mass) in enumerate(zip(solids, masses, strict=True)):
        alone = _alone(model, name, solid, mass)
        there = [i for i, each in enumerate(names) if i <= len(solid.sizes)]
        own = [alone.geom(names[i]).id for i in there]
        for field in ("geom_dataid", *_GEOMS, *_OF_C):
            values = np.zeros((len(names), *getattr(alone, field).shape[1:]))
            if field == "geom_dataid":
                values -= 1
                values[there] = [model.mesh(each).id for each, _ in bodies.meshes(name, k, solid)]
            elif field in _OF_C:
                values[there] = getattr(model, field)[geoms[there]]
            else:
                values[there] = getattr(alone, field)[own]
            found[field].append(values)
        for field in _BODIES:
            found[field].append(getattr(alone, field)[1:2])
        for field in _DOFS:
            found[field].append(getattr(alone, field))
    rows = {
        **dict.fromkeys(("geom_dataid", *_GEOMS, *_OF_C), geoms),
        **dict.fromkeys(_BODIES, thing),
        **dict.fromkeys(_DOFS, dofs),
    }
    return {field: (rows[field], np.stack(values).astype(np.float32)) for field, values in found.items()}


def _alone(model: mujoco.MjModel, name: str, solid: Solid, mass: float) -> mujoco.MjModel:
    """A model of one shape alone, compiled as in the scene."""
    spec = mujoco.MjSpec()
    spec.option.timestep = model.opt.timestep
    body = spec.worldbody.add_body(name=name)
    body.add_freejoint(name=name)
    bodies.add(spec, name, [solid], [mass], body, {}, {}, visuals=False)
    return spec.compile()


def _widen(model: mujoco.MjModel, name: str, table: Mapping[str, tuple[np.ndarray, np.ndarray]]) -> None:
    """Undoes what MuJoCo's compiler decided for the first shape alone."""
    body, (geoms, _) = model.body(name).id, table["geom_pos"]
    model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    model.geom_sameframe[geoms] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
    far = float((np.linalg.norm(table["geom_pos"][1], axis=-1) + table["geom_rbound"][1]).max())
    nodes = slice(model.body_bvhadr[body], model.body_bvhadr[body] + model.body_bvhnum[body])
    model.bvh_aabb[nodes] = [0, 0, 0, far, far, far]
