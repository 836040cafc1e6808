"""Imports MJX, without what it never uses here and without the lines that it prints then. To be imported before Brax.

Brax imports MJX, too. MJX imports two packages for things that a program of ours does seldom or never, and each takes longer than
MJX itself:

- Warp, with all of MuJoCo Warp, for its own way to them. Nothing here goes that way: ``physics.mujoco_warp`` calls MuJoCo Warp
  itself. MJX has its way if Warp is imported before this package.
- trimesh, for the convex hulls of collision meshes. It is imported with the first mesh.
"""

import contextlib
import io
import sys
import types
from typing import Any


class _Later(types.ModuleType):
    """Stands in for trimesh in MJX's module of meshes."""

    @staticmethod
    def Trimesh(*args: Any, **kwargs: Any) -> Any:
        import trimesh

        return trimesh.Trimesh(*args, **kwargs)


_stand_ins = {"warp": None, "trimesh": _Later("trimesh")}  # what is None there cannot be imported
_hidden = {name: stand_in for name, stand_in in _stand_ins.items() if name not in sys.modules}
sys.modules |= _hidden  # type: ignore[arg-type]
try:
    with contextlib.redirect_stdout(io.StringIO()):
        import mujoco.mjx  # noqa: F401
finally:
    for _name in _hidden:
        del sys.modules[_name]
