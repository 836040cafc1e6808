"""Imports MJX without two packages that it does not need here, and without the lines that it prints. Import it before Brax.

Brax imports MJX, too. The two packages are seldom or never needed, and each takes longer to import than MJX itself:

- Warp, with all of MuJoCo Warp, is for MJX's own wrapper of it. Nothing here uses that wrapper: ``physics.mujoco_warp`` calls
  MuJoCo Warp itself. The wrapper works if Warp is imported before this package.
- trimesh is for the convex hulls of collision meshes. It is imported with the first mesh.
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


_stand_ins = {"warp": None, "trimesh": _Later("trimesh")}  # a module that is None there cannot be imported
_hidden = {name: stand_in for name, stand_in in _stand_ins.items() if name not in sys.modules}
sys.modules |= _hidden  # type: ignore[arg-type]
try:
    with contextlib.redirect_stdout(io.StringIO()):
        import mujoco.mjx  # noqa: F401
finally:
    for _name in _hidden:
        del sys.modules[_name]
