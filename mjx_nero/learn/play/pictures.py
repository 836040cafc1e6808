"""Pictures of episodes that have been played: drawn afterwards, from what the physics came to, by MuJoCo's own renderer."""

from collections.abc import Iterator, Sequence

import numpy as np

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.sim.render import Renderer
from mjx_nero.types import Scenery

SHADOWS = 0  # no shadow map, which takes three quarters of the time where a processor draws


class Cameras:
    """Cameras of an environment's drawn scene.

    Args:
        names: of cameras in the model.
        size: width and height [pixels], even, as encoders want them.

    Raises:
        UserError: there is no such camera, or the machine cannot draw.
    """

    def __init__(self, env: ManipulationEnv, names: Sequence[str], size: tuple[int, int]):
        model = env.mj_model
        there = [model.camera(i).name for i in range(model.ncam)]
        if unknown := [name for name in names if name not in there]:
            raise UserError(f"{env.cfg.robot.name} has no camera {', '.join(unknown)}: choose from {', '.join(there)}")
        self.names, self.size = tuple(names), size
        self._renderers = {name: Renderer(model, *size, camera=name, samples=0, shadows=SHADOWS) for name in names}

    def close(self) -> None:
        """Frees the renderers."""
        for renderer in self._renderers.values():
            renderer.__exit__()

    def frames(self, name: str, qpos: np.ndarray, scenery: Scenery) -> Iterator[np.ndarray]:
        """A camera's frames of an episode, uint8 [height, width, 3], one after another.

        Args:
            qpos: [steps, nq].
            scenery: [steps, ...].
        """
        for i, at in enumerate(qpos):
            yield self._renderers[name].render(at.astype(np.float64), scenery[i])
