"""Pictures with MuJoCo's own renderer."""

import copy
import math
import warnings

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero.errors import UserError
from mjx_nero.sim.cameras.look import rows
from mjx_nero.types import Scenery

NO_GL = (
    "no offscreen OpenGL here, so no pictures: install libegl1 (machines with a GPU) or libosmesa6 "
    "(Debian and Ubuntu: apt-get install libosmesa6)"
)
_APART = 1.5  # [m] least distance between tables that share a picture
_lost = False  # a renderer was asked for in vain


def renderer(model: mujoco.MjModel, height: int, width: int, max_geom: int = 10_000) -> mujoco.Renderer:
    """Makes a renderer of MuJoCo's. After a failure it does not try again: GLFW's second failure would end the process.

    Raises:
        UserError: the machine cannot draw offscreen.
    """
    global _lost
    if _lost:
        raise UserError(NO_GL)
    try:
        with warnings.catch_warnings(action="ignore"):  # GLFW's, which the error replaces
            return _quiet()(model, height, width, max_geom)
    except Exception as error:  # each GL binding fails in its own way: ImportError, RuntimeError, GLError, ...
        _lost = True
        raise UserError(NO_GL) from error


def _quiet() -> type[mujoco.Renderer]:
    """Makes a class of MuJoCo's renderer that prints nothing where Python frees it in another thread, or as Python ends."""

    class Quiet(mujoco.Renderer):
        def __del__(self) -> None:
            try:
                self.close()
            except Exception:  # its context belongs to a thread that has ended, or OpenGL's module has been cleared
                return

    return Quiet


class Renderer:
    """Draws states of a model. A context manager.

    Args:
        width, height: pixels.
        camera: name of a camera of the model, or a free camera.
        samples: samples per pixel; None: the model's setting.
        shadows: pixels along a side of the shadow map; None: the model's setting.
        envs: greatest number of robots in one picture.

    Raises:
        UserError: the machine cannot draw offscreen.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        width: int = 640,
        height: int = 480,
        camera: str | mujoco.MjvCamera = "front",
        samples: int | None = None,
        shadows: int | None = None,
        envs: int = 1,
    ):
        model = copy.copy(model)
        screen, quality = model.vis.global_, model.vis.quality
        screen.offwidth, screen.offheight = max(width, screen.offwidth), max(height, screen.offheight)
        quality.offsamples = quality.offsamples if samples is None else samples
        quality.shadowsize = quality.shadowsize if shadows is None else shadows
        self._data, self._model, self._camera = mujoco.MjData(model), model, camera
        self._option, self._hand = mujoco.MjvOption(), mujoco.MjvPerturb()
        table = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "table_top")
        self._apart = max(_APART, 2 * float(model.geom_size[table, :2].max())) if table >= 0 else _APART
        self._renderer = renderer(model, height, width, max_geom=max(10_000, envs * (model.ngeom + 10)))

    def __enter__(self) -> "Renderer":
        return self

    def __exit__(self, *_) -> None:
        self._renderer.close()

    def render(self, qpos: np.ndarray, scenery: Scenery) -> np.ndarray:
        """Draws one frame, uint8 [height, width, 3].

        Args:
            qpos: [nq].
            scenery: goal, obstacles and looks (``ManipulationEnv.scenery``).
        """
        self._forward(qpos, scenery)
        self._renderer.update_scene(self._data, self._camera)
        return self._renderer.render()

    def render_all(self, qpos: np.ndarray, scenery: Scenery) -> np.ndarray:
        """Draws several robots in rows, each at its own table, into one frame; uint8 [height, width, 3].

        Args:
            qpos: [envs, nq].
            scenery: [envs, ...].
        """
        columns = math.ceil(math.sqrt(len(qpos)))
        rows = math.ceil(len(qpos) / columns)
        scene = self._renderer.scene
        for i, at in enumerate(qpos):
            self._forward(at, scenery[i])
            before = scene.ngeom if i else 0
            if i == 0:
                free = isinstance(self._camera, mujoco.MjvCamera)
                self._renderer.update_scene(self._data, self._camera if free else self._overview(columns, rows))
            else:
                mujoco.mjv_addGeoms(self._model, self._data, self._option, self._hand, mujoco.mjtCatBit.mjCAT_ALL.value, scene)
            x, y = i // columns - (rows - 1) / 2, i % columns - (columns - 1) / 2
            for geom in scene.geoms[before : scene.ngeom]:
                geom.pos[:2] += self._apart * np.array([x, y])
        for light in scene.lights[: scene.nlight]:  # farther away, so that they light all robots
            light.pos[:] -= self._apart * (max(columns, rows) - 1) * light.dir
        return self._renderer.render()

    def _forward(self, qpos: np.ndarray, scenery: Scenery) -> None:
        for name, values in scenery.look.items():
            getattr(self._model, name)[:] = values
        for field, row, value in rows(self._model, scenery):
            getattr(self._model, field)[row] = value
        self._data.qpos[:] = qpos
        self._data.mocap_pos[0], self._data.mocap_quat[0] = scenery.goal_pos_w, scenery.goal_quat_w
        mujoco.mj_forward(self._model, self._data)

    def _overview(self, columns: int, rows: int) -> mujoco.MjvCamera:
        """Camera in front and above, far enough away to see all robots."""
        camera = mujoco.MjvCamera()
        camera.type = mujoco.mjtCamera.mjCAMERA_FREE
        camera.lookat = self._model.stat.center
        camera.distance = 1.3 * self._model.stat.extent + 1.2 * self._apart * (max(columns, rows) - 1)
        camera.azimuth, camera.elevation = 138, -32
        return camera


def unmarked(*shape: int) -> Scenery:
    """Scenery that hides the goal marker under the table; ``shape`` gives the leading axes."""
    return Scenery(jnp.tile(jnp.array([0.0, 0.0, -10.0]), (*shape, 1)), jnp.tile(jnp.array([1.0, 0.0, 0.0, 0.0]), (*shape, 1)))


def frames(model: mujoco.MjModel, qpos: np.ndarray, scenery: Scenery, every: int = 1, **kwargs) -> list[np.ndarray]:
    """Draws recorded episodes, one after another.

    Args:
        qpos: [steps, episodes, nq]; scenery: [steps, episodes, ...], as in ``rollout.Episodes``.
        every: draw every ``every``-th step.
        kwargs: arguments of ``Renderer``.
    """
    with Renderer(model, **kwargs) as renderer:
        steps, episodes = qpos.shape[:2]
        return [renderer.render(qpos[t, k], scenery[t, k]) for k in range(episodes) for t in range(0, steps, every)]
