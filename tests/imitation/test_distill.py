"""Distillation: who teaches, what the student learns, and that a run is saved, resumed and played as any other."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from pictured import SMALL, patch

from mjx_nero import ManipulationEnv, UserError
from mjx_nero.envs import wrappers
from mjx_nero.imitation.distill import teachers
from mjx_nero.imitation.distill.cfg import DistillCfg, StudentCfg
from mjx_nero.learn import checkpoint, learner, policy
from mjx_nero.tasks import registry

CFG = DistillCfg(
    num_envs=8, minibatch_size=64, student=StudentCfg(channels=(8, 8), features=32, layers=(32,), precision="float32")
)


@pytest.fixture
def quick(monkeypatch):
    """Physics and cameras that compile at once."""
    patch(monkeypatch)


def make(cfg=CFG, preset="rgb_fixed", num_devices=1, **fields):
    env = ManipulationEnv(registry.env_cfg("nero_lift", preset, **SMALL, **fields), "native", cfg.num_envs)
    return learner.find("distill").make(wrappers.for_training(env), cfg, num_devices)


def test_the_student_learns_to_see_and_repeats_to_the_bit(quick):
    made = make(dataclasses.replace(CFG, truth_cost=1.0, num_epochs=4))
    run = jax.jit(made.run, static_argnums=1)
    state = jax.jit(made.init)(jax.random.PRNGKey(0))
    (first, metrics), (again, _) = run(state, 1), run(state, 1)
    assert np.isfinite(list(metrics.values())).all() and int(first.iteration) == 1
    for one, other in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(one, other)
    begun, state = float(metrics["seen_error"]), first
    for _ in range(25):
        state, metrics = run(state, 1)
    assert float(metrics["seen_error"]) < 0.04 < 0.05 < begun  # [m]; the cube's places spread over 10 x 30 cm


def test_the_teacher_acts_where_it_should(quick):
    """At first everywhere; in the end in a quarter of the environments, where the actions are its own."""
    made = make(dataclasses.replace(CFG, teacher_share=0.25, teacher_first=1, unroll_length=1, minibatch_size=8, noise=0.0))
    state = jax.jit(made.init)(jax.random.PRNGKey(0))
    for iteration, taught in ((0, 8), (1, 2)):
        now = dataclasses.replace(state, iteration=jnp.int32(iteration))
        after, batch, _ = jax.jit(made.rollout)(now, jax.random.PRNGKey(1))
        acted = np.asarray(after.info["carry"].action)
        same = np.isclose(acted, batch.label, atol=1e-5).all(1) | (np.asarray(after.done) > 0)
        assert same[:taught].all() and not same[taught:].any()


def test_the_bundled_policy_of_the_task_teaches():
    cfg = registry.env_cfg("nero_lift", "rgb_fixed")
    for name in ("nero_lift", "so101_lift"):
        for preset in ("rgb_fixed", "sim2real_rgb"):
            meta = teachers.find(ManipulationEnv(registry.env_cfg(name, preset), "native")).meta
            assert (meta["env"], meta["preset"]) == (name, "sim2real")
    for name in ("so100_lift", "nero_place", "piper_stack"):  # without a policy of sim2real
        meta = teachers.find(ManipulationEnv(registry.env_cfg(name, "rgb"), "native")).meta
        assert (meta["env"], meta["preset"]) == (name, "default")
    with pytest.raises(UserError, match="train one with the task's preset sim2real"):
        teachers.find(ManipulationEnv(registry.env_cfg("so100_lift", "sim2real_rgb"), "native"))
    slow = dataclasses.replace(cfg.robot.arm, speed=(0.5,) * 7)
    nobody = dataclasses.replace(cfg, robot=dataclasses.replace(cfg.robot, arm=slow))
    with pytest.raises(UserError, match=r"no bundled policy can teach nero this task: train one .* --distill.teacher RUN"):
        teachers.find(ManipulationEnv(nobody, "native"))
    with pytest.raises(UserError, match=r"cannot teach here: it is for another robot \(piper; here nero\)"):
        teachers.find(ManipulationEnv(cfg, "native"), str(policy.shipped("piper_lift")))


def test_what_does_not_go_together_is_refused(quick):
    with pytest.raises(UserError, match="one device, got 2: leave out --num-devices"):
        make(num_devices=2)
    with pytest.raises(UserError, match=r"num_envs \(9\) must be a multiple of 4"):
        make(dataclasses.replace(CFG, num_envs=9, unroll_length=1, minibatch_size=2))
    env = ManipulationEnv(registry.env_cfg("nero_lift"), "native", 8)
    with pytest.raises(UserError, match="needs the observation groups pictures, truth: pass --preset rgb"):
        learner.find("distill").make(wrappers.for_training(env), CFG, 1)


def test_a_student_trains_is_resumed_and_played(quick, call, tmp_path):
    flags = ["--preset", "rgb_fixed", "--num-envs", 8, "--no-video", "--out", "run", "--distill.minibatch_size", 64]
    flags += ["--env.episode_length_s", 0.2, "--distill.student.channels", "(8, 8)"]
    code, out, err = call("train", *flags, "--num-timesteps", 256)
    assert code == 0 and "256 env steps" in out, err
    assert json.loads((tmp_path / "run" / "config.json").read_text())["learner"] == "distill"
    code, out, err = call("train", "--restore", "run", "--num-timesteps", 512, "--no-video")
    assert code == 0 and "512 env steps" in out, err
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    assert rows[-1]["distill/seen_error"] > 0
    play = ["eval", "--policy", "run/policy.safetensors", "--episodes", 2, "--backend", "mujoco", "--env.episode_length_s", 0.2]
    code, out, err = call(*play, "--preset", "rgb_fixed")
    assert code == 0 and "success rate" in out, err


def test_a_file_in_the_convolutions_format_acts_the_same(quick, tmp_path):
    """It takes half the bytes for them."""
    cfg = dataclasses.replace(CFG, student=dataclasses.replace(CFG.student, precision="bfloat16"))
    made, kind = make(cfg), learner.find("distill")
    state = jax.jit(made.init)(jax.random.PRNGKey(0))
    params, meta = made.policy(state), policy.describe(made.env.unwrapped, "nero_lift", "rgb_fixed", "distill", made.describe())
    whole, stored = tmp_path / "whole.safetensors", tmp_path / "stored.safetensors"
    checkpoint.save(whole, params, meta)
    checkpoint.save(stored, kind.stored(params, meta), meta)
    one, other = policy.load(whole), policy.load(stored)
    assert {x.dtype for x in jax.tree.leaves(other.params[1])} == {np.dtype("float32")}
    np.testing.assert_array_equal(jax.jit(one.act)(state.env_state.obs), jax.jit(other.act)(state.env_state.obs))
    eyes = sum(x.size for name, layer in params[1]["params"].items() if name.startswith("eye_") for x in jax.tree.leaves(layer))
    assert eyes > 0
    assert whole.stat().st_size - stored.stat().st_size == pytest.approx(2 * eyes, abs=100)  # the header's names of types


def test_a_student_of_other_widths_says_which_flags_it_needs(quick, call, tmp_path):
    """Only ``rgb`` was run with 128 features; distillation and PPO agree there, since PPO goes on from a student."""
    for preset, features in (("rgb", 128), ("rgb_fixed", 64), ("depth", 64), ("sim2real_rgb", 64)):
        for name in ("distill", "pixels"):
            assert learner.cfg_for(name, preset, {}).student.features == features
    made = make(dataclasses.replace(CFG, student=dataclasses.replace(CFG.student, layers=(16, 32))))
    params, meta = made.policy(jax.jit(made.init)(jax.random.PRNGKey(0))), made.describe()
    meta = policy.describe(made.env.unwrapped, "nero_lift", "rgb_fixed", "distill", meta)
    checkpoint.save(tmp_path / "other.safetensors", params, meta)
    flags = ["--preset", "rgb_fixed", "--num-envs", 8, "--no-video", "--restore", "other.safetensors", "--out", "run"]
    flags += [x for name, value in SMALL.items() for x in (f"--env.{name}", value)]
    code, _, err = call("train", *flags)
    wanted = "--distill.student.channels '8,8' --distill.student.features 32 --distill.student.layers '16,32'"
    assert code == 2 and f"its networks differ: pass {wanted}" in err, err
    assert not (tmp_path / "run").exists()


def test_a_policy_knows_what_size_its_pictures_have():
    metas = []
    for size in ((16, 16), (32, 16)):
        env = ManipulationEnv(registry.env_cfg("nero_lift", "rgb_fixed", **{"scene.cameras.front.size": size}), "native")
        metas.append(policy.describe(env, "nero_lift", "rgb_fixed", "distill", {}))
    assert not policy.misfit(metas[0], metas[0])
    said = policy.misfit(*metas)
    assert said.startswith("was trained on pictures of the shapes {'front': [16, 16, 3], ") and "--env.scene.cameras" in said
