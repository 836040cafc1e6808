"""Imports MJX, without Warp and without the lines that it prints then. To be imported before Brax, which imports MJX, too.

MJX's own way to Warp would import Warp and all of MuJoCo Warp, which takes longer than the rest of a program's start. Nothing
here goes that way: ``physics.mujoco_warp`` calls MuJoCo Warp itself. MJX has its way if Warp is imported before this package.
"""

import contextlib
import io
import sys

_hidden = {"warp": None} if "warp" not in sys.modules else {}  # what is None there cannot be imported
sys.modules |= _hidden  # type: ignore[arg-type]
try:
    with contextlib.redirect_stdout(io.StringIO()):
        import mujoco.mjx  # noqa: F401
finally:
    for _name in _hidden:
        del sys.modules[_name]
