"""GPU-vectorised JAX library of robot-arm tasks."""

import contextlib
import ctypes
import importlib
import os
import sys
from importlib import metadata
from typing import TYPE_CHECKING, Any

from mjx_nero.errors import missing

if TYPE_CHECKING:
    from mjx_nero.envs.env import ManipulationEnv
    from mjx_nero.envs.task import EnvCfg
    from mjx_nero.errors import UserError
    from mjx_nero.interop.guests import register
    from mjx_nero.tasks.registry import env_cfg, list_envs, list_presets, list_robots, make

__version__ = "0.6.0.dev0"
__all__ = ["EnvCfg", "ManipulationEnv", "UserError", "env_cfg", "list_envs", "list_presets", "list_robots", "make", "register"]

# Public name -> its module, which is imported at first use: JAX, MuJoCo and Brax take seconds to load.
_HOME = {
    "EnvCfg": "mjx_nero.envs.task",
    "ManipulationEnv": "mjx_nero.envs.env",
    "UserError": "mjx_nero.errors",
    "register": "mjx_nero.interop.guests",
    **dict.fromkeys(("env_cfg", "list_envs", "list_presets", "list_robots", "make"), "mjx_nero.tasks.registry"),
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module 'mjx_nero' has no attribute {name!r}")
    try:
        value = getattr(importlib.import_module(_HOME[name]), name)
    except ModuleNotFoundError as error:
        raise ImportError(missing(error), name=error.name) from None
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


def cores() -> int:
    """Returns the number of processors that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _prepare() -> None:
    """Sets the environment variables that JAX and MuJoCo read when they start."""
    # XLA's CPU compiler in JAX before 0.11 has two traps. Its fusion recomputes an unrolled kinematic tree over and over (one
    # batched step takes seconds instead of milliseconds), and its concurrent scheduler can deadlock where physics and networks
    # share a loop. Later versions fuse MJX well and have no such scheduler, and the newest abort on the first flag. So set both
    # flags for old versions only, before the first JAX computation. Our own chains have barriers (``sim.kinematics``).
    with contextlib.suppress(metadata.PackageNotFoundError):
        if tuple(int(x) for x in metadata.version("jaxlib").split(".")[:2]) < (0, 11):
            for flag in ("xla_cpu_use_fusion_emitters", "xla_cpu_enable_concurrency_optimized_scheduler"):
                if flag not in os.environ.get("XLA_FLAGS", ""):
                    os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --{flag}=false".strip()
    # With one processor XLA has one thread, and a program that calls back into the C library sometimes waits for itself.
    if cores() == 1:
        os.environ.setdefault("NPROC", "2")
    # MuJoCo chooses its OpenGL when it is first imported. Without a display it needs EGL, or else OSMesa (software).
    if sys.platform == "linux" and not {"MUJOCO_GL", "DISPLAY"} & os.environ.keys():
        for gl, library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8"), ("osmesa", "libOSMesa.so.6")):
            with contextlib.suppress(OSError):
                ctypes.CDLL(library)
                os.environ["MUJOCO_GL"] = gl
                break


_prepare()
