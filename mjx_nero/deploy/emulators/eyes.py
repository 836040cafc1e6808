"""Pictures of a simulated arm, drawn by MuJoCo's renderer."""

import os
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from mjx_nero.deploy.arm import Feedback
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.places import Places
from mjx_nero.errors import UserError

_UNSEEN = 5  # geom group that no camera sees: the goal's marker is only for viewers
_PLAIN = (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION)  # switched off, as in training


class Eyes:
    """Draws what the policy's cameras see, without delay; see ``observe.Pictures``.

    Args:
        model: scene with visual shapes and the policy's cameras (``scene.cameras.NAME``), or its file (``.mjb``).
        told: the policy's cameras by name, from its metadata.
        joints: names of the joints, in the order of a feedback.
        base: position of the robot's root frame in the world [m].
        places: source of object positions.

    Raises:
        UserError: this machine cannot draw.
    """

    def __init__(
        self,
        model: mujoco.MjModel | pathlib.Path,
        told: Mapping[str, Any],
        joints: Sequence[str],
        base: Sequence[float],
        places: Places,
    ):
        os.environ.setdefault("LP_NUM_THREADS", "0")  # software OpenGL then draws in this thread, which has priority
        self._told, self._places = told, places
        clock = _Still()
        model = model if isinstance(model, mujoco.MjModel) else mujoco.MjModel.from_binary_path(str(model))
        self._shown = Plant(model, joints, np.zeros(len(joints)), clock, base)
        model = self._shown.model
        model.geom_group[model.geom_bodyid == model.body("goal").id] = _UNSEEN
        model.vis.quality.offsamples = 0
        shapes = {tuple(camera["shape"][:2]) for camera in told.values()}
        try:
            self._renderers = {shape: mujoco.Renderer(model, *shape) for shape in shapes}
        except Exception as error:  # each GL binding fails in its own way
            raise UserError(f"no offscreen OpenGL here, so no pictures: install libegl1 or libosmesa6 ({error})") from None
        for name, camera in told.items():
            self._drawn(name, camera)  # the first picture takes much longer

    def __call__(self, feedback: Feedback, now: float) -> dict[str, np.ndarray]:
        """Draws the pictures of all cameras, [height, width, 3] each."""
        places = {name: self._places.find(name, now) for name in self._shown.objects}
        self._shown.reset(feedback.position, {name: place.position for name, place in places.items()})
        for name, place in places.items():
            self._shown.data.qpos[self._shown.objects[name] + 3 :][:4] = place.quaternion
        mujoco.mj_forward(self._shown.model, self._shown.data)
        return {name: self._drawn(name, camera) for name, camera in self._told.items()}

    def _drawn(self, name: str, camera: Mapping[str, Any]) -> np.ndarray:
        renderer = self._renderers[tuple(camera["shape"][:2])]
        renderer.update_scene(self._shown.data, f"scene.cameras.{name}")
        for flag in _PLAIN:
            renderer.scene.flags[flag] = False
        return renderer.render()

    def close(self) -> None:
        """Frees the renderers."""
        for renderer in self._renderers.values():
            renderer.close()


class _Still:
    """A stopped clock; see ``arm.Clock``."""

    def now(self) -> float:
        return 0.0

    def sleep_until(self, time: float) -> None: ...
