"""GPU-vectorised JAX library of robot-arm tasks."""

import contextlib
import ctypes
import io
import os
import sys
from importlib import metadata

# Two traps of XLA's CPU compiler in JAX before 0.11: its fusion recomputes an unrolled kinematic tree without end (one batched
# step takes seconds instead of milliseconds), and its concurrent scheduler can deadlock where physics and networks share a
# loop. Later versions have neither, and the newest abort on the first flag, so both are set for the old ones alone, before the
# first JAX computation.
if tuple(int(x) for x in metadata.version("jaxlib").split(".")[:2]) < (0, 11):
    for _flag in ("xla_cpu_use_fusion_emitters", "xla_cpu_enable_concurrency_optimized_scheduler"):
        if _flag not in os.environ.get("XLA_FLAGS", ""):
            os.environ["XLA_FLAGS"] = f"{os.environ.get('XLA_FLAGS', '')} --{_flag}=false".strip()

# MuJoCo picks its OpenGL when it is first imported. Without a display the way is EGL, else OSMesa (software).
if sys.platform == "linux" and not {"MUJOCO_GL", "DISPLAY"} & os.environ.keys():
    for _gl, _library in (("egl", "libEGL.so.1"), ("osmesa", "libOSMesa.so.8"), ("osmesa", "libOSMesa.so.6")):
        with contextlib.suppress(OSError):
            ctypes.CDLL(_library)
            os.environ["MUJOCO_GL"] = _gl
            break

with contextlib.redirect_stdout(io.StringIO()):  # without Warp, which only GPUs need, MJX prints that it is missing
    import mujoco.mjx  # noqa: F401

from mjx_nero.env import EnvCfg, ManipulationEnv
from mjx_nero.registry import env_cfg, list_envs, list_presets, list_robots, make
from mjx_nero.types import UserError

__version__ = "0.4.0"
__all__ = ["EnvCfg", "ManipulationEnv", "UserError", "env_cfg", "list_envs", "list_presets", "list_robots", "make"]
