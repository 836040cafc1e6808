"""MuJoCo Warp, the engine of MJX-Warp, on an NVIDIA GPU.

MJX's own wrapper passes about a hundred arrays of MuJoCo's data back and forth at every physics step. Here they stay in Warp.
``step`` copies in the few arrays of ``types.Sim``, one CUDA graph runs all physics steps of a control step, and the same few
arrays are copied out. The engine recomputes everything else from them, so the function is pure.
"""

import dataclasses
import functools
import math
import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_nero.sim import readings
from mjx_nero.sim.physics import Footprint, Physics, identity, possible
from mjx_nero.sim.physics.warp import contact_rows, dynamics, engine, kernels, newton, sensing
from mjx_nero.sim.scene import SimCfg
from mjx_nero.types import Sim

# MuJoCo Warp's OverflowType bits that mean lost contacts or constraint rows; the others report unconverged solver iterations.
_LOST = 1 << 0 | 1 << 1 | 1 << 2 | 1 << 3

# Fields of MuJoCo's C library alone. A mesh that a world lacks has no contact bits there; here its geom has no mesh.
_OF_C = ("dof_M0", "geom_contype", "geom_conaffinity")

# The parts of an instance that equal ones share, by what identifies it.
_MADE: dict[str, tuple[kernels.Programs, Callable, str]] = {}
_MAKING = threading.Lock()


