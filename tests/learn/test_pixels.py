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
from mjx_nero.learn import learner, policy
from mjx_nero.learn.pixels.cfg import PixelsCfg, StudentCfg
from mjx_nero.runs import compiled
from mjx_nero.tasks import registry

CFG = PixelsCfg(
    num_envs=8,
    unroll_length=4,
    minibatch_size=16,
    num_epochs=1,
    truth_cost=1.0,
    student=StudentCfg(channels=(8, 8), features=32, layers=(32,), precision="float32"),
)


@pytest.fixture
def quick(monkeypatch):
    """Physics and cameras that compile at once."""
    patch(monkeypatch)


def make(cfg=CFG, preset="rgb_fixed", name="pixels"):
    env = ManipulationEnv(registry.env_cfg("nero_lift", preset, **SMALL), "native", cfg.num_envs)
    return learner.find(name).make(wrappers.for_training(env), cfg, 1)


def test_it_learns_to_see_and_repeats_to_the_bit(quick):
    made = make()
    run = jax.jit(made.run, static_argnums=1)
    state = jax.jit(made.init)(jax.random.PRNGKey(0))
    (first, metrics), (again, _) = run(state, 2), run(state, 2)
    assert np.isfinite(list(metrics.values())).all() and set(first.normalizer.mean) == {"state", "teacher", "truth"}
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    begun, state = float(metrics["seen_error"]), first
    for _ in range(60):
        state, metrics = run(state, 2)
    assert float(metrics["seen_error"]) < 0.7 * begun  # [m]
    before, after = (each.params.policy["student"]["params"]["action"]["kernel"] for each in (first, state))
    assert np.abs(before - after).max() > 1e-3  # the policy moves, too


def test_the_policy_is_a_student_and_begins_as_one(quick):
    made = make()
    state = jax.jit(made.init)(jax.random.PRNGKey(0))
    normalizer, variables = made.policy(state)
    assert set(normalizer.mean) == {"state", "truth"}
    template, act = learner.find("distill").policy(
        {"student": made.describe()["student"], "observation_size": made.sizes, "action_size": made.env.action_size}
    )
    shapes = [jax.tree.map(jnp.shape, each) for each in (template, (normalizer, variables))]
    assert shapes[0] == shapes[1]
    other = jax.jit(made.init)(jax.random.PRNGKey(1))
    given = made.policy(other)
    begun = made.with_policy(state, given)
    np.testing.assert_allclose(made.act(made.policy(begun), other.env_state.obs), act(given, other.env_state.obs), atol=1e-6)
    np.testing.assert_allclose(np.exp(begun.params.policy["params"]["std_logparam"]), CFG.min_std, rtol=1e-6)


def test_a_students_policy_waits_for_its_critic(quick):
    made = make(dataclasses.replace(CFG, critic_first=1))
    run, states = jax.jit(made.run, static_argnums=1), [jax.jit(made.init)(jax.random.PRNGKey(0))]
    for _ in range(2):
        states.append(run(states[-1], 1)[0])
    moved = [
        [
            any((a != b).any() for a, b in zip(*map(jax.tree.leaves, (part(one), part(next))), strict=True))
            for part in (lambda s: s.params.policy, lambda s: s.params.value)
        ]
        for one, next in zip(states, states[1:], strict=False)
    ]
    assert moved == [[False, True], [True, True]]  # policy, critic


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


def test_pictures_are_first_drawn_when_all_is_prepared(quick, call, monkeypatch):
    """Otherwise two threads use Warp at once, if the programs come from the compilation cache."""
    happened, starter = [], compiled.starter

    def prepare(self, *_):
        time.sleep(0.5)
        happened.append("prepared")

    def starting(*given):
        start = starter(*given)
        return lambda seed: (happened.append("started"), start(seed))[1]

    monkeypatch.setattr(ManipulationEnv, "prepare", prepare)
    monkeypatch.setattr(compiled, "starter", starting)
    flags = ["--preset", "rgb_fixed", "--num-envs", 8, "--no-video", "--out", "run", "--distill.minibatch_size", 64]
    flags += ["--env.episode_length_s", 0.2, "--distill.student.channels", "(8, 8)", "--num-timesteps", 128]
    code, _, err = call("train", *flags)
    assert code == 0 and happened[:2] == ["prepared", "started"], err


def test_it_trains_is_resumed_and_goes_on_from_a_student(quick, call, tmp_path):
    small = ["--preset", "rgb_fixed", "--num-envs", 8, "--no-video", "--env.episode_length_s", 0.2]
    net = ["student.channels", "(8, 8)", "student.features", 8]
    ppo = [*small, "--learner", "pixels", "--pixels.unroll_length", 4, "--pixels.minibatch_size", 16]
    ppo += [f"--pixels.{x}" if isinstance(x, str) and x.startswith("student") else x for x in net]
    code, out, err = call("train", *ppo, "--num-timesteps", 64, "--out", "run")
    assert code == 0 and "64 env steps" in out, err
    code, out, err = call("train", "--restore", "run", "--num-timesteps", 128, "--no-video")
    assert code == 0 and "128 env steps" in out, err
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["pixels/seen_error"] > 0
    found = policy.load(tmp_path / "run" / "policy.safetensors")
    assert found.meta["learner"] == "pixels"
    student = [f"--distill.{x}" if isinstance(x, str) and x.startswith("student") else x for x in net]
    code, out, err = call("train", *small, *student, "--num-timesteps", 128, "--distill.minibatch_size", 64, "--out", "student")
    assert code == 0, err
    code, out, err = call("train", *ppo, "--restore", "student/policy.safetensors", "--num-timesteps", 32, "--out", "on")
    assert code == 0 and "32 env steps" in out, err
