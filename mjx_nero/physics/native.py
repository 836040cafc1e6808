"""MuJoCo's C library on CPU threads."""

import functools
import os

import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_nero.scene import SimCfg
from mjx_nero.types import Sim


class NativePhysics:
    """The same model stepped by MuJoCo's C library on CPU threads; takes and returns batched numpy arrays.

    The sim-to-sim check of a policy, and by far the fastest physics without an accelerator.
    """

    def __init__(self, model: mujoco.MjModel, cfg: SimCfg):
        from mujoco import rollout

        self.model, self.decimation = model, cfg.decimation
        threads = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        self._rollout = functools.partial(rollout.Rollout(nthread=threads).rollout, model, self._data)

    def step(self, sim: Sim, ctrl) -> Sim:
        """One control step of a batch: leaves of ``sim`` are [n, ...], ``ctrl`` is [n, nu]."""
        qpos, qvel = np.asarray(sim.qpos, np.float64), np.asarray(sim.qvel, np.float64)
        start = np.concatenate([np.asarray(sim.time, np.float64)[:, None], qpos, qvel], axis=1)
        controls = np.repeat(np.asarray(ctrl, np.float64)[:, None], self.decimation, axis=1)
        states, _ = self._rollout(start, controls, initial_warmstart=np.asarray(sim.warmstart, np.float64))
        last, nq = states[:, -1], self.model.nq
        return Sim(
            qpos=jnp.asarray(last[:, 1 : 1 + nq], jnp.float32),
            qvel=jnp.asarray(last[:, 1 + nq :], jnp.float32),
            ctrl=jnp.asarray(ctrl),
            warmstart=sim.warmstart,
            time=jnp.asarray(last[:, 0], jnp.float32),
        )
