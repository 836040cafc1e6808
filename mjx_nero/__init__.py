"""GPU-vectorised JAX library of robot-arm lift tasks."""

import contextlib
import io
import os
from importlib import metadata

# XLA's CPU fusion of JAX before 0.11 recomputes an unrolled kinematic tree without end: one batched step takes seconds instead
# of milliseconds. Later versions don't, and the newest abort on the flag, so it is set for the old ones alone, and before
# the first JAX computation.
_flags = os.environ.get("XLA_FLAGS", "")
if tuple(int(x) for x in metadata.version("jaxlib").split(".")[:2]) < (0, 11) and "xla_cpu_use_fusion_emitters" not in _flags:
    os.environ["XLA_FLAGS"] = f"{_flags} --xla_cpu_use_fusion_emitters=false".strip()

with contextlib.redirect_stdout(io.StringIO()):  # without Warp, which only GPUs need, MJX prints that it is missing
    import mujoco.mjx  # noqa: F401

from mjx_nero.env import EnvCfg, ManipulationEnv  # noqa: E402
from mjx_nero.registry import env_cfg, list_envs, list_presets, make  # noqa: E402
from mjx_nero.types import UserError  # noqa: E402

__version__ = "0.1.0"
__all__ = ["EnvCfg", "ManipulationEnv", "UserError", "env_cfg", "list_envs", "list_presets", "make"]
