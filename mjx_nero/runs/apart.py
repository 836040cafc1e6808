"""An expert's episodes, played in a process of their own while this one starts.

To trace an expert takes seconds of Python, which the programs that training waits for need as well. The process is a fork, so it
has imported all that it needs. What it plays comes back through the user's cache (``kept``).
"""

import ctypes
import dataclasses
import multiprocessing
import os
import random
import signal
import sys
import threading
from multiprocessing.process import BaseProcess

import jax

from mjx_nero import cores
from mjx_nero.runs import compiled, starts
from mjx_nero.runs.cfg import RunCfg, fit_machine

_CORES = 4  # with fewer, two processes take longer than one; the expert takes no more, because it would only wait on them
_NICE = 5  # the learner's programs take longer to compile than the expert takes to play
_DIE_WITH_PARENT = 1  # ``PR_SET_PDEATHSIG`` of Linux's prctl


def begin(run: RunCfg) -> BaseProcess | None:
    """Begins to play the episodes of a new run's first seed, if that can be done and helps.

    Call it before JAX is used: what runs in threads does not survive a fork.

    Args:
        run: may leave open what ``fit_machine`` fills in.
    """
    if sys.platform != "linux" or cores() < _CORES or run.restore is not None or _is_busy() or not _wants_expert(run):
        return None
    process = multiprocessing.get_context("fork").Process(target=_play, args=(run,), daemon=True)
    process.start()
    return process


def _is_busy() -> bool:
    """True if a fork would lose threads."""
    bridge = sys.modules.get("jax._src.xla_bridge")  # nothing public says whether JAX has opened devices
    opened = getattr(bridge, "backends_are_initialized", lambda: True)
    return threading.active_count() > 1 or jax.distributed.is_initialized() or opened()


def _wants_expert(run: RunCfg) -> bool:
    return bool(run.env.curriculum.expert_starts or getattr(run.hyperparameters, "imitation", 0.0))


def _play(run: RunCfg) -> None:
    ctypes.CDLL(None).prctl(_DIE_WITH_PARENT, signal.SIGKILL)
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):  # whoever reads what the run prints must not wait for this process
        os.dup2(silent, stream)
    own = sorted(os.sched_getaffinity(0))
    os.sched_setaffinity(0, random.sample(own, min(_CORES, len(own))))  # runs that start together take different ones
    os.nice(_NICE)
    jax.config.update("jax_platforms", "cpu")
    run, _ = fit_machine(dataclasses.replace(run, impl="native", num_devices=1))
    starts.Maker(compiled.make_learner(run), lambda _: None)(run.seed)
