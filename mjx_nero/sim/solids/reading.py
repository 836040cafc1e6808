"""Reads meshes of objects as plain arrays, from OBJ, STL and GLB files. The files may be untrusted, so there are limits.

The package has its own readers: general ones follow references, unpack archives, and trust the counts that a file states.
"""

import dataclasses
import io
import pathlib
import re

import numpy as np
from PIL import Image

from mjx_nero.sim.solids import glb, materials
from mjx_nero.sim.solids.materials import GREY, Look
from mjx_nero.sim.solids.store import KINDS
from mjx_nero.types import UserError

MAX_TRIANGLES = 4_000_000
MAX_NUMBERS = 30_000_000  # in a text file
MAX_PIXELS = 8192  # along an edge of a picture
PIXELS = 1024  # along an edge, as drawn
_FAR = 1e6  # bound of a coordinate


@dataclasses.dataclass(frozen=True)
class Raw:
    """The content of a mesh file.

    Attributes:
        vertices: [n, 3], in the file's unit.
        faces: [m, 3], indices of vertices.
        uv: [n, 2], or empty: places of the vertices in the texture.
        texture: uint8 [height, width, 3], or empty.
        rgba: colour.
        missing: a file of its materials that is not there; empty: all are.
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    texture: np.ndarray
    rgba: tuple[float, float, float, float]
    missing: str = ""


def read(path: pathlib.Path, content: bytes) -> Raw:
    """Reads a mesh.

    Args:
        path: its path; its materials must lie in the same folder.
        content: its bytes.

    Raises:
        UserError: it holds no triangles, is damaged or too large, or names files elsewhere.
    """
    kind = path.suffix.lower()
    if kind not in KINDS:
        raise UserError(f"{path} is not a supported mesh: give one of {', '.join(KINDS)}")
    try:
        vertices, faces, uv, look = {".obj": _obj, ".stl": _stl, ".glb": _glb}[kind](path, content)
    except UserError:
        raise
    except ValueError as error:
        raise UserError(f"{path} cannot be read as {kind[1:].upper()}: {' '.join(str(error).split())[:160]}") from None
    return _checked(path, vertices, faces, uv, look)


def _checked(path, vertices, faces, uv, look: Look) -> Raw:
    if not len(faces) or not len(vertices):
        raise UserError(f"{path} holds no triangles")
    if len(faces) > MAX_TRIANGLES:
        raise UserError(f"{path} has {len(faces):,} triangles: at most {MAX_TRIANGLES:,} are read")
    if not (np.abs(vertices) < _FAR).all():
        raise UserError(f"{path} has a coordinate that is not finite or not below {_FAR:g}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(f"{path} has a triangle with vertices that it does not have")
    texture = np.zeros((0, 0, 3), np.uint8) if look.picture is None else _picture(path, look.picture)
    if not texture.size or len(uv) != len(vertices) or not np.isfinite(uv).all():
        uv = np.zeros((0, 2))
    return Raw(vertices.astype(float), faces.astype(np.int64), uv.astype(np.float32), texture, look.rgba, look.missing)


def _stl(path, content: bytes):
    binary = len(content) >= 84 and len(content) == 84 + 50 * int.from_bytes(content[80:84], "little")
    if binary:
        rows = np.frombuffer(content, np.dtype([("n", "<f4", 3), ("v", "<f4", (3, 3)), ("a", "<u2")]), offset=84)
        corners = rows["v"].reshape(-1, 3)
    else:
        if not content.lstrip()[:5].lower() == b"solid":
            raise ValueError("neither a binary file of the stated length nor text")
        corners = _numbers(re.findall(rb"^\s*vertex\s+([^\r\n]*)", content, re.MULTILINE), "vertex")
    if len(corners) % 3:
        raise ValueError("its vertices do not make up triangles")
    vertices, inverse = np.unique(corners, axis=0, return_inverse=True) if np.isfinite(corners).all() else (corners, None)
    faces = (np.arange(len(corners)) if inverse is None else inverse).reshape(-1, 3)
    return vertices, faces, np.zeros((0, 2)), Look()


def _obj(path: pathlib.Path, content: bytes):
    content = content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ")
    places = _numbers(re.findall(rb"^[ \t]*v[ \t]+([^\r\n#]*)", content, re.MULTILINE), "v")
    lines = re.findall(rb"^[ \t]*f[ \t]+([^\r\n#]*)", content, re.MULTILINE)
    textured = _numbers(re.findall(rb"^[ \t]*vt[ \t]+([^\r\n#]*)", content, re.MULTILINE), "vt", 2)
    words = [line.split() for line in lines]
    if sum(map(len, words)) > MAX_NUMBERS:
        raise ValueError(f"more than {MAX_NUMBERS:,} numbers")
    corners = [word for row in words for word in row]
    at = _indices([word.partition(b"/")[0] for word in corners], len(places))
    sizes = np.fromiter(map(len, words), np.int64, len(words))
    if (sizes < 3).any():
        raise ValueError("a face of fewer than three corners")
    fan = _fan(sizes)
    look = materials.of(path, content)
    if not len(textured) or look.picture is None or not all(b"/" in word for word in corners):
        return places, at[fan], np.zeros((0, 2)), dataclasses.replace(look, picture=None)
    seams = _indices([word.split(b"/")[1] for word in corners], len(textured))
    pairs, each = np.unique(np.stack([at, seams], axis=1), axis=0, return_inverse=True)
    if pairs.min() < 0 or pairs[:, 0].max() >= len(places) or pairs[:, 1].max() >= len(textured):
        raise ValueError("a face with vertices that it does not have")
    return places[pairs[:, 0]], each.reshape(-1)[fan], textured[pairs[:, 1]], look


def _fan(sizes: np.ndarray) -> np.ndarray:
    """Corners of triangles [n, 3] that fill polygons of ``sizes`` corners, numbered through all polygons."""
    first = np.cumsum(sizes) - sizes
    if (sizes == 3).all():
        return first[:, None] + np.arange(3)
    each = sizes - 2
    start, step = np.repeat(first, each), np.arange(each.sum()) - np.repeat(np.cumsum(each) - each, each)
    return np.stack([start, start + step + 1, start + step + 2], axis=1)


def _indices(words: list[bytes], count: int) -> np.ndarray:
    """Whole numbers from 1, or from -1 backwards, as indices from 0."""
    if any(len(word) > 10 for word in words):
        raise ValueError("an index of more than ten digits")
    found = np.array(words).astype(np.int64) if words else np.zeros(0, np.int64)
    return np.where(found < 0, found + count, found - 1)


def _numbers(lines: list[bytes], what: str, least: int = 3) -> np.ndarray:
    """The first ``least`` numbers of each line, [n, least]. All lines must have equally many."""
    if not lines:
        return np.zeros((0, least))
    words = b" ".join(lines).split()
    width, rest = divmod(len(words), len(lines))
    if len(words) > MAX_NUMBERS or rest or width < least:
        raise ValueError(f"its {what} lines do not all have the same number of values, {least} or more")
    if max(map(len, words)) > 40:
        raise ValueError(f"a number of more than 40 characters in a {what} line")
    return np.array(words).astype(float).reshape(-1, width)[:, :least]


def _glb(path: pathlib.Path, content: bytes):
    vertices, faces, uv, picture, rgba = glb.parse(content, MAX_TRIANGLES)
    return vertices, faces, uv, Look(rgba or GREY, picture)


def _picture(path: pathlib.Path, content: bytes) -> np.ndarray:
    """Decodes a PNG or JPEG whose size is checked before it is unpacked; uint8 [height, width, 3]."""
    try:
        with Image.open(io.BytesIO(content), formats=("PNG", "JPEG")) as picture:
            if max(picture.size) > MAX_PIXELS or not min(picture.size):
                raise UserError(
                    f"the texture of {path} has {picture.size[0]} x {picture.size[1]} pixels: at most {MAX_PIXELS} per edge"
                )
            picture.draft("RGB", (PIXELS, PIXELS))
            small = picture.convert("RGB")
            small.thumbnail((PIXELS, PIXELS))
            return np.asarray(small)
    except UserError:
        raise
    except Exception as error:  # decoders fail in their own ways
        raise UserError(f"the texture of {path} is not a valid PNG or JPEG: {' '.join(str(error).split())[:100]}") from None
