"""Fields of the drawn model that differ from episode to episode, as ``mdp.looks`` draws them."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.mdp.curriculum import toward
from mjx_nero.mdp.randomization import Drawn, Model
from mjx_nero.sim.cameras.cfg import MARK
from mjx_nero.types import Key, Scenery, UserError

DRAWABLE = (
    "cam_pos",
    "cam_quat",
    "cam_fovy",
    "light_dir",
    "light_diffuse",
    "geom_rgba",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "geom_matid",
    "mat_rgba",
)  # all drawers read them for every picture


class Look:
    """Draws the look of one world's episode.

    Args:
        model: the scene with visual shapes.
        terms: by name, each ``(key, model) -> {field: (rows, values)}``.

    Attributes:
        names: names of the fields that differ.

    Raises:
        UserError: a term names something that the model lacks, or draws a field that cannot differ.
    """

    def __init__(self, model: mujoco.MjModel, terms: Mapping[str, Callable[[Key, Model], Drawn]]):
        self._terms = terms
        self._nominal = {name: nominal(model, name) for name in DRAWABLE}
        self._index = {
            "material": {model.mat(i).name: i for i in range(model.nmat)},
            "robot": {str(i): int(i) for i in np.flatnonzero(model.geom_matid >= 0)},  # nothing else has a material of its own
            "camera": {model.camera(i).name.removeprefix(MARK): i for i in range(model.ncam) if _ours(model, i)},
            "geom": {model.geom(i).name: i for i in range(model.ngeom) if model.geom(i).name},
        }
        names: dict[str, None] = {}
        for name, term in terms.items():
            for field in jax.eval_shape(
                lambda key, t=term: {f: v for f, (_, v) in t(key, self._model({})).items()}, jax.random.key(0)
            ):
                if field not in DRAWABLE:
                    raise UserError(f"look.{name} draws {field}: only {', '.join(DRAWABLE)} may differ")
                names |= {field: None} if self._nominal[field].size else {}
        self.names = tuple(names)

    def __call__(self, key: Key, level: Float[Array, ""] | None = None) -> dict[str, Array]:
        """Draws the fields; empty without terms. ``level``: see ``types.LEVEL``."""
        drawn: dict[str, Array] = {}
        for i, term in enumerate(self._terms.values()):
            for field, (rows, values) in term(jax.random.fold_in(key, i), self._model(drawn)).items():
                if field not in self.names:  # the model has nothing of the kind
                    continue
                drawn[field] = drawn.get(field, jnp.asarray(self._nominal[field])).at[rows].set(values)
        return {name: toward(level, jnp.asarray(self._nominal[name]), values) for name, values in drawn.items()}

    def _model(self, drawn: Mapping[str, Array]) -> Model:
        return Model({**{name: jnp.asarray(value) for name, value in self._nominal.items()}, **drawn}, self._index)


def rows(model: mujoco.MjModel, scenery: Scenery) -> Iterator[tuple[str, int, Any]]:
    """Yields the looks of a scenery's objects and obstacles as fields of the drawn model: name, row and value."""
    for name, look in scenery.objects.items():
        row = int(model.geom(name).id)
        yield from (("geom_size", row, look.size), ("geom_rgba", row, look.rgba))
    for name, box in scenery.obstacles.items():
        row = int(model.geom(name).id)
        yield from (("geom_pos", row, box.pos_w), ("geom_quat", row, box.quat_w), ("geom_size", row, box.size / 2))


def nominal(model: mujoco.MjModel, field: str) -> np.ndarray:
    """A field of the model, as int32 if it holds integers, otherwise as float32."""
    found = np.array(getattr(model, field))
    return found.astype(np.int32 if np.issubdtype(found.dtype, np.integer) else np.float32)


def _ours(model: mujoco.MjModel, camera: int) -> bool:
    return model.camera(camera).name.startswith(MARK)
