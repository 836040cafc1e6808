"""MJX-JAX: physics as a JAX program, for any accelerator. Only this module and ``warp`` call MJX."""

import copy
import dataclasses
from collections.abc import Sequence

import mjx_nero.sim.quiet  # noqa: F401

import jax
import jax.numpy as jnp
import mujoco
from jaxtyping import Array, Float
from mujoco import mjx

from mjx_nero.sim import readings
from mjx_nero.sim.physics import Footprint, Physics, possible
from mjx_nero.sim.scene import SimCfg
from mjx_nero.types import Sim, UserError

# Most steps of MJX's line search. With 50, which MuJoCo's C library needs, a held cube slipped by 2 mm in one of eight places.
# With 20 it slipped in none (tests/sim/test_grasp.py).
LINE_SEARCH = 20


class JaxPhysics(Physics):
    """See ``physics.Physics``."""

    operations: tuple[str, ...] = ()

    def __init__(self, model: mujoco.MjModel, cfg: SimCfg, fields: Sequence[str] = ()):
        if "geom_dataid" in fields:
            raise UserError("MJX-JAX cannot give an object another shape in each episode (bank): use --impl native or warp")
        self.model, self.decimation, self._ramp = model, cfg.decimation, cfg.ramp
        own = copy.copy(model)
        own.opt.ls_iterations = min(model.opt.ls_iterations, LINE_SEARCH)
        with possible("MJX-JAX"):
            self._mx = mjx.put_model(own, impl="jax")
            self._template = mjx.make_data(self._mx)
        self._qpos_ids = model.jnt_qposadr[model.actuator_trnid[:, 0]]
        self._dof_ids = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        self._readings = readings.of(model)
        self._touches = bool(model.geom_contype.any())

    def step(self, sim: Sim, ctrl: Float[Array, " nu"]) -> tuple[Sim, Float[Array, ""]]:
        """Computes one control step of one environment; vmap it for many."""
        mx = self._mx.replace(**sim.fields)

        before = sim.ctrl

        def physics_step(i, sim: Sim) -> Sim:
            now = before + (i + 1) / self.decimation * (ctrl - before) if self._ramp else ctrl
            data = self._template.replace(qpos=sim.qpos, qvel=sim.qvel, ctrl=now, qacc_warmstart=sim.warmstart, time=sim.time)
            data = mjx.step(mx if self._touches else self._saturated(mx, data), data)
            measured = {name: read(data.sensordata) for name, read in self._readings.items()}
            measured |= {n: jnp.maximum(sim.readings[n], measured[n]) for n, read in self._readings.items() if read.strongest}
            after = {"qpos": data.qpos, "qvel": data.qvel, "warmstart": data.qacc_warmstart, "time": data.time}
            return dataclasses.replace(sim, readings=measured, **after)

        blank = {name: jnp.zeros(read.shape) for name, read in self._readings.items()}
        sim = dataclasses.replace(sim, ctrl=ctrl, readings=blank)
        # A loop compiles in half the time of two unrolled steps.
        return jax.lax.fori_loop(0, self.decimation, physics_step, sim), jnp.zeros(())

    @property
    def compiler_options(self) -> dict[str, str | bool]:
        """Empty, because the package's own options suit MJX-JAX (see ``physics.fusion``)."""
        return {}

    def footprint(self, num_devices: int = 1) -> Footprint:
        """Returns the memory of a step: a few times MJX's data."""
        return Footprint(in_program=2.5 * sum(x.nbytes for x in jax.tree.leaves(self._template)))

    def _saturated(self, mx, data):
        """Replaces drives at their force limits by constant forces.

        A drive at its limit no longer damps. MuJoCo's C library and Warp leave its damping out of the implicit integration;
        MJX-JAX keeps it, so its drives would speed up several times too slowly.

        Scenes with contacts do not use this: in single precision the sudden change makes the solver stop early and jolts a
        resting cube by 0.2 mm.
        """
        gain, bias = mx.actuator_gainprm, mx.actuator_biasprm
        force = (
            bias[:, 0] + gain[:, 0] * data.ctrl + bias[:, 1] * data.qpos[self._qpos_ids] + bias[:, 2] * data.qvel[self._dof_ids]
        )
        low, high = mx.actuator_forcerange.T
        hit = ((force <= low) | (force >= high))[:, None]
        constant = jnp.zeros_like(bias).at[:, 0].set(jnp.clip(force, low, high))
        return mx.replace(actuator_gainprm=jnp.where(hit, 0.0, gain), actuator_biasprm=jnp.where(hit, constant, bias))
