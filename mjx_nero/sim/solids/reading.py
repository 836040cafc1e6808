"""Reads meshes of objects as plain arrays, from OBJ, STL and GLB files. The files may be untrusted, so there are limits.

The package has its own readers: general ones follow references, unpack archives, and trust the counts that a file states.
"""

import dataclasses
import io
import pathlib
import re

import numpy as np
from PIL import Image

from mjx_nero import files
from mjx_nero.sim.solids import glb
from mjx_nero.sim.solids.store import GREY, KINDS
from mjx_nero.types import UserError

MAX_TRIANGLES = 4_000_000
MAX_NUMBERS = 30_000_000  # in a text file
MAX_MTL = 1_000_000  # bytes of a file of materials
MAX_PICTURE = 40_000_000  # bytes
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
    """

    vertices: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    texture: np.ndarray
    rgba: tuple[float, float, float, float]


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
        vertices, faces, uv, picture, rgba = {".obj": _obj, ".stl": _stl, ".glb": _glb}[kind](path, content)
    except ValueError as error:
        raise UserError(f"{path} cannot be read as {kind[1:].upper()}: {' '.join(str(error).split())[:160]}") from None
    return _checked(path, vertices, faces, uv, picture, rgba)


def _checked(path, vertices, faces, uv, picture, rgba) -> Raw:
    if not len(faces) or not len(vertices):
        raise UserError(f"{path} holds no triangles")
    if len(faces) > MAX_TRIANGLES:
        raise UserError(f"{path} has {len(faces):,} triangles: at most {MAX_TRIANGLES:,} are read")
    if not (np.abs(vertices) < _FAR).all():
        raise UserError(f"{path} has a coordinate that is not finite or not below {_FAR:g}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(f"{path} has a triangle with vertices that it does not have")
    texture = np.zeros((0, 0, 3), np.uint8) if picture is None else _picture(path, picture)
    if not texture.size or len(uv) != len(vertices) or not np.isfinite(uv).all():
        uv = np.zeros((0, 2))
    return Raw(vertices.astype(float), faces.astype(np.int64), uv.astype(np.float32), texture, rgba)


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
    return vertices, faces, np.zeros((0, 2)), None, GREY


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
    picture, rgba = _materials(path, content)
    if not len(textured) or picture is None or not all(b"/" in word for word in corners):
        return places, at[fan], np.zeros((0, 2)), None, rgba
    seams = _indices([word.split(b"/")[1] for word in corners], len(textured))
    pairs, each = np.unique(np.stack([at, seams], axis=1), axis=0, return_inverse=True)
    if pairs.min() < 0 or pairs[:, 0].max() >= len(places) or pairs[:, 1].max() >= len(textured):
        raise ValueError("a face with vertices that it does not have")
    return places[pairs[:, 0]], each.reshape(-1)[fan], textured[pairs[:, 1]], picture, rgba


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


def _materials(path: pathlib.Path, content: bytes) -> tuple[bytes | None, tuple[float, float, float, float]]:
    """The first texture and the first colour that the file's materials name."""
    found = re.search(rb"^[ \t]*mtllib[ \t]+([^\r\n]+)", content, re.MULTILINE)
    if not found:
        return None, GREY
    text = files.read_bytes(_beside(path, found[1]), MAX_MTL)
    colour = re.search(rb"^[ \t]*Kd[ \t]+([^\r\n]+)", text, re.MULTILINE)
    rgb = np.clip(_numbers([colour[1]], "Kd")[0], 0, 1) if colour else np.array(GREY[:3])
    if not np.isfinite(rgb).all():
        raise ValueError("a colour that is not finite")
    picture = re.search(rb"^[ \t]*map_Kd[ \t]+([^\r\n]+)", text, re.MULTILINE)
    rgba = (float(rgb[0]), float(rgb[1]), float(rgb[2]), 1.0)
    return (files.read_bytes(_beside(path, picture[1]), MAX_PICTURE) if picture else None), rgba


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
    if outside or not word.isprintable() or len(word) > 200:
        raise UserError(f"{path} names {word[:80]!a}, which is not below its own folder: copy it there")
    return real


def _glb(path: pathlib.Path, content: bytes):
    vertices, faces, uv, picture, rgba = glb.parse(content, MAX_TRIANGLES)
    return vertices, faces, uv, picture, rgba or GREY


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
