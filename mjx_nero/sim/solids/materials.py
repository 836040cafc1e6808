"""The materials that an OBJ file names, of which one colour and one texture are drawn. The files may be untrusted.

Scans and archives often come without their materials. Missing ones are left out, and ``Look.missing`` names the first.
"""

import dataclasses
import os
import pathlib
import re

import numpy as np

from mjx_nero import files
from mjx_nero.types import UserError

GREY = (0.7, 0.7, 0.72, 1.0)
MAX_MTL = 1_000_000  # bytes of a file of materials
MAX_PICTURE = 40_000_000  # bytes
_MAX_NAME = 200  # characters


@dataclasses.dataclass(frozen=True)
class Look:
    """The look of a mesh.

    Attributes:
        rgba: colour.
        picture: bytes of the texture; None: there is none.
        missing: the first named file that is not there; empty: all are.
    """

    rgba: tuple[float, float, float, float] = GREY
    picture: bytes | None = None
    missing: str = ""


def of(path: pathlib.Path, content: bytes) -> Look:
    """Finds the first colour and the first texture that the materials of an OBJ file name.

    Args:
        path: path of the OBJ file; its materials must lie in its folder or below.
        content: its bytes.

    Raises:
        UserError: a named file lies elsewhere or is too large, or a colour is not three finite numbers.
    """
    named = re.search(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", content, re.MULTILINE)
    if not named:
        return Look()
    if not os.path.exists(materials := _beside(path, named[1])):
        return Look(missing=materials.name)
    text = files.read_bytes(materials, MAX_MTL)
    colour = re.search(rb"^[ \t]*Kd[ \t]+([^\r\n]+)", text, re.MULTILINE)
    rgba = _colour(path, colour[1]) if colour else GREY
    named = re.search(rb"^[ \t]*map_Kd[ \t]+([^\r\n]+)", text, re.MULTILINE)
    if not named:
        return Look(rgba)
    if not os.path.exists(picture := _beside(path, named[1])):
        return Look(rgba, missing=picture.name)
    return Look(rgba, files.read_bytes(picture, MAX_PICTURE))


def _colour(path: pathlib.Path, words: bytes) -> tuple[float, float, float, float]:
    try:
        red, green, blue = np.clip(np.array(words.split()[:3]).astype(float), 0, 1)
    except ValueError:
        red = green = blue = np.nan
    if not np.isfinite([red, green, blue]).all():
        raise UserError(f"{path} has a colour that is not three finite numbers: correct the Kd line of its materials")
    return float(red), float(green), float(blue), 1.0


def _beside(path: pathlib.Path, name: bytes) -> pathlib.Path:
    """A file that a mesh names, in its own folder or below.

    Raises:
        UserError: it lies elsewhere.
    """
    try:
        word = name.strip().decode()
        inner = pathlib.PurePosixPath(word)
        real = path.parent.joinpath(inner).resolve()
    except (OSError, RuntimeError, ValueError):
        raise UserError(f"{path} names an impossible file: correct its mtllib and map_Kd lines") from None
    outside = "\\" in word or inner.is_absolute() or ".." in inner.parts or not real.is_relative_to(path.parent.resolve())
    if outside or not word.isprintable() or len(word) > _MAX_NAME:
        raise UserError(
            f"{path} names {word[:80]!a}, which is not below its own folder: copy it there, and name it without folders"
        )
    return real
