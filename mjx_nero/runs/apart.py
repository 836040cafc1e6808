"""Work of a start that is done in processes of its own: an expert's episodes, and the kernels of the physics.

Both take seconds of Python, which the programs that training waits for need as well. The processes are forks, so they have
imported all that they need. What they make comes back through the user's caches, ours (``kept``) and Warp's.
"""

import ctypes
import dataclasses
import glob
import importlib.util
import multiprocessing
import os
import random
import signal
import sys
import threading
from collections.abc import Callable
from importlib import metadata
from multiprocessing.process import BaseProcess

import jax

from mjx_nero import cores
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.runs import compiled, kept, starts
from mjx_nero.runs.cfg import RunCfg, fit_machine
from mjx_nero.runs.helpers import ALONE, Helpers

_LEAST, _LEAST_FOR_KERNELS = 4, 8  # cores; with fewer, another process takes longer than it saves
_CORES = 8  # the expert takes no more, because it would only wait on them
_DIE_WITH_PARENT = 1  # ``PR_SET_PDEATHSIG`` of Linux's prctl
_COMPUTE_MODE, _SHARED = 20, 0  # ``CU_DEVICE_ATTRIBUTE_COMPUTE_MODE`` of CUDA's driver, and its usual value


def begin(run: RunCfg) -> Helpers:
    """Begins the work of a new run's start that can be done elsewhere, if that helps.

    Call it before JAX is used: what runs in threads does not survive a fork.

    Args:
        run: may leave open what ``fit_machine`` fills in.
    """
    if sys.platform != "linux" or cores() < _LEAST or run.restore is not None or _is_busy():
        return ALONE
    kernels = _forked(_build, run) if cores() >= _LEAST_FOR_KERNELS and _wants_kernels(run) else None
    return Helpers(_forked(_play, run) if _wants_expert(run) else None, kernels)


def _forked(work: Callable[[RunCfg], None], run: RunCfg) -> BaseProcess:
    process = multiprocessing.get_context("fork").Process(target=_quietly, args=(work, run), daemon=True)
    process.start()
    return process


def _is_busy() -> bool:
    """True if a fork would lose threads."""
    bridge = sys.modules.get("jax._src.xla_bridge")  # nothing public says whether JAX has opened devices
    opened = getattr(bridge, "backends_are_initialized", lambda: True)
    return threading.active_count() > 1 or jax.distributed.is_initialized() or opened()


def _wants_expert(run: RunCfg) -> bool:
    return bool(run.env.curriculum.expert_starts or getattr(run.hyperparameters, "imitation", 0.0))


def _wants_kernels(run: RunCfg) -> bool:
    """True if JAX will find a GPU of NVIDIA, as far as can be said without opening it."""
    platforms = os.environ.get("JAX_PLATFORMS") or "cuda"
    if run.impl not in ("auto", "warp") or not ("cuda" in platforms or "gpu" in platforms):
        return False
    if not glob.glob("/dev/nvidia[0-9]*") or importlib.util.find_spec("warp") is None:
        return False
    return any("cuda" in plugin.name for plugin in metadata.entry_points(group="jax_plugins"))  # reads every package's files


def _quietly(work: Callable[[RunCfg], None], run: RunCfg) -> None:
    """Works in a new process that ends with its parent, prints nothing, and leaves the GPU to the parent's JAX."""
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):  # whoever reads what the run prints must not wait for this process
        os.dup2(silent, stream)
    jax.config.update("jax_platforms", "cpu")
    work(run)


def _play(run: RunCfg) -> None:
    own = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, random.sample(own, min(_CORES, len(own))))  # runs that start together take different ones
    run, _ = fit_machine(dataclasses.replace(run, impl="native", num_devices=1))
    starts.Maker(compiled.make_learner(run), lambda _: None)(run.seed)


def _build(run: RunCfg) -> None:
    """Builds the kernels, unless an earlier process has built those of this task."""
    done = kept.Shelf("kernels", run.env, metadata.version("warp-lang"))
    if not done or done.has("built") or not _is_shared():
        return
    env = ManipulationEnv(run.env, impl="native")
    env.impl = "warp"  # which asks JAX for a GPU where an environment is made
    env.physics.prepare(1)  # kernels are the same for any number of environments
    done.write("built", {}, {})


def _is_shared() -> bool:
    """True if several processes may use the first GPU at once: a machine may be set up otherwise."""
    cuda, mode = ctypes.CDLL("libcuda.so.1"), ctypes.c_int(-1)
    cuda.cuInit(0)
    cuda.cuDeviceGetAttribute(ctypes.byref(mode), _COMPUTE_MODE, 0)
    return mode.value == _SHARED
