"""MuJoCo Warp's functions, each imported with its own module when it is first read.

Python takes more than a second to read the whole package, most of it for parts that the package's own kernels stand for. What is
not named here comes from the package itself.
"""

import importlib
from typing import Any

from mjx_nero.sim.quiet import unread

_PACKAGE = "mujoco.mjx.third_party.mujoco_warp"
_MODULES = {
    "put_model": "io",
    "make_data": "io",
    "collision": "collision_driver",
    "make_constraint": "constraint",
    "kinematics": "smooth",
    "com_pos": "smooth",
    "rne_postconstraint": "smooth",
    "contact_force_fn": "support",
    "ContactType": "types",
    "OverflowType": "types",
}


def __getattr__(name: str) -> Any:
    if name.startswith("__"):
        raise AttributeError(name)
    package: Any = unread(_PACKAGE)
    if name in _MODULES:
        package = importlib.import_module(f"{_PACKAGE}._src.{_MODULES[name]}")
    return getattr(package, name)
