"""Iterations as programs of their parts, or as one program of a learner without parts."""

import concurrent.futures
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinematic import Kinematic
from test_ppo import KEY, SMALL, near, same

from mjx_nero import make
from mjx_nero.envs import wrappers
from mjx_nero.learn.learner import Part
from mjx_nero.learn.ppo.learner import Learner
from mjx_nero.runs import iteration
from mjx_nero.runs.programs import Programs
from mjx_nero.runs.spans import Spans


@pytest.fixture(scope="module")
def learner():
    env = make("nero_lift", impl="jax")
    env.physics = Kinematic()
    return Learner(wrappers.for_training(env), SMALL)


def compiled(learner, chunk):
    """Compiles iterations; returns them, and the names of what was compiled."""
    spans = Spans()
    with concurrent.futures.ThreadPoolExecutor() as pool:
        made = iteration.Lowered(learner, chunk, Programs(None, learner)).compiling(pool, spans)()
    return made, sorted(span.name for span in spans.found)


@pytest.fixture(scope="module")
def once(learner):
    return compiled(learner, 1)[0]


def begun(learner):
    return jax.jit(learner.init)(KEY)


def test_parts_compute_what_the_whole_does(learner):
    run, names = compiled(learner, 2)
    assert names == ["rollout, compiled", "starts, compiled", "update, compiled"]
    state, metrics = run(begun(learner))
    expected = jax.jit(learner.run, static_argnums=1)(begun(learner), 2)
    assert int(state.iteration) == 2 and set(metrics) == set(expected[1])
    near((state.params, state.normalizer, metrics), (expected[0].params, expected[0].normalizer, expected[1]))


def test_a_chunk_is_its_iterations_to_the_bit(learner, once):
    state, metrics = compiled(learner, 3)[0](begun(learner))
    again, parts = begun(learner), []
    for _ in range(3):
        again, found = once(again)
        parts.append(found)
    same(state, again)
    for name, value in metrics.items():
        np.testing.assert_allclose(value, np.mean([part[name] for part in parts]), rtol=1e-5, atol=1e-7)


def test_the_state_is_consumed(learner, once):
    state = begun(learner)
    once(state)
    assert all(x.is_deleted() for x in jax.tree.leaves((state.params, state.env_state.obs)))


class Counting:
    """Counts to its number of iterations, in one program."""

    env = types.SimpleNamespace(unwrapped=types.SimpleNamespace(physics=types.SimpleNamespace(compiler_options={}), cfg=None))
    num_devices = 2  # programs of several devices are not kept

    def init(self, key):
        return {"count": jnp.zeros((), jnp.int32)}

    def place(self, state):
        return state

    def run(self, state, iterations):
        return {"count": state["count"] + iterations}, {"mean": jnp.float32(iterations)}


def test_a_learner_without_parts_is_one_program():
    run, names = compiled(Counting(), 5)
    state, metrics = run({"count": jnp.asarray(2, jnp.int32)})
    assert names == ["run-5, compiled"] and int(state["count"]) == 7 and float(metrics["mean"]) == 5.0


def test_parts_hand_on_what_trees_they_like():
    class InParts(Counting):
        def parts(self):
            def first(state, _):
                return state, (state["count"], [2 * state["count"]], None)

            def last(state, given):
                count, (twice,), none = given
                assert none is None
                return {"count": state["count"] + 1}, {"seen": 1.0 * count, "twice": 1.0 * twice}

            return Part("first", first), Part("last", last, small=True)

    run, names = compiled(InParts(), 3)
    state, metrics = run({"count": jnp.asarray(4, jnp.int32)})
    assert names == ["first, compiled", "last, compiled"] and int(state["count"]) == 7
    assert {name: float(value) for name, value in metrics.items()} == {"seen": 5.0, "twice": 10.0}  # means of 4, 5 and 6


def test_a_part_of_few_products_does_without_triton(learner, monkeypatch):
    given, lower = {}, Programs.lower

    def noted(self, name, *args, options, **rest):
        given[name] = dict(options)
        return lower(self, name, *args, **rest)

    monkeypatch.setattr(iteration.machines, "plain", lambda: {"triton": False})
    monkeypatch.setattr(Programs, "lower", noted)
    compiled(learner, 1)
    own = learner.env.unwrapped.physics.compiler_options
    assert given == {"starts": own, "rollout": {**own, "triton": False}, "update": own}


@pytest.mark.parametrize(("device", "options"), [("gpu", {"xla_gpu_enable_triton_gemm": False}), ("cpu", {})])
def test_only_a_gpu_has_triton(monkeypatch, device, options):
    monkeypatch.setattr(jax, "default_backend", lambda: device)
    assert iteration.machines.plain() == options and options.items() <= iteration.machines.untuned().items()
