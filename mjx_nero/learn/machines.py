"""Runs on several machines: one process on each, joined by JAX to one mesh of devices.

Only the first process writes, evaluates and decides; the others follow. With a single process, these functions do nothing.
``versions`` says what runs on a machine.
"""

import contextlib
import glob
import importlib.metadata as metadata
import os
import sys
import threading
from collections.abc import Iterator
from typing import Any

import jax
import numpy as np
from jax.experimental import multihost_utils

_SMALL = threading.Lock()


def join() -> None:
    """Joins the processes that ``srun`` or ``mpirun`` started. Call it before JAX is used.

    Without such a launcher (Kubernetes without its Python package, or a shell), set ``JAX_COORDINATOR_ADDRESS``,
    ``JAX_NUM_PROCESSES`` and ``JAX_PROCESS_ID`` (or ``JOB_COMPLETION_INDEX``).
    """
    env = os.environ
    how: dict[str, Any] = {}
    if "JAX_COORDINATOR_ADDRESS" in env and "JAX_NUM_PROCESSES" in env:
        rank = env.get("JAX_PROCESS_ID") or env.get("JOB_COMPLETION_INDEX") or "0"
        how = {"num_processes": int(env["JAX_NUM_PROCESSES"]), "process_id": int(rank), "cluster_detection_method": "deactivate"}
    elif max(int(env.get(name, 1)) for name in ("SLURM_STEP_NUM_TASKS", "OMPI_COMM_WORLD_SIZE")) == 1:
        return
    elif "1" in (env.get("SLURM_STEP_TASKS_PER_NODE", "").partition("(")[0], env.get("OMPI_COMM_WORLD_LOCAL_SIZE")):
        how = {"local_device_ids": _gpus()}  # one process per machine gets all its GPUs; JAX would give it only the first
    jax.distributed.initialize(**how)


def several() -> bool:
    """Returns whether there is more than one process."""
    return jax.process_count() > 1


def first() -> bool:
    """Returns whether this is the process that writes, evaluates and decides."""
    return jax.process_index() == 0


def processor() -> jax.Device | None:
    """Returns JAX's CPU device of this process; None if JAX may not use the CPU."""
    try:
        return jax.local_devices(backend="cpu")[0]
    except RuntimeError:
        return None


def devices(each: int) -> list[Any]:
    """Returns the first ``each`` devices of every process."""
    count: dict[int, int] = {}
    found = []
    for device in jax.devices():
        count[device.process_index] = count.get(device.process_index, 0) + 1
        if count[device.process_index] <= each:
            found.append(device)
    return found


def untuned() -> dict[str, str | bool | int | float]:
    """Returns XLA's options for a program that runs once or now and then.

    On a GPU XLA compiles hundreds of kernels to find the fastest ones, on all cores and for longer than such a program runs. On a
    CPU its first level compiles in two thirds of the time, and programs are hardly slower.
    """
    if jax.default_backend() == "gpu":
        return {"xla_gpu_autotune_level": 0, **plain()}
    less = jax.config.read("jax_disable_most_optimizations")  # the user wants even less
    return {} if less else {"xla_backend_optimization_level": 1}


def plain() -> dict[str, str | bool | int | float]:
    """Returns XLA's options for a program whose products take little of its time: a GPU's library computes them.

    For each of them Triton compiles dozens of kernels, which takes longer than all else in such a program.
    """
    return {"xla_gpu_enable_triton_gemm": False} if jax.default_backend() == "gpu" else {}


@contextlib.contextmanager
def small() -> Iterator[None]:
    """Makes programs that are lowered within it smaller for a GPU: one kernel makes random numbers, the same ones, in place of
    hundreds of operations. XLA compiles them in half the time. Steps of environments would be a tenth slower. The setting is the
    process's, so one thread at a time is within.
    """
    name = "jax_threefry_gpu_kernel_lowering"
    with _SMALL:
        before = getattr(jax.config, name)
        jax.config.update(name, True)
        try:
            yield
        finally:
            jax.config.update(name, before)


def gather(values: list[float]) -> np.ndarray:
    """Collects the values of all processes [processes, n]; the first process comes first."""
    mine = np.array(values, np.float64)
    return np.asarray(multihost_utils.process_allgather(mine)).reshape(-1, len(values)) if several() else mine[None]


def fetch(x: Any) -> np.ndarray:
    """Copies an array to this process's memory, assembled from all processes' parts."""
    if isinstance(x, jax.Array) and not x.is_fully_addressable and not x.is_fully_replicated:
        x = multihost_utils.process_allgather(x, tiled=True)
    return np.array(x, order="C")


def wait() -> None:
    """Waits until all processes have called this function."""
    gather([0.0])


def _gpus() -> list[int] | None:
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    count = len(named.split(",")) if named else len(glob.glob("/dev/nvidia[0-9]*"))
    return list(range(count)) or None


def versions() -> dict[str, str]:
    """Returns the versions of everything that affects a result, and the device."""
    names = ("mjx-nero", "mujoco", "mujoco-mjx", "jax", "brax", "flax", "optax", "warp-lang")
    found = {}
    for name in names:
        with contextlib.suppress(metadata.PackageNotFoundError):
            found[name] = metadata.version(name)
    return {**found, "python": sys.version.split()[0], "device": jax.devices()[0].device_kind}
