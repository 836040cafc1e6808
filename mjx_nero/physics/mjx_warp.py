"""MuJoCo Warp, the engine of MJX-Warp, on an NVIDIA GPU.

MJX's own wrapper hands all of MuJoCo's data, some hundred arrays, back and forth at every physics step. Here they stay where
Warp made them: in go the few arrays of ``types.Sim``, then one CUDA graph runs all physics steps of a control step, and out
come the same few. What else the engine keeps is recomputed from them, so the function is pure.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float

from mjx_nero.physics import newton
from mjx_nero.scene import SimCfg
from mjx_nero.types import Sim

# MuJoCo Warp's OverflowType bits that mean lost contacts or constraint rows; the others report unconverged solver iterations.
_LOST = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 3


class WarpPhysics:
    """See ``physics.Physics``. Buffers are made at the first step on a device with a batch size, and kept."""

    def __init__(self, model: mujoco.MjModel, cfg: SimCfg):
        self.model, self.decimation, self._cfg = model, cfg.decimation, cfg
        self._made: dict[tuple[str, int], tuple[Any, Callable[[], None], Any]] = {}  # by device and number of environments
        self._batched = self._as_jax()

    def step(self, sim: Sim, ctrl: Float[Array, "*batch nu"]) -> tuple[Sim, Float[Array, "*batch"]]:
        """One control step; any leading axes are environments."""
        qpos, qvel, warmstart, overflow = self._batched(sim.qpos, sim.qvel, ctrl, sim.warmstart)
        time = sim.time + self.decimation * self._cfg.dt
        after = Sim(qpos=qpos, qvel=qvel, ctrl=ctrl, warmstart=warmstart, time=time)
        return after, ((overflow & _LOST) != 0).astype(jnp.float32)

    def _as_jax(self) -> Callable:
        import warp as wp

        # Called by XLA on the stream that it computes on. No graph mode of Warp's: it would capture these copies for every set of
        # addresses that XLA comes up with, where one graph of the steps between them does.
        def control_step(qpos, qvel, ctrl, warmstart, qpos_out, qvel_out, warmstart_out, overflow_out):
            data, run, _ = self._get(qpos.shape[0])
            wp.copy(data.qpos, qpos)
            wp.copy(data.qvel, qvel)
            wp.copy(data.ctrl, ctrl)
            wp.copy(data.qacc_warmstart, warmstart)
            run()
            wp.copy(qpos_out, data.qpos)
            wp.copy(qvel_out, data.qvel)
            wp.copy(warmstart_out, data.qacc_warmstart)
            wp.copy(overflow_out, data.overflow)

        names = ("qpos", "qvel", "ctrl", "warmstart", "qpos_out", "qvel_out", "warmstart_out")
        control_step.__annotations__ = dict.fromkeys(names, wp.array(dtype=float, ndim=2)) | {"overflow_out": wp.array(dtype=int)}
        call = wp.jax_callable(control_step, num_outputs=4, graph_mode=wp.JaxCallableGraphMode.NONE, vmap_method=None)
        nq, nv = self.model.nq, self.model.nv

        @jax.custom_batching.custom_vmap
        def batched(*inputs):
            lead = inputs[0].shape[:-1]
            inputs = tuple(x.reshape(-1, x.shape[-1]) for x in inputs)
            n = inputs[0].shape[0]
            sizes = {"qpos_out": (n, nq), "qvel_out": (n, nv), "warmstart_out": (n, nv), "overflow_out": (n,)}
            return tuple(x.reshape(lead + x.shape[1:]) for x in call(*inputs, output_dims=sizes))

        @batched.def_vmap
        def _(size, is_batched, *inputs):
            pairs = zip(inputs, is_batched, strict=True)
            inputs = tuple(x if there else jnp.broadcast_to(x, (size, *x.shape)) for x, there in pairs)
            return batched(*inputs), (True,) * 4

        return batched

    def bytes_per_env(self) -> int:
        """Size of MuJoCo Warp's data of one environment."""
        import warp as wp
        from mujoco.mjx.third_party import mujoco_warp

        def size(value) -> int:
            if isinstance(value, wp.array):
                return value.capacity
            return sum(size(getattr(value, f.name)) for f in dataclasses.fields(value)) if dataclasses.is_dataclass(value) else 0

        cfg = self._cfg
        with wp.ScopedDevice("cpu"):
            sizes = {"naconmax": cfg.contacts_per_env, "njmax": cfg.constraints_per_env}
            return size(mujoco_warp.make_data(self.model, 1, **sizes))

    def load(self, n: int, num_devices: int = 1) -> None:
        """Makes ready what ``step`` needs for ``n`` environments on each of the first GPUs.

        ``step`` would do it, too, but inside a JAX program, and for as long as that runs XLA's autotuner lets no other program
        for that GPU be compiled. This here may run in a thread beside it.
        """
        import warp as wp

        for device in wp.get_cuda_devices()[:num_devices] or [wp.get_device("cpu")]:
            with wp.ScopedDevice(device):
                self._get(n)
                wp.synchronize_device(device)

    def _get(self, n: int) -> tuple[Any, Callable[[], None], Any]:
        import warp as wp

        key = (str(wp.get_device()), n)
        if key not in self._made:
            self._made[key] = self._make(n)
        return self._made[key]

    def _make(self, n: int) -> tuple[Any, Callable[[], None], Any]:
        """MuJoCo Warp's data for ``n`` environments on the current device, what steps them, and what that needs to be kept."""
        import warp as wp
        from mujoco.mjx.third_party import mujoco_warp

        cfg = self._cfg
        model = mujoco_warp.put_model(self.model)
        model.opt.warn_overflow = 0  # overflows are counted; a print at every step would drown everything else
        data = mujoco_warp.make_data(self.model, n, naconmax=cfg.contacts_per_env * n, njmax=cfg.constraints_per_env)
        solve = newton.make(model, data)

        def run():
            data.overflow.zero_()
            for _ in range(self.decimation):
                mujoco_warp.fwd_position(model, data, factorize=False)
                mujoco_warp.fwd_velocity(model, data)
                mujoco_warp.fwd_actuation(model, data)
                mujoco_warp.fwd_acceleration(model, data, factorize=True)
                solve()
                mujoco_warp.implicit(model, data)

        if not wp.get_device().is_cuda:  # Warp's CPU mode, which has no graphs: for tests
            return data, run, run
        _load_kernels()
        run()  # loads those made for this model, which cannot be done while a graph is captured
        with wp.ScopedCapture() as capture:
            run()
        return data, lambda: wp.capture_launch(capture.graph), run


def _load_kernels() -> None:
    """Compiles the parts of MuJoCo Warp that every model needs side by side; a first run would do it one after another."""
    import warp as wp
    from mujoco.mjx.third_party.mujoco_warp._src import constraint, derivative, forward, passive, smooth, support

    parts = (constraint, derivative, forward, passive, smooth, support)
    wp.force_load(wp.get_device(), [wp.get_module(part.__name__) for part in parts], max_workers=len(parts))
