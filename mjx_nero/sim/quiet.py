"""Imports MJX and Brax's ``Env``, ``State`` and ``Wrapper`` without packages that they do not need here, and without the lines
that they print. It must come before all of Brax, so it has a section of its own among a file's imports.

These packages are seldom or never needed, and take longer to import than MJX and ``Env`` themselves:

- Warp, with all of MuJoCo Warp, is for MJX's own wrapper of it. Nothing here uses that wrapper: ``physics.warp`` calls MuJoCo
  Warp itself. The wrapper works if Warp is imported before this package.
- trimesh and SciPy's geometry are for the convex hulls of collision meshes.
- Brax's own environments and engines stand beside ``Env``: in its package, and in its module for the class after it.

All but Warp are imported later, when something first reads an attribute of theirs.
"""

import contextlib
import importlib
import importlib.util
import io
import sys
import types
from typing import Any

from mjx_nero.files.imports import Later, replaced


class _Unread(types.ModuleType):
    """A package whose own code runs when one of its attributes is first read. Its modules can be imported without it."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        self.__class__ = types.ModuleType  # type: ignore[assignment]
        assert self.__spec__ and self.__spec__.loader
        self.__spec__.loader.exec_module(self)
        return getattr(self, name)


def unread(name: str) -> types.ModuleType:
    """Returns a package whose own code runs when one of its attributes is first read, unless it is imported already."""
    if name not in sys.modules:
        spec = importlib.util.find_spec(name)
        assert spec
        package = sys.modules[name] = importlib.util.module_from_spec(spec)
        parent, _, own = name.rpartition(".")
        setattr(sys.modules[parent], own, package)
        package.__class__ = _Unread
    return sys.modules[name]


_MJX = {"warp": None, "trimesh": Later("trimesh"), "scipy.spatial": Later("scipy.spatial")}
_ENGINES = ("brax.generalized.pipeline", "brax.mjx.pipeline", "brax.positional.pipeline", "brax.spring.pipeline", "brax.io.image")

with contextlib.redirect_stdout(io.StringIO()), replaced(_MJX):
    importlib.import_module("mujoco.mjx")
unread("brax.envs")
with replaced({name: Later(name) for name in _ENGINES}):
    from brax.envs.base import Env as Env
    from brax.envs.base import State as State
    from brax.envs.base import Wrapper as Wrapper
