"""Ratios of speed, measured in turn in one run, so that a slow machine or a busy one is as slow in both parts of a ratio.

What counts are the CPU seconds of this process, all threads together: other processes make them longer by a little, not by half.
Each bound lies between what was measured, in brackets (before JAX 0.11; since), and what it would be with the first part twice as
dear.
"""

import dataclasses
import os
import pathlib
import statistics
import time
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from mujoco import rollout

import mjx_nero
from mjx_nero.envs import wrappers
from mjx_nero.learn.ppo import learner as ppo
from mjx_nero.runs import cfg as run_cfg
from mjx_nero.sim.physics import fusion
from mjx_nero.tools.benchmark import throughput

NUM_ENVS, ROUNDS = 128, 5


class Still:
    """Physics that does nothing: what is left of a step is the MDP."""

    @property
    def compiler_options(self):
        """Those of the other programs."""
        return fusion()

    def step(self, sim, ctrl):
        return sim, jnp.zeros(())


@pytest.fixture(scope="module")
def optimised():
    """XLA's optimisations and its fusion, which the other tests do without."""
    before = jax.config.read("jax_disable_most_optimizations")
    jax.config.update("jax_disable_most_optimizations", False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", "").replace("fusion_emitters=0", "fusion_emitters=false"))
        assert fusion() or not OLD
        yield
    jax.config.update("jax_disable_most_optimizations", before)


def bare(env, steps: int):
    """MuJoCo's own threaded rollout of the same scene under random targets: ``steps`` control steps a call, no JAX."""
    model, n, substeps = env.physics_model, env.num_envs, env.cfg.sim.decimation
    threads = len(os.sched_getaffinity(0))
    data, roll = [mujoco.MjData(model) for _ in range(threads)], rollout.Rollout(nthread=threads).rollout
    sims, draw = jax.jit(jax.vmap(env.sample))(jax.random.split(jax.random.PRNGKey(0), n))[0], np.random.default_rng(0)
    state = np.concatenate([np.zeros((n, 1)), sims.qpos, sims.qvel], axis=1)

    def run():
        nonlocal state
        for _ in range(steps):
            targets = np.asarray(sims.ctrl, float) + 0.5 * draw.normal(size=sims.ctrl.shape)
            ctrl = np.repeat(targets[:, None], substeps, axis=1)
            state = roll(model, data, state, ctrl, nstep=substeps)[0][:, -1]

    return types.SimpleNamespace(run=run, work=n * steps)


@pytest.fixture(scope="module")
def costs(optimised) -> dict[str, list[float]]:
    """CPU seconds an env step, one entry a round."""
    if jax.default_backend() != "cpu":
        pytest.skip("on an accelerator the CPU's seconds tell little")
    native = mjx_nero.make("nero_lift", impl="native", num_envs=NUM_ENVS)
    still = mjx_nero.make("nero_lift", impl="native", num_envs=NUM_ENVS)
    still.__dict__["physics"] = Still()
    cfg = dataclasses.replace(run_cfg.learner_cfg(native.cfg, "default"), num_envs=NUM_ENVS)
    programs = {
        "physics": throughput.physics(native, 25),
        "step": throughput.step(native, 25),
        "terms": throughput.step(still, 100),
        "ppo": throughput.training(ppo.Learner(wrappers.for_training(native), cfg), 1),
        "bare": bare(native, 25),
    }
    programs["bare"].run()  # makes MuJoCo's own arrays
    found: dict[str, list[float]] = {name: [] for name in programs}
    for _ in range(ROUNDS):
        for name, program in programs.items():
            begun = time.process_time()
            program.run()
            found[name].append((time.process_time() - begun) / program.work)
    return found


# XLA's code for the terms is faster from JAX 0.11 on; MuJoCo's C library is the same for all. How the two compare depends on the
# processor: the same commit takes 0.08 on an AMD EPYC and 0.135 to 0.15 on an Intel Xeon, both with JAX 0.10.
OLD = jax.__version_info__ < (0, 11)
INTEL = "GenuineIntel" in pathlib.Path("/proc/cpuinfo").read_text()
BOUNDS = [
    pytest.param(
        "terms", "physics", (0.2 if INTEL else 0.12) if OLD else 0.07, id="the MDP beside the physics (0.08 to 0.15; 0.045)"
    ),
    pytest.param("ppo", "step", 4.0, id="training beside random actions (2.5; 2.8)"),
    pytest.param("physics", "bare", 1.8, id="the physics beside MuJoCo's own rollout (1.2)"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("what", "beside", "most"), BOUNDS)
def test_cost(costs, what, beside, most):
    ratio = statistics.median(a / b for a, b in zip(costs[what], costs[beside], strict=True))
    seconds = {name: f"{1e6 * statistics.median(costs[name]):.1f}" for name in (what, beside)}
    print(f"{what} {seconds[what]}, {beside} {seconds[beside]} us an env step: {ratio:.3f}")
    assert ratio < most, f"{what} costs {ratio:.2f} of {beside}: {seconds} us an env step"