class WarpPhysics(Physics):
    """See ``physics.Physics``. The first step with a batch size on a device makes the buffers, which are kept.

    Of equal instances the first does the work of all, because a program names its operation by what it does.
    """

    def __init__(self, model: mujoco.MjModel, cfg: SimCfg, fields: Sequence[str] = ()):
        self.model, self.decimation, self._cfg = model, cfg.decimation, cfg
        self._fields = {name: np.shape(getattr(model, name)) for name in fields if name not in _OF_C}
        self._readings = readings.of(model)
        self._numbers = readings.size(self._readings)
        with _MAKING:
            key = identity(model, cfg, tuple(fields)).hex()[:16]
            if key not in _MADE:
                self._get = kernels.Programs(self._make)
                _MADE[key] = self._get, *self._as_jax(key)
            self._get, self._batched, name = _MADE[key]
        self.operations = (name,)

    def step(self, sim: Sim, ctrl: Float[Array, "*batch nu"]) -> tuple[Sim, Float[Array, "*batch"]]:
        """Computes one control step; leading axes are environments."""
        # The drawn fields travel with the targets. Without fields, the targets go alone.
        lead = sim.qpos.shape[:-1]
        drawn = [sim.fields[name].reshape(*lead, -1) for name in self._fields]
        targets = [ctrl, sim.ctrl] if self._cfg.ramp else [ctrl]
        parts = [jnp.broadcast_to(x, (*lead, x.shape[-1])) for x in (*targets, *drawn)]
        given = jnp.concatenate(parts, axis=-1) if len(parts) > 1 else ctrl
        qpos, qvel, warmstart, overflow, force = self._batched(sim.qpos, sim.qvel, given, sim.warmstart)
        time = sim.time + self.decimation * self._cfg.dt
        after = dataclasses.replace(sim, qpos=qpos, qvel=qvel, ctrl=ctrl, warmstart=warmstart, time=time)
        if self._numbers:
            after = dataclasses.replace(after, readings=readings.split(self._readings, force))
        return after, ((overflow & _LOST) != 0).astype(jnp.float32)

    def _as_jax(self, key: str) -> tuple[Callable, str]:
        import warp as wp

        def control_step(qpos, qvel, given, warmstart, qpos_out, qvel_out, warmstart_out, overflow_out, force_out):
            data, wanted, drawn, run, strongest, _ = self._get(qpos.shape[0])
            wp.copy(data.qpos, qpos)
            wp.copy(data.qvel, qvel)
            at = 0  # ``given`` as it is, or its parts, in order
            for target in (wanted, data.ctrl, drawn):
                if target is not None:
                    wp.copy(target, given if target.shape == given.shape else given[:, at : at + target.shape[1]])
                    at += target.shape[1]
            wp.copy(data.qacc_warmstart, warmstart)
            run()
            wp.copy(qpos_out, data.qpos)
            wp.copy(qvel_out, data.qvel)
            wp.copy(warmstart_out, data.qacc_warmstart)
            wp.copy(overflow_out, data.overflow)
            if strongest is not None:  # otherwise it is not used
                wp.copy(force_out, strongest)

        names = ("qpos", "qvel", "given", "warmstart", "qpos_out", "qvel_out", "warmstart_out")
        control_step.__annotations__ = dict.fromkeys(names, wp.array(dtype=float, ndim=2)) | {
            "overflow_out": wp.array(dtype=int),
            "force_out": wp.array(dtype=float, ndim=2),
        }
        call, name = kernels.as_jax(control_step, outputs=5, key=key)
        nq, nv = self.model.nq, self.model.nv

        def batched(*inputs):
            lead = inputs[0].shape[:-1]
            inputs = tuple(x.reshape(-1, x.shape[-1]) for x in inputs)
            n = inputs[0].shape[0]
            sizes = {"qpos_out": (n, nq), "qvel_out": (n, nv), "warmstart_out": (n, nv), "overflow_out": (n,)}
            sizes["force_out"] = n, max(1, self._numbers)
            return tuple(x.reshape(lead + x.shape[1:]) for x in call(*inputs, output_dims=sizes))

        return kernels.batched(batched, outputs=5), name

    def footprint(self, num_devices: int = 1) -> Footprint:
        """Returns the size of MuJoCo Warp's data, and the free memory."""
        return _Measured(lambda: self._bytes, lambda: _free(num_devices))

    @functools.cached_property
    def _bytes(self) -> int:
        """Size of MuJoCo Warp's data of one environment."""
        cfg, model = self._cfg, self.model
        sizes = (getattr(model, name) for name in dir(model) if name.startswith("n"))
        kinds = int(model.opt.cone), int(model.opt.jacobian)
        key = cfg.contacts_per_env, cfg.constraints_per_env, *kinds, *(x for x in sizes if isinstance(x, int))
        with _MEASURING:
            if key not in _BYTES:
                _BYTES[key] = _data_bytes(model, cfg)
        return _BYTES[key] + 4 * sum(math.prod(shape) for shape in self._fields.values())

    def prepare(self, num_envs: int, num_devices: int = 1) -> None:
        """See ``physics.Physics``."""
        self._get.prepare(num_envs, num_devices)

    def _make(self, n: int) -> tuple[Any, Any, Any, Callable[[], None], Any, Any]:
        """Makes what ``n`` environments need on the current device.

        Returns:
            MuJoCo Warp's data, the targets to ramp to, the drawn fields as one array, the function that steps, the readings
            (each None if there are none), and objects that must stay alive.
        """
        import warp as wp

        cfg = self._cfg
        with possible("MuJoCo Warp"):
            model = engine.put_model(self.model)
        drawn = world_fields(model, self._fields, n)
        convert = whole_numbers(model, self._fields, drawn)
        model.opt.warn_overflow = 0  # overflows are counted; a print at every step would drown everything else
        data = engine.make_data(self.model, n, naconmax=cfg.contacts_per_env * n, njmax=cfg.constraints_per_env)
        step, strongest = self._stepper(model, data)
        wanted, go = ramp(data.ctrl) if cfg.ramp else (None, lambda left: None)

        def run():
            data.overflow.zero_()
            convert()
            if strongest is not None:
                strongest.zero_()
            for i in range(self.decimation):
                go(self.decimation - i)
                step(i == self.decimation - 1)

        if not wp.get_device().is_cuda:  # Warp's CPU mode, which has no graphs: for tests
            return data, wanted, drawn, run, strongest, run
        kernels.load(run)
        run()  # allocates what kernels keep between launches, which cannot be done while a graph is captured
        return data, wanted, drawn, kernels.captured(run), strongest, run

    def _stepper(self, model: Any, data: Any) -> tuple[Callable[[bool], None], Any]:
        """Makes the function of one physics step, which is told if it is the last one, and the array of readings."""
        out, each, at_last = sensing.make(self.model, model, data)
        own = self._cfg.solver == "newton"
        solve = newton.make(model, data) if own else functools.partial(engine.solve, model, data)

        def constrained(last: bool):
            solve()
            for measure in (*each, *at_last) if last else each:
                measure()

        def engines(last: bool):
            engine.fwd_position(model, data, factorize=False)
            engine.fwd_velocity(model, data)
            engine.fwd_actuation(model, data)
            engine.fwd_acceleration(model, data, factorize=True)
            constrained(last)
            engine.implicit(model, data)

        if not own or dynamics.missing(self.model) or not newton.fits(model, data):
            return engines, out
        before, after = dynamics.make(self.model, model, data)
        rows = contact_rows.make(self.model, model, data)

        def ours(last: bool):
            before()
            engine.collision(model, data)
            rows()
            constrained(last)
            after()

        return ours, out


