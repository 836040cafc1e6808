"""Operations of Warp in JAX's programs, named by what they do: a program that another process has traced finds its own."""

import os
import subprocess
import sys

import jax
import numpy as np
import pytest

from mjx_nero import make

pytest.importorskip("warp")
mujoco_warp = pytest.importorskip("mjx_nero.sim.physics.warp.mujoco_warp")

NAMED = """
import sys
from mjx_nero import make
from mjx_nero.sim.physics.warp.mujoco_warp import WarpPhysics
for name in sys.argv[1:]:
    env = make(name, impl="native")
    print(*WarpPhysics(env.physics_model, env.cfg.sim).operations)
"""


def made(name):
    env = make(name, impl="native")
    return env, mujoco_warp.WarpPhysics(env.physics_model, env.cfg.sim)


def test_names_are_those_of_another_process_and_tell_models_apart():
    names = ["nero_reach", "nero_lift"]
    own = [made(name)[1].operations[0] for name in names]
    argv = [sys.executable, "-c", NAMED, *reversed(names), names[0]]
    told = subprocess.run(argv, stdout=subprocess.PIPE, text=True, check=True, env=os.environ).stdout.split()
    assert told == [own[1], own[0], own[0]] and own[0] != own[1]


def test_equal_physics_have_one_text_whatever_was_traced_before():
    env, first = made("nero_reach")
    sim = jax.eval_shape(env.reset, jax.random.PRNGKey(0)).pipeline_state
    texts = [
        jax.jit(lambda *x, each=each: each.step(*x)).lower(sim, sim.ctrl).as_text() for each in (first, made("nero_reach")[1])
    ]
    assert texts[0] == texts[1] and first.operations[0] in texts[0]


@pytest.mark.slow
def test_a_program_read_from_its_bytes_calls_its_own_physics():
    """Two models of the same sizes: their programs differ in nothing but the name of the operation."""
    env, _ = made("nero_reach")
    sim = jax.jit(env.reset)(jax.random.PRNGKey(0)).pipeline_state
    weak = env.physics_model.__copy__()
    weak.actuator_gainprm[:] *= 0.5
    weak.actuator_biasprm[:] *= 0.5
    allowed, after, target = [], [], sim.ctrl + 0.1
    both = [mujoco_warp.WarpPhysics(model, env.cfg.sim) for model in (weak, env.physics_model)]
    for physics in both:
        allowed = [jax.export.DisabledSafetyCheck.custom_call(physics.operations[0])]

        def step(qpos, qvel, warmstart, ctrl, target, physics=physics):
            given = sim.__class__(**{**vars(sim), "qpos": qpos, "qvel": qvel, "warmstart": warmstart, "ctrl": ctrl})
            return physics.step(given, target)[0].qvel

        args = sim.qpos, sim.qvel, sim.warmstart, sim.ctrl, target
        program = jax.export.export(jax.jit(step), disabled_checks=allowed)(*args).serialize()
        found = jax.export.deserialize(program).call(*args)
        np.testing.assert_array_equal(found, physics.step(sim, target)[0].qvel)
        after.append(np.asarray(found))
    assert np.abs(after[0] - after[1]).max() > 1e-3
