"""Finds the solid of a mesh file, of a folder with ``object.yaml``, or of one of the package's objects.

Solids are kept in the user's cache, by the content of their files.
"""

import contextlib
import dataclasses
import functools
import hashlib
import pathlib

import numpy as np

from mjx_nero import files
from mjx_nero.config import bounds, values
from mjx_nero.sim.robot import ASSETS
from mjx_nero.sim.solids import kept, materials, solid
from mjx_nero.sim.solids.materials import GREY
from mjx_nero.sim.solids.solid import Solid
from mjx_nero.types import UserError

HOME = ASSETS / "objects"
ABOUT = "object.yaml"
KINDS = (".obj", ".stl", ".glb")
MAX_BYTES = 300_000_000  # of a mesh file
_VERSION = 10  # of the cached format


@dataclasses.dataclass(frozen=True)
class AboutCfg:
    """The fields of ``object.yaml``.

    Attributes:
        mesh: file of the mesh to draw and weigh, in the same folder.
        parts: file of its convex parts, in the same folder. Empty: the mesh is cut.
        density: density [kg/m3].
        rgba: colour.
    """

    mesh: str
    parts: str = ""
    density: bounds.Positive = solid.DENSITY
    rgba: tuple[float, float, float, float] = GREY


@functools.lru_cache(maxsize=1)
def names() -> tuple[str, ...]:
    """Names of the package's own objects."""
    return tuple(sorted(path.parent.name for path in HOME.glob(f"*/{ABOUT}")))


def find(file: str) -> Solid:
    """The solid of a file (OBJ, STL or GLB), of a folder with an ``object.yaml``, or of an object of the package by name.

    Raises:
        UserError: there is none, or it cannot be used; the message says why.
    """
    path = _path(file)
    try:
        status = path.stat()
    except (OSError, ValueError) as error:
        raise UserError(f"cannot read {path}: {getattr(error, 'strerror', None) or error}") from None
    return _found(path, status.st_mtime_ns, status.st_size)


def _path(file: str) -> pathlib.Path:
    if file in names():
        return HOME / file / ABOUT
    path = pathlib.Path(file)
    with contextlib.suppress(OSError, ValueError):
        if path.is_dir():
            return path / ABOUT
    if path.suffix.lower() not in (*KINDS, ".yaml"):
        near = values.hint(file, names())
        raise UserError(
            f"no object {values.short(file)}{near}: give a file ({', '.join(KINDS)}), a folder with {ABOUT}, "
            f"or one of {', '.join(names())}"
        )
    return path


@functools.lru_cache(maxsize=64)
def _found(path: pathlib.Path, *_changed: int) -> Solid:
    about = _about(path)
    whole = files.inside(path.parent, about.mesh) if path.suffix == ".yaml" else path
    content = files.read_bytes(whole, MAX_BYTES)
    more = files.read_bytes(files.inside(path.parent, about.parts), MAX_BYTES) if about.parts else b""
    key = hashlib.sha256(repr((_VERSION, solid.MAX_PARTS, solid.MAX_CORNERS, dataclasses.astuple(about))).encode())
    look = materials.of(whole, content) if whole.suffix.lower() == ".obj" else materials.Look()
    for part in (content, more, repr(look.rgba).encode(), look.picture or b""):
        key.update(hashlib.sha256(part).digest())

    def make() -> dict[str, np.ndarray]:
        from mjx_nero.sim.solids import making, reading  # configs and help do not need them

        try:
            raw = reading.read(whole, content)
            parts = making.cut(whole, reading.read(files.inside(path.parent, about.parts), more)) if more else None
            if path.suffix == ".yaml" and not raw.texture.size:
                raw = dataclasses.replace(raw, rgba=about.rgba)
            return making.make(raw, parts, about.density).arrays()
        except UserError as error:
            text = str(error)
            raise error if str(whole) in text else UserError(f"{whole} {text}") from None

    return Solid.of(kept.arrays(f"{key.hexdigest()[:32]}.solid", make))


def _about(path: pathlib.Path) -> AboutCfg:
    if path.suffix != ".yaml":
        return AboutCfg(mesh=path.name)
    about = values.read(AboutCfg, files.read_yaml(path), f"{path}")
    for name in filter(None, (about.mesh, about.parts)):
        if pathlib.PurePath(name).name != name or pathlib.PurePath(name).suffix.lower() not in KINDS:
            raise UserError(f"{path}: {values.short(name)} is not a {', '.join(KINDS)} file in its own folder: change it")
    return about
