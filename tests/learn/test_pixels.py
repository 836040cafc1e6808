"""PPO from pictures: what it learns from, and that its policies are saved, resumed, played and started from students."""

import dataclasses
import json
import time

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictured import SMALL, patch

from mjx_nero import ManipulationEnv, UserError
from mjx_nero.envs import wrappers
from mjx_nero.learn import checkpoint, learner, policy
from mjx_nero.learn.pixels.cfg import PixelsCfg, StudentCfg
from mjx_nero.runs import compiled
from mjx_nero.tasks import registry

CFG = PixelsCfg(
    num_envs=8,
    unroll_length=4,
    minibatch_size=16,
    num_epochs=1,
    truth_cost=1.0,
    critic_first=1,
    student=StudentCfg(channels=(8, 8), features=32, layers=(32,), precision="float32"),
)


@pytest.fixture
def quick(monkeypatch):
    """Physics and cameras that compile at once."""
    patch(monkeypatch)


def make(cfg=CFG, preset="rgb_fixed", name="pixels"):
    env = ManipulationEnv(registry.env_cfg("nero_lift", preset, **SMALL), "native", cfg.num_envs)
    return learner.find(name).make(wrappers.for_training(env), cfg, 1)


def test_it_learns_to_see_and_its_policy_is_a_student(quick):
    made = make()
    run = jax.jit(made.run, static_argnums=1)
    start = jax.jit(made.init)(jax.random.PRNGKey(0))
    (first, metrics), (again, _) = run(start, 1), run(start, 1)
    assert np.isfinite(list(metrics.values())).all() and set(first.normalizer.mean) == {"state", "teacher", "truth"}
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    second, _ = run(first, 1)
    # The policy waits one iteration for its critic.
    assert not moved(start.params.policy, first.params.policy) and moved(start.params.value, first.params.value)
    assert moved(first.params.policy, second.params.policy) and moved(first.params.value, second.params.value)
    begun, state = float(metrics["seen_error"]), second
    for _ in range(100):
        state, metrics = run(state, 1)
    assert float(metrics["seen_error"]) < 0.7 * begun  # [m]

    normalizer, variables = given = made.policy(state)
    meta = {"student": made.describe()["student"], "observation_size": made.sizes, "action_size": made.env.action_size}
    template, act = learner.find("distill").policy(meta)
    assert jax.tree.map(jnp.shape, template) == jax.tree.map(jnp.shape, given) and set(normalizer.mean) == {"state", "truth"}
    again = made.with_policy(start, given)  # a run that goes on from it
    np.testing.assert_allclose(made.act(made.policy(again), start.env_state.obs), act(given, start.env_state.obs), atol=1e-6)
    np.testing.assert_allclose(np.exp(again.params.policy["params"]["std_logparam"]), CFG.min_std, rtol=1e-6)


def moved(one, other):
    return any((a != b).any() for a, b in zip(*map(jax.tree.leaves, (one, other)), strict=True))


def test_what_does_not_go_together_is_refused(quick):
    with pytest.raises(UserError, match="imitates no expert, whose steps have no pictures"):
        make(dataclasses.replace(CFG, imitation=1.0))
    env = ManipulationEnv(registry.env_cfg("nero_lift"), "native", 8)
    with pytest.raises(UserError, match="needs the observation groups truth, teacher, pictures: pass --preset rgb"):
        learner.find("pixels").make(wrappers.for_training(env), CFG, 1)
    env = ManipulationEnv(registry.env_cfg("nero_lift", "rgb_fixed", **SMALL), "native", 8)
    cfg = dataclasses.replace(learner.cfg_for("ppo", "rgb_fixed", {}), num_envs=8, minibatch_size=16)
    with pytest.raises(UserError, match="the learner ppo reads no pictures: pass --learner pixels"):
        learner.find("ppo").make(wrappers.for_training(env), cfg, 1)


def test_it_trains_is_resumed_and_goes_on_from_a_student(quick, call, tmp_path, monkeypatch):
    happened, make = [], compiled.Fresh.__call__

    def prepare(self, *_):
        time.sleep(0.5)
        happened.append("prepared")

    def started(fresh, seed):
        happened.append("started")
        return make(fresh, seed)

    monkeypatch.setattr(ManipulationEnv, "prepare", prepare)
    monkeypatch.setattr(compiled.Fresh, "__call__", started)
    flags = ["--preset", "rgb_fixed", "--num-envs", 8, "--no-video", "--env.episode_length_s", 0.2, "--learner", "pixels"]
    flags += ["--pixels.unroll_length", 4, "--pixels.minibatch_size", 16]
    flags += ["--pixels.student.channels", "(8, 8)", "--pixels.student.features", 8]
    code, out, err = call("train", *flags, "--num-timesteps", 64, "--out", "run")
    assert code == 0 and "64 env steps" in out, err
    # Pictures are first drawn when all is prepared: two threads may not use Warp at once.
    assert happened[:2] == ["prepared", "started"]
    code, out, err = call("train", "--restore", "run", "--num-timesteps", 128, "--no-video")
    assert code == 0 and "128 env steps" in out, err
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["pixels/seen_error"] > 0
    found = policy.load(tmp_path / "run" / "policy.safetensors")
    assert found.meta["learner"] == "pixels"
    checkpoint.save(tmp_path / "student.safetensors", found.params, {**found.meta, "learner": "distill"})
    code, out, err = call("train", *flags, "--restore", "student.safetensors", "--num-timesteps", 32, "--out", "on")
    assert code == 0 and "32 env steps" in out, err
