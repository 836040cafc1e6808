"""Results that take seconds of every start, kept between runs in the user's cache: an expert's episodes, and lowered programs.

They are pure functions of the task, the package and the machine, which all are in the names of their files. A task with code from
outside of the package is not kept, because nothing says when that code changes.
"""

import contextlib
import dataclasses
import functools
import hashlib
import json
import os
import pathlib
import platform
from collections.abc import Callable, Iterator, Mapping, Sequence
from importlib import metadata
from typing import Any

import jax

from mjx_nero.errors import UserError
from mjx_nero.files import cache
from mjx_nero.learn import checkpoint, device_memory, machines
from mjx_nero.sim.robot import ASSETS

ROOM = 1_000_000_000  # bytes of a folder; programs have 1 MB, most episodes 10 MB, 256 long ones 200 MB
_HERE = pathlib.Path(__file__).parents[1]
_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx", "numpy")
_SETTINGS = ("XLA_", "JAX_ENABLE", "JAX_DEFAULT", "JAX_NUMPY")  # environment variables that may change a number


class Outside(Exception):
    """A value that no text describes in full, or code that is not the package's."""


class Shelf:
    """The kept results of a function on this machine, by name. Nothing is kept if the function cannot be described.

    Args:
        kind: name of their folder in the cache.
        what: configs, numbers and texts that describe the function.
    """

    def __init__(self, kind: str, *what: Any):
        folder = cache.folder()
        try:
            self._base = folder / kind / _fingerprint(what) if folder else None
        except (Outside, ImportError, OSError, TypeError):  # an ImportError: a package without metadata
            self._base = None

    def __bool__(self) -> bool:
        """False if nothing is kept."""
        return self._base is not None

    def has(self, name: int | str) -> bool:
        """True if something was written under this name."""
        path = self._path(name)
        return path is not None and path.is_file()

    def read(self, name: int | str, template: Callable[[dict[str, Any]], Any]) -> tuple[Any, dict[str, Any]] | None:
        """Reads what ``write`` has written, as a tree like the one that ``template`` makes of the description; None if it is
        missing or damaged."""
        path = self._path(name)
        if path is None or not path.is_file():
            return None
        try:
            about = checkpoint.load_meta(path)
            with jax.default_device(machines.processor()):  # a GPU's first array takes seconds
                found = jax.device_get(checkpoint.load(path, template(about)))
            path.touch()
            return found, about
        except (UserError, OSError):
            return None

    def write(self, name: int | str, tree: Any, meta: dict[str, Any]) -> None:
        """Keeps a tree of arrays, unless the disk is full. Files that were not read for a long time make room for it."""
        path, left = self._path(name), ROOM - device_memory.size(tree)
        if path is None or left < 0:
            return
        with contextlib.suppress(UserError, OSError):
            path.parent.mkdir(exist_ok=True)
            for old in sorted(path.parent.glob("*.safetensors"), key=lambda file: -file.stat().st_mtime):
                left -= old.stat().st_size
                if left < 0:
                    old.unlink()
            checkpoint.save(path, tree, meta)

    def _path(self, name: int | str) -> pathlib.Path | None:
        return self._base and self._base.with_name(f"{self._base.name}-{name}.safetensors")


def _fingerprint(what: Sequence[Any]) -> str:
    said = [_said(x) for x in what]
    places = [_HERE, ASSETS, *filter(None, map(_place, _strings(said)))]
    told = json.dumps([said, _machine(), *map(_state, dict.fromkeys(places))])
    return hashlib.sha256(told.encode()).hexdigest()[:32]


def _said(value: Any) -> Any:
    """Describes a value for JSON, types and functions by name.

    Raises:
        Outside: see there.
    """
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return [_name(type(value)), {f.name: _said(getattr(value, f.name)) for f in dataclasses.fields(value)}]
    if isinstance(value, Mapping):
        return {str(name): _said(x) for name, x in value.items()}
    if isinstance(value, tuple | list):
        return [_said(x) for x in value]
    if isinstance(value, functools.partial):
        return [_said(x) for x in (value.func, value.args, value.keywords)]
    return _name(value) if callable(value) else value


def _name(value: Callable[..., Any]) -> str:
    module, name = getattr(value, "__module__", ""), getattr(value, "__qualname__", "<")
    if not module.startswith("mjx_nero.") or "<" in name:  # <lambda>, <locals>
        raise Outside(value)
    return f"{module}.{name}"


def _strings(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, list | dict):
        for x in value.values() if isinstance(value, dict) else value:
            yield from _strings(x)


def _place(text: str) -> pathlib.Path | None:
    """Returns the file or folder that a text names, if there is one."""
    with contextlib.suppress(OSError, ValueError):
        place = pathlib.Path(text)
        if ("." in text or os.sep in text) and place.name not in ("", "..") and place.exists():
            return place
    return None


def _state(place: pathlib.Path) -> list[Any]:
    """Describes the files in a place by name, size and time of change."""
    files = sorted(file for file in (place.rglob("*") if place.is_dir() else [place]) if file.suffix != ".pyc")
    return [[str(file), status.st_size, status.st_mtime_ns] for file in files if not file.is_dir() and (status := file.stat())]


@functools.cache
def _machine() -> list[Any]:
    """Describes versions and processor: another one rounds otherwise."""
    processor = pathlib.Path("/proc/cpuinfo")
    lines = processor.read_text().splitlines() if processor.is_file() else [platform.processor()]
    model = sorted({line for line in lines if line.startswith(("model name", "flags"))}) or lines[:1]
    settings = sorted((name, value) for name, value in os.environ.items() if name.startswith(_SETTINGS))
    precise = [str(getattr(jax.config, name)) for name in ("jax_enable_x64", "jax_default_matmul_precision")]
    return [platform.python_version(), {name: metadata.version(name) for name in _PACKAGES}, model, settings, precise]
