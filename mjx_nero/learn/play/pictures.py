"""Pictures of played episodes, drawn afterwards from the physics' positions by MuJoCo's own renderer."""

import copy
from collections.abc import Iterator, Sequence

import numpy as np

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.sim.cameras.cfg import MARK
from mjx_nero.sim.render import Renderer
from mjx_nero.types import Scenery

SIZE = 128, 128  # [pixels] of a camera for people
SHADOWS = 0  # no shadow map, which takes three quarters of the time on a CPU
_UNSEEN = 5  # a group of geoms that is not drawn


class Cameras:
    """Cameras of an environment: those of its scene, which do not see the goal's marker, and those for people, which do.

    Args:
        names: of the cameras.
        size: width and height [pixels], even, as encoders want them; None: a camera's own.

    Attributes:
        sizes: width and height of each camera's pictures, by name.

    Raises:
        UserError: there is no such camera, or the machine cannot draw.
    """

    def __init__(self, env: ManipulationEnv, names: Sequence[str], size: tuple[int, int] | None = None):
        model, own = env.mj_model, env.cfg.scene.cameras
        people = [name for i in range(model.ncam) if not (name := model.camera(i).name).startswith(MARK)]
        there = list(dict.fromkeys((*own, *people)))
        if unknown := [name for name in names if name not in there]:
            raise UserError(f"{', '.join(unknown)}: no camera of this environment: choose from {', '.join(there)}")
        self.names = tuple(names)
        self.sizes = {name: size or (own[name].size if name in own else SIZE) for name in names}
        blind = copy.copy(model)
        blind.geom_group[blind.geom_bodyid == blind.body("goal").id] = _UNSEEN
        self._renderers = {}
        for name in names:
            seen, camera = (blind, MARK + name) if name in own else (model, name)
            self._renderers[name] = Renderer(seen, *self.sizes[name], camera=camera, samples=0, shadows=SHADOWS)

    def close(self) -> None:
        """Frees the renderers."""
        for renderer in self._renderers.values():
            renderer.__exit__()

    def frames(self, name: str, qpos: np.ndarray, scenery: Scenery) -> Iterator[np.ndarray]:
        """Draws a camera's frames of an episode, uint8 [height, width, 3], one after another.

        Args:
            qpos: [steps, nq].
            scenery: [steps, ...].
        """
        for i, at in enumerate(qpos):
            yield self._renderers[name].render(at.astype(np.float64), scenery[i])
