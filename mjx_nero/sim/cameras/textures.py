"""Textures of a drawn scene: the user's photographs, and patterns. Each is a material that ``mdp.looks`` gives to geoms."""

import io
import pathlib
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np

from mjx_nero import files
from mjx_nero.types import UserError

PHOTO, PATTERN = "photograph_", "pattern_"  # names of materials, before a number
EDGE = 256  # most pixels along a photograph's longer edge
MOST = 200  # photographs in a folder
_BYTES = 50_000_000  # of a file
_ENDINGS = (".png", ".jpg", ".jpeg")
_TIMES = 2.0  # repeats along each edge of a box: a camera sees only part of a wall
_TILE = 64  # pixels along a pattern's edge, which is repeated


def add(spec: mujoco.MjSpec, folder: str, patterns: int) -> None:
    """Adds the materials to a scene.

    Args:
        folder: folder with photographs; empty: none.
        patterns: how many patterns; each is the same in every scene.

    Raises:
        UserError: there are no photographs in the folder, or one cannot be read.
    """
    for i, picture in enumerate(photographs(pathlib.Path(folder)) if folder else ()):
        _material(spec, f"{PHOTO}{i}", picture)
    for i in range(patterns):
        _material(spec, f"{PATTERN}{i}", pattern(i))


def _material(spec: mujoco.MjSpec, name: str, picture: np.ndarray) -> None:
    height, width, _ = picture.shape
    made: Any = spec.add_texture(name=name, type=mujoco.mjtTexture.mjTEXTURE_2D, width=width, height=height, nchannel=3)
    made.data = np.ascontiguousarray(picture).tobytes()
    material = spec.add_material(name=name, texrepeat=[_TIMES, _TIMES], specular=0.0)  # the renderers' highlights differ
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = name


def photographs(folder: pathlib.Path) -> Iterator[np.ndarray]:
    """Yields the pictures in a folder, scaled down, in the order of their names, uint8 [height, width, 3].

    Raises:
        UserError: see ``add``.
    """
    if not folder.is_dir():
        raise UserError(f"scene.photographs: {folder} is not a folder: give one with pictures (PNG or JPEG)")
    found = sorted(path for path in folder.iterdir() if path.suffix.lower() in _ENDINGS and not path.name.startswith("."))
    if not 0 < len(found) <= MOST:
        raise UserError(f"scene.photographs: {folder} has {len(found)} pictures (PNG or JPEG), but a scene takes 1 to {MOST}")
    yield from map(_read, found)


def _read(path: pathlib.Path) -> np.ndarray:
    from PIL import Image

    content = files.read_bytes(path, _BYTES)
    try:
        with Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as picture:
            picture.draft("RGB", (2 * EDGE, 2 * EDGE))
            picture.thumbnail((EDGE, EDGE))
            return np.asarray(picture.convert("RGB"))
    except Exception as error:  # a decoder fails in many ways
        raise UserError(f"scene.photographs: cannot read {path}: {' '.join(str(error).split())[:160]}") from None


def pattern(number: int) -> np.ndarray:
    """A grey pattern that can be repeated, uint8 [64, 64, 3]: stripes, a chessboard, or cloudy noise; colours multiply it."""
    rng, kind = np.random.default_rng(number), number % 3
    down, right = np.mgrid[:_TILE, :_TILE] / _TILE
    times = 2 ** int(rng.integers(1, 4))
    if kind == 0:
        waves = np.sin(2 * np.pi * times * (right if rng.random() < 0.5 else right + down))
    elif kind == 1:
        waves = np.where((np.floor(2 * times * right) + np.floor(2 * times * down)) % 2 > 0, 1.0, -1.0)
    else:  # waves of whole numbers of periods fit together at the edges
        waves = np.zeros((_TILE, _TILE))
        for _ in range(24):
            across, along = rng.integers(-8, 9, 2)
            waves += np.sin(2 * np.pi * (across * right + along * down + rng.random())) / (1 + np.hypot(across, along)) ** 0.5
        waves = np.clip(waves / np.abs(waves).max() * 1.5, -1, 1)
    depth = rng.uniform(0.15, 0.5)
    grey = 255 * (1 - depth * (0.5 - 0.5 * waves))
    return np.repeat(grey[..., None], 3, axis=2).round().astype(np.uint8)