class _Measured(Footprint):
    """Is measured when it is asked for, because MuJoCo Warp takes a second to import."""

    def __init__(self, outside: Callable[[], int], free: Callable[[], float]):
        object.__setattr__(self, "_measure", (outside, free))

    outside = property(lambda self: self._measure[0]())
    free = property(lambda self: self._measure[1]())


def _free(num_devices: int) -> float:
    """Returns the free memory of the first devices, of that which has least; other processes ask for their own."""
    import warp as wp

    return min((device.free_memory for device in wp.get_cuda_devices()[:num_devices]), default=float("inf"))


# By the sizes of a model and its buffers. An evaluation has those of its training, which holds ``kernels.WARP`` for seconds.
_BYTES: dict[tuple[int, ...], int] = {}
_MEASURING = threading.Lock()


def _data_bytes(model: mujoco.MjModel, cfg: SimCfg) -> int:
    """Returns the size of MuJoCo Warp's data of one environment."""
    import warp as wp

    def size(value) -> int:
        if isinstance(value, wp.array):
            return value.capacity
        return sum(size(getattr(value, f.name)) for f in dataclasses.fields(value)) if dataclasses.is_dataclass(value) else 0

    with kernels.WARP, wp.ScopedDevice("cpu"):
        return size(engine.make_data(model, 1, naconmax=cfg.contacts_per_env, njmax=cfg.constraints_per_env))


def ramp(ctrl: Any) -> tuple[Any, Callable[[int], None]]:
    """Makes an array of targets, and the function that moves ``ctrl`` towards them by one of ``left`` equal steps."""
    import warp as wp

    wanted: Any = wp.zeros_like(ctrl)

    @wp.kernel(module="unique", enable_backward=False)
    def towards(
        ctrl: wp.array2d(dtype=float),  # type: ignore
        wanted: wp.array2d(dtype=float),  # type: ignore
        left: int,
    ):
        i, j = wp.tid()  # type: ignore
        ctrl[i, j] += (wanted[i, j] - ctrl[i, j]) / float(left)

    return wanted, lambda left: wp.launch(towards, dim=ctrl.shape, inputs=[ctrl, wanted, left])


def world_fields(model: Any, shapes: Mapping[str, tuple[int, ...]], n: int) -> Any:
    """Replaces fields of the model by views of one array [n, numbers], one row per world. None without fields.

    Integers are read as they lie in memory (see ``whole_numbers``).

    Args:
        model: MuJoCo Warp's model.
        shapes: shapes of the fields, by name.
    """
    import warp as wp

    sizes = [math.prod(shape) for shape in shapes.values()]
    if not sizes:
        return None
    drawn, at = wp.zeros((n, sum(sizes)), dtype=float), 0
    for name, size in zip(shapes, sizes, strict=True):
        kind, rows = getattr(model, name).dtype, shapes[name][0]
        row = drawn.strides[0]
        item = drawn.strides[1] * size // rows
        shape: tuple[int, ...] = (n, rows)
        strides: tuple[int, ...] = (row, item)
        if getattr(model, name).ndim == 3:  # two vectors per row
            shape, strides = (n, rows, 2), (row, item, item // 2)
        view: Any = wp.array(ptr=drawn.ptr + drawn.strides[1] * at, dtype=kind, shape=shape, strides=strides)
        setattr(model, name, view)
        at += size
    return drawn


def whole_numbers(model: Any, shapes: Mapping[str, tuple[int, ...]], drawn: Any) -> Callable[[], None]:
    """Makes the function that converts those fields of ``world_fields`` that are integers given as floats: ids of meshes."""
    import warp as wp

    @wp.kernel(module="unique", enable_backward=False)
    def convert(
        drawn: wp.array2d(dtype=float),  # type: ignore
        at: int,
        out: wp.array2d(dtype=int),  # type: ignore
    ):
        i, j = wp.tid()  # type: ignore
        out[i, j] = int(drawn[i, at + j])

    at, jobs = 0, []
    for name, shape in shapes.items():
        if getattr(model, name).dtype is wp.int32:
            # At least two rows: with a single one, MuJoCo Warp assumes that all worlds have the same meshes.
            out = wp.zeros((max(2, drawn.shape[0]), shape[0]), dtype=int)
            setattr(model, name, out)
            jobs.append((at, out, shape[0]))
        at += math.prod(shape)

    def run() -> None:
        for at, out, size in jobs:
            wp.launch(convert, dim=(drawn.shape[0], size), inputs=[drawn, at, out])

    return run
