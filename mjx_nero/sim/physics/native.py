"""MuJoCo's C library on CPU threads: the fastest physics without an accelerator, and the sim-to-sim check of policies.

A program calls the host once per control step, with all environments of a batch. The library computes in double precision.
"""

import collections
import contextlib
import copy
import ctypes
import dataclasses
import math
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float, Float32
from mujoco import rollout

from mjx_nero import cores
from mjx_nero.sim import readings
from mjx_nero.sim.physics import Footprint, Physics, host, identity
from mjx_nero.sim.scene import SimCfg
from mjx_nero.types import Sim

# One batch at a time uses all the cores and its work arrays. The last few of these are kept, by physics and number of worlds;
# they are large where fields are drawn, since every world has a model of its own then.
_lock = threading.Lock()
_arrays: collections.OrderedDict[tuple[int, int], tuple] = collections.OrderedDict()
_KEPT = 8

# MuJoCo reads the clock dozens of times a step, for timers that nobody looks at here: a twentieth of its time. Its Python package
# sets that clock, and cannot unset it.
with contextlib.suppress(AttributeError, OSError, ValueError):
    ctypes.c_void_p.in_dll(ctypes.CDLL(mujoco._structs.__file__), "mjcb_time").value = None


class NativePhysics(Physics):
    """See ``physics.Physics``. The first step with a batch size makes the work arrays, which are kept for a while.

    The C library does not return the solver's last acceleration, so ``Sim.warmstart`` holds the change of velocity over the last
    physics step: a fair first guess, and a function of the state.

    Of equal instances the first does the work of all. It lives as long as the process, because a compiled program may call it at
    any time (``host.call``). It keeps its model, and MuJoCo's data for each thread: 15 MB of address space, little of it touched.
    """

    def __init__(self, model: mujoco.MjModel, cfg: SimCfg, fields: Sequence[str] = ()):
        self.model, self.decimation = model, cfg.decimation
        same = identity(model, cfg.decimation, cfg.ramp, tuple(fields))
        self._key = int.from_bytes(same[:8], "little", signed=True)
        self._period, self._ramp = cfg.decimation * cfg.dt, cfg.ramp
        self._fields = {name: getattr(model, name).shape for name in fields}
        self._sizes = np.cumsum([model.nq, model.nv, model.nv, model.nu * (1 + cfg.ramp)])
        self._readings = readings.of(model)
        self._numbers = int(self._sizes[2]) + readings.size(self._readings)  # of the result
        threads = cores()
        self._data = [mujoco.MjData(model) for _ in range(threads)]
        self._rollout = rollout.Rollout(nthread=threads).rollout
        if jax.default_backend() == "cpu":
            host.offer(self._key, self._step)
            self.operations = (host.TARGET,)

    def step(self, sim: Sim, ctrl: Float[Array, "*batch nu"]) -> tuple[Sim, Float[Array, "*batch"]]:
        """Computes one control step; leading axes are environments. The state becomes NaN where MuJoCo gives up."""
        drawn = [sim.fields[name].reshape(*sim.qpos.shape[:-1], -1) for name in self._fields]
        targets = [sim.ctrl, ctrl] if self._ramp else [ctrl]
        packed = jnp.concatenate([sim.qpos, sim.qvel, sim.warmstart, *targets, *drawn], axis=-1)
        shape = jax.ShapeDtypeStruct((*packed.shape[:-1], self._numbers), jnp.float32)
        if jax.default_backend() == "cpu":
            found = host.call(self._key, shape, packed)
        else:  # an accelerator's program, which JAX does not cache between runs
            found = jax.pure_callback(self._called_back, shape, packed, vmap_method="broadcast_all")
        qpos, qvel, warmstart, numbers = jnp.split(found, self._sizes[:3], axis=-1)
        read = readings.split(self._readings, numbers)
        after = dataclasses.replace(sim, qpos=qpos, qvel=qvel, ctrl=ctrl, warmstart=warmstart, readings=read)
        return dataclasses.replace(after, time=sim.time + self._period), jnp.zeros(packed.shape[:-1])

    def _called_back(self, packed: Array) -> Float32[np.ndarray, "*batch n"]:
        after = np.empty((*packed.shape[:-1], self._numbers), np.float32)
        self._step(np.asarray(packed), after)
        return after

    def _step(self, packed: Float32[np.ndarray, "*batch m"], result: Float32[np.ndarray, "*batch n"]) -> None:
        """(qpos, qvel, warmstart, targets, fields) -> the first three after the step, and the readings.

        JAX's program calls this function, so calling JAX in here would deadlock.
        """
        n, (nq, nqv, nqvv, end) = math.prod(packed.shape[:-1]), self._sizes
        given, fields = np.split(packed.reshape(n, -1), [end], axis=1)
        after = result.reshape(n, -1)
        with _lock, quiet():
            models, present, start, warmstart, ctrl, states, sensors = self._work_arrays(n)
            self._set(models, present, fields)
            start[:, 1:], warmstart[:], ctrl[:] = given[:, :nqv], given[:, nqv:nqvv], given[:, None, -self.model.nu :]
            if self._ramp:
                left = 1 - np.arange(1, self.decimation + 1)[:, None] / self.decimation
                ctrl -= left * (ctrl - given[:, None, nqvv : -self.model.nu])
            out: dict[str, Any] = {"initial_warmstart": warmstart, "state": states, "sensordata": sensors}
            self._rollout(models, self._data, start, ctrl, nstep=self.decimation, skip_checks=True, **out)
            last, before = states[:, -1, 1:], states[:, -2, 1:] if self.decimation > 1 else start[:, 1:]
            after[:, :nqv] = last
            after[:, nqv:nqvv] = (last[:, nq:] - before[:, nq:]) / self.model.opt.timestep
            if reads := self._readings.values():
                each = [read(sensors).max(axis=1) if read.strongest else read(sensors[:, -1]) for read in reads]
                after[:, nqvv:] = np.column_stack(each)
            # After any warning (a bad state, which it resets, or a full buffer) MuJoCo takes no further step: time stops short.
            after[states[:, -1, 0] < 1 + 0.999 * self._period] = np.nan

    def _set(self, models: Any, present: np.ndarray, fields: np.ndarray) -> None:
        """Updates the models whose fields have changed, which happens when episodes begin."""
        for i in np.flatnonzero((present != fields).any(axis=1)):
            at = 0
            for name, shape in self._fields.items():
                size = math.prod(shape)
                getattr(models[i], name)[:] = fields[i, at : at + size].reshape(shape)
                at += size
        present[:] = fields

    def footprint(self, num_devices: int = 1) -> Footprint:
        """Returns the host memory of an environment: a model of its own if fields are drawn, and the arrays of a step."""
        m = self.model
        told = (2 + self.decimation) * (m.nq + 2 * m.nv) + self.decimation * (m.nu + m.nsensordata)
        return Footprint(in_program=8.0 * told + (m.nbuffer if self._fields else 0))

    def _work_arrays(self, n: int) -> tuple:
        key = self._key, n
        if key not in _arrays:
            _arrays[key] = self._make(n)
            if len(_arrays) > _KEPT:
                _arrays.popitem(last=False)
        _arrays.move_to_end(key)
        return _arrays[key]

    def _make(self, n: int) -> tuple:
        m, steps = self.model, self.decimation
        state = 1 + m.nq + m.nv
        start = np.ones((n, state))  # time starts at 1, so MuJoCo's automatic reset, which restarts it at 0, shows
        sensors = np.empty((n, steps, m.nsensordata))
        # With drawn fields every environment has its own model. ``present`` holds that model's current fields; NaN: not yet set.
        models = [copy.copy(m) for _ in range(n)] if self._fields else [m] * n
        present = np.full((n, sum(map(math.prod, self._fields.values()))), np.nan, np.float32)
        return models, present, start, np.empty((n, m.nv)), np.empty((n, steps, m.nu)), np.empty((n, steps, state)), sensors


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Silences MuJoCo's warnings, which it prints and writes to a file. The environments count the affected states."""
    handler = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(handler)
