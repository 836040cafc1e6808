"""The config of a camera, and how a camera enters MuJoCo's model."""

import dataclasses
from collections.abc import Mapping
from typing import Annotated

import mujoco
import numpy as np

from mjx_nero.config.bounds import Bounds, Point
from mjx_nero.sim import quats
from mjx_nero.types import UserError

KINDS = ("rgb", "depth", "segmentation")
MARK = "scene.cameras."  # prefix of a camera's name in MuJoCo's model, which also has cameras for people
Pixels = Annotated[int, Bounds(1, 2048)]


@dataclasses.dataclass(frozen=True)
class CameraCfg:
    """A pinhole camera, fixed in the world or on a link.

    Attributes:
        link: body that carries the camera; empty: fixed in the world.
        pos: place in the frame of the link or the world [m].
        quat: orientation in that frame, wxyz. A camera looks along its -z axis; y points up in the picture.
        fovy: vertical field of view [deg].
        size: width and height [pixels].
        kinds: one or more of ``rgb``, ``depth`` and ``segmentation``.
    """

    link: str = ""
    pos: Point = (1.0, 0.0, 0.5)
    quat: tuple[float, float, float, float] = (0.5, 0.5, 0.5, 0.5)
    fovy: Annotated[float, Bounds(1.0, 170.0)] = 45.0
    size: tuple[Pixels, Pixels] = (64, 64)
    kinds: tuple[str, ...] = ("rgb",)

    def __post_init__(self):
        if not self.kinds or set(self.kinds) - set(KINDS) or len(set(self.kinds)) < len(self.kinds):
            raise UserError(f"a camera's kinds are one or more of {', '.join(KINDS)}, each once, got {self.kinds}")
        if not any(self.quat):
            raise UserError("a camera's quat is an orientation, wxyz, and cannot be zero")

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the pictures."""
        return self.size[1], self.size[0]


def add(spec: mujoco.MjSpec, cameras: Mapping[str, CameraCfg]) -> None:
    """Adds cameras to a scene.

    Raises:
        UserError: the scene lacks a camera's link.
    """
    for name, cfg in cameras.items():
        body = spec.body(cfg.link) if cfg.link else spec.worldbody
        if body is None:
            links = ", ".join(b.name for b in spec.bodies if b.name and b.name != "world")
            raise UserError(f"scene.cameras.{name}.link is {cfg.link!r}, but the scene's links are: {links}")
        body.add_camera(name=MARK + name, pos=cfg.pos, quat=cfg.quat, fovy=cfg.fovy)


def look_at(pos, target, up=(0.0, 0.0, 1.0)) -> np.ndarray:
    """Returns the orientation (wxyz) of a camera at ``pos`` that looks at ``target``, with ``up`` upwards in the picture."""
    back = np.subtract(pos, target) / np.linalg.norm(np.subtract(pos, target))
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    return quats.of_matrix(np.column_stack([right, np.cross(back, right), back]))
