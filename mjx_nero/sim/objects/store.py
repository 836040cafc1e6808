"""Finds the solid of a mesh file, of a folder with ``object.yaml``, or of one of the package's objects, and caches it.

A solid is cached beside its file, or in the user's cache if that folder is not writable. It is found again by the content of the
files, and checked like any other untrusted file.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import pathlib
from typing import Any

import numpy as np
from safetensors import SafetensorError
from safetensors import numpy as tensors

from mjx_nero import files
from mjx_nero.config import bounds, values
from mjx_nero.files import cache
from mjx_nero.sim.objects import materials, solid
from mjx_nero.sim.objects.materials import GREY
from mjx_nero.sim.objects.solid import Solid
from mjx_nero.sim.robot import ASSETS
from mjx_nero.types import UserError

HOME = ASSETS / "objects"
ABOUT = "object.yaml"
MAX_KEPT = 30_000_000  # bytes
ENDING = ".solid"
KINDS = (".obj", ".stl", ".glb")
MAX_BYTES = 300_000_000  # of a mesh file
_VERSION = 9  # of the cached format
_ARRAYS = {field.name for field in dataclasses.fields(Solid) if field.name not in ("volume", "rgba", "density", "note")}


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
    places = _places(path, key.hexdigest())
    for place in places:
        if (kept := _kept(place, key.hexdigest())) is not None:
            return kept
    from mjx_nero.sim.objects import making, reading  # configs and help do not need them

    try:
        raw = reading.read(whole, content)
        parts = making.cut(whole, reading.read(files.inside(path.parent, about.parts), more)) if more else None
        if path.suffix == ".yaml" and not raw.texture.size:
            raw = dataclasses.replace(raw, rgba=about.rgba)
        made = making.make(raw, parts, about.density)
    except UserError as error:
        text = str(error)
        raise error if str(whole) in text else UserError(f"{whole} {text}") from None
    _keep(places, made, key.hexdigest())
    return made


def _about(path: pathlib.Path) -> AboutCfg:
    if path.suffix != ".yaml":
        return AboutCfg(mesh=path.name)
    about = values.read(AboutCfg, files.read_yaml(path), f"{path}")
    for name in filter(None, (about.mesh, about.parts)):
        if pathlib.PurePath(name).name != name or pathlib.PurePath(name).suffix.lower() not in KINDS:
            raise UserError(f"{path}: {values.short(name)} is not a {', '.join(KINDS)} file in its own folder: change it")
    return about


def _places(path: pathlib.Path, key: str) -> list[pathlib.Path]:
    """Lists the places where the solid may be cached: beside its file, else in the user's cache."""
    found = [path.with_name(path.name + ENDING)] if not path.is_relative_to(HOME) else []
    if kept := cache.folder():
        found.append(kept / "objects" / (key[:32] + ENDING))
    return found


def _keep(places: list[pathlib.Path], made: Solid, key: str) -> None:
    """Writes the solid to the first place that takes it. If none does, it is made again the next time."""
    plain = {"volume": made.volume, "rgba": made.rgba, "density": made.density, "note": made.note}
    arrays = {name: np.ascontiguousarray(getattr(made, name)) for name in _ARRAYS}
    content = tensors.save(arrays, {"key": key, "plain": json.dumps(plain)})
    for place in places:
        if os.access(place.parent if place.parent.exists() else place.parent.parent, os.W_OK) and len(content) <= MAX_KEPT:
            with contextlib.suppress(UserError):
                return files.write(place, content)


def _kept(place: pathlib.Path, key: str) -> Solid | None:
    """The solid that was cached for these files; None: there is none, it belongs to other files, or it is damaged."""
    if not os.path.lexists(place) or place.is_symlink():
        return None
    try:
        content = files.read_bytes(place, MAX_KEPT)
        length = int.from_bytes(content[:8], "little")
        head = files.parse_json(content[8 : 8 + length]).get("__metadata__", {}) if length < 100_000 else {}
        if head.get("key") != key:
            return None
        plain, arrays = files.parse_json(head["plain"]), tensors.load(content)
        plain["rgba"] = tuple(plain["rgba"])
        fields: dict[str, Any] = {**arrays, **plain}
        found = Solid(**fields)
        return found if _sound(found) else None
    except (UserError, SafetensorError, ValueError, KeyError, TypeError, AttributeError, RecursionError):
        return None


def _sound(found: Solid) -> bool:
    """True if a cached solid is usable: shapes, ranges and finite numbers."""
    n, rests = len(found.vertices), len(found.rest_quat)
    shapes = [found.points.shape[1:] == (3,), found.vertices.shape[1:] == (3,), found.faces.shape[1:] == (3,)]
    shapes += [found.inertia.shape == (3, 3), found.center.shape == (3,), found.rest_quat.shape == (rests, 4)]
    shapes += [found.rest_share.shape == (rests,), rests > 0, found.uv.shape in ((n, 2), (0, 2)), found.texture.ndim == 3]
    if not all(shapes) or not 1 <= len(found.sizes) <= solid.MAX_PARTS or int(found.sizes.sum()) != len(found.points):
        return False
    counts = found.sizes.min() >= 4 and found.faces.min() >= 0 and found.faces.max() < n
    real = [found.points, found.vertices, found.inertia, found.center, found.rest_quat, found.rest_share, found.uv]
    small = all(np.isfinite(x).all() and np.abs(x).max(initial=0) < 1e7 for x in real)
    turned = np.abs(np.linalg.norm(found.rest_quat, axis=1) - 1).max() < 1e-3 and found.rest_share.min() >= 0
    heavy = (np.linalg.eigvalsh(found.inertia) > 0).all() and found.volume > 0 and found.density > 0
    return bool(counts and small and turned and heavy and len(found.rgba) == 4)
