"""Physics backends behind one function, ``Physics.step``. The only caller of ``mjx.put_model`` and ``mjx.step``."""

import functools
import os

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float
from mujoco import mjx

from mjx_nero.scene import SimCfg
from mjx_nero.types import Sim, UserError

IMPLS = ("auto", "jax", "warp")
# Warp's OverflowType bits that mean lost contacts or constraint rows; the others report unconverged solver iterations.
_LOST = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 3


def warp_available() -> bool:
    """True if MJX-Warp is installed and JAX runs on an NVIDIA GPU."""
    import mujoco.mjx.warp as mjxw

    return bool(mjxw.WARP_INSTALLED) and jax.default_backend() == "gpu"


def resolve_impl(impl: str) -> str:
    """``auto`` -> what this machine has; checks the others.

    Raises:
        UserError: unknown, or not possible on this machine.
    """
    if impl not in IMPLS:
        raise UserError(f"unknown impl {impl!r}: choose one of {', '.join(IMPLS)}")
    if impl == "auto":
        return "warp" if warp_available() else "jax"
    if impl == "warp" and not warp_available():
        raise UserError("impl 'warp' needs an NVIDIA GPU and the cuda extra (pip install -e '.[cuda]'): use --impl jax here")
    return impl


class Physics:
    """A compiled model on MJX, stepped at control rate.

    Args:
        model: from ``scene.build(..., visuals=False)``.
        cfg: options and buffer sizes.
        impl: ``jax`` or ``warp``.
        num_envs: environments that will be stepped together; sizes Warp's shared contact buffer.
    """

    def __init__(self, model: mujoco.MjModel, cfg: SimCfg, impl: str, num_envs: int):
        self.model, self.decimation, self.impl = model, cfg.decimation, impl
        self._mx = mjx.put_model(model, impl=impl)
        self._qpos_ids = model.jnt_qposadr[model.actuator_trnid[:, 0]]
        self._dof_ids = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        self._touches = bool(model.geom_contype.any())
        if impl == "warp":
            # Overflows are read from the data and counted; a print at every step would drown everything else.
            opt = self._mx.opt
            self._mx = self._mx.replace(opt=opt.replace(_impl=opt._impl.replace(warn_overflow=0)))
            sizes = {"naconmax": cfg.contacts_per_env * num_envs, "njmax": cfg.constraints_per_env}
            self._template = mjx.make_data(model, impl=impl, **sizes)
        else:
            self._template = mjx.make_data(self._mx)

    def step(self, sim: Sim, ctrl: Float[Array, " nu"]) -> tuple[Sim, Float[Array, ""]]:
        """One control step (``decimation`` physics steps) of one environment; vmap it for many.

        Returns:
            the state, and 1.0 if contacts or constraint rows were lost for want of buffer (Warp only), else 0.0.
        """
        data = self._template.replace(qpos=sim.qpos, qvel=sim.qvel, ctrl=ctrl, qacc_warmstart=sim.warmstart, time=sim.time)
        lost = jnp.zeros(())
        for _ in range(self.decimation):
            data = mjx.step(self._mx if self.impl == "warp" or self._touches else self._saturated(data), data)
            if self.impl == "warp":
                lost = jnp.maximum(lost, ((data._impl.overflow & _LOST) != 0).astype(jnp.float32))
        after = Sim(qpos=data.qpos, qvel=data.qvel, ctrl=ctrl, warmstart=data.qacc_warmstart, time=data.time)
        return after, lost

    def _saturated(self, data):
        """The model with constant forces in place of the drives that are at their limits.

        A drive there no longer damps. MuJoCo's C library and Warp leave its damping out of the implicit integration; MJX-JAX
        forgets to, and its drives would speed up several times too slowly.

        Not done where something can touch: in single precision the solver ends early on what a drive's sudden jump costs, and
        jolts a resting cube by 0.2 mm.
        """
        mx = self._mx
        gain, bias = mx.actuator_gainprm, mx.actuator_biasprm
        force = gain[:, 0] * data.ctrl + bias[:, 1] * data.qpos[self._qpos_ids] + bias[:, 2] * data.qvel[self._dof_ids]
        low, high = mx.actuator_forcerange.T
        hit = ((force <= low) | (force >= high))[:, None]
        constant = jnp.zeros_like(bias).at[:, 0].set(jnp.clip(force, low, high))
        return mx.replace(actuator_gainprm=jnp.where(hit, 0.0, gain), actuator_biasprm=jnp.where(hit, constant, bias))


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
