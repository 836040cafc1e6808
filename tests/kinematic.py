"""Physics for tests of what is above it. Starts no JAX when it is imported: processes may have to be joined first."""

import jax.numpy as jnp

from mjx_nero.sim.physics import Footprint


class Kinematic:
    """Physics that compiles at once: the joints are where their targets are, the cube stays."""

    def step(self, sim, ctrl):
        moved = sim.replace(
            qpos=sim.qpos.at[:9].set(ctrl),
            qvel=sim.qvel.at[:9].set((ctrl - sim.qpos[:9]) / 0.02),
            ctrl=ctrl,
            time=sim.time + 0.02,
        )
        return moved, jnp.zeros(())

    compiler_options: dict = {}

    def prepare(self, num_envs, num_devices=1):
        pass

    def footprint(self, num_devices=1):
        return Footprint()
