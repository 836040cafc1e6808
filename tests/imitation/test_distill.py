"""Distillation: who teaches, what the student learns, and that a run is saved, resumed and played as any other."""

import dataclasses
import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinematic import Kinematic

from mjx_nero import ManipulationEnv, UserError
from mjx_nero.envs import wrappers
from mjx_nero.imitation.distill import teachers
from mjx_nero.imitation.distill.cfg import DistillCfg, StudentCfg
from mjx_nero.learn import learner, policy
from mjx_nero.tasks import registry
from mjx_nero.types import Picture

EDGE = 16
SMALL = {"scene.cameras.front.size": (EDGE, EDGE), "scene.cameras.wrist.size": (EDGE, EDGE), "episode_length_s": 0.2}
CFG = DistillCfg(
    num_envs=8, minibatch_size=64, student=StudentCfg(channels=(8, 8), features=32, layers=(32,), precision="float32")
)


def drawn(qpos, scenery):
    """Pictures of the table from above, 40 cm wide: where the cube is it is bright."""
    x, y = jnp.meshgrid(jnp.linspace(0.15, 0.55, EDGE), jnp.linspace(-0.2, 0.2, EDGE), indexing="ij")
    bright = jnp.exp(-((x - qpos[9]) ** 2 + (y - qpos[10]) ** 2) / 0.05**2)
    rgb = jnp.tile((255 * bright).astype(jnp.uint8)[..., None], (1, 1, 3))
    return {"front": Picture(rgb=rgb), "wrist": Picture(rgb=255 - rgb)}


@pytest.fixture
def quick(monkeypatch):
    """Physics and cameras that compile at once."""
    drawn.draw = types.SimpleNamespace(prepare=lambda *_: None, bytes=lambda: 0)
    monkeypatch.setattr(ManipulationEnv, "physics", Kinematic())
    monkeypatch.setattr(ManipulationEnv, "cameras", staticmethod(drawn))


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
    assert teachers.find(ManipulationEnv(cfg, "native")).meta["env"] == "nero_lift"
    other = ManipulationEnv(registry.env_cfg("so101_lift", "rgb_fixed"), "native")
    assert teachers.find(other).meta["env"] == "so101_lift"
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


def test_a_policy_knows_what_size_its_pictures_have():
    metas = []
    for size in ((16, 16), (32, 16)):
        env = ManipulationEnv(registry.env_cfg("nero_lift", "rgb_fixed", **{"scene.cameras.front.size": size}), "native")
        metas.append(policy.describe(env, "nero_lift", "rgb_fixed", "distill", {}))
    assert not policy.misfit(metas[0], metas[0])
    said = policy.misfit(*metas)
    assert said.startswith("was trained on pictures of the shapes {'front': [16, 16, 3], ") and "--env.scene.cameras" in said
