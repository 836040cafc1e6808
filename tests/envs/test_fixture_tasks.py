"""Drawers, doors and knobs: where they stand, what counts as done, and that the script does it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import control, env_cfg, make
from mjx_nero.envs import wrappers
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import for_controllers
from mjx_nero.runs import evaluation, resume, starts
from mjx_nero.runs.cfg import Asked

TASKS = ("open_drawer", "open_door", "turn_knob")


@pytest.fixture(scope="module")
def env():
    return make("nero_open_drawer", impl="native", num_envs=8)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("robot", ["nero", "cobotta_pro_900", "piper", "so_arm100", "so_arm101"])
def test_every_arm_has_the_handle_in_front_of_it(task, robot):
    """In its workspace's upper half or just beyond, the bar between the fingers, which open wider than it is thick."""
    cfg = env_cfg(task, robot=robot)
    (name, stands), (x, _, z) = next(iter(cfg.scene.fixtures.items())), cfg.robot.workspace
    handle = {"open_drawer": (-0.045, 0.108), "open_door": (-0.045, -0.035), "turn_knob": (-0.032, 0.0)}[task]
    at = np.array(stands.pos) + [*handle, 0.3] - cfg.robot.base_pos
    assert x[0] < at[0] <= x[1] + 0.03 and np.mean(z) < at[2] < z[1] and name == cfg.controllers["follow_joint"]["file"]
    assert 0.02 < (cfg.robot.opening and min(cfg.robot.opening, 0.061))


def test_episodes_differ_by_place_joint_and_limit(env, functions):
    reset, _ = functions
    sims = jax.jit(jax.vmap(reset))(jax.random.split(jax.random.PRNGKey(0), 200)).pipeline_state
    model = env.physics_model
    cabinet, drawer = model.body("cabinet").id, model.joint("cabinet/drawer")
    moved = np.array(sims.fields["body_pos"])[:, cabinet] - env.cfg.scene.fixtures["cabinet"].pos
    assert np.abs(moved[:, :2]).max() <= 0.03 + 1e-6 and np.ptp(moved[:, :2], axis=0).min() > 0.055
    assert np.abs(moved[:, 2]).max() < 1e-6
    yaw = 2 * np.arctan2(sims.fields["body_quat"][:, cabinet, 3], sims.fields["body_quat"][:, cabinet, 0])
    assert 0.13 < np.abs(yaw).max() <= 0.15 + 1e-6
    upper = np.array(sims.fields["jnt_range"])[:, drawer.id, 1] / 0.16
    assert 0.9 <= upper.min() < 0.92 and 1.08 < upper.max() <= 1.1 + 1e-6
    for name in ("dof_damping", "dof_frictionloss"):
        share = np.array(sims.fields[name])[:, drawer.dofadr[0]] / getattr(model, name)[drawer.dofadr[0]]
        assert 0.5 <= share.min() < 0.6 and 1.9 < share.max() <= 2.0 + 1e-6
    assert not np.array(sims.qpos)[:, drawer.qposadr[0]].any()


@pytest.mark.parametrize(("share", "success"), [(0.79, False), (0.81, True)])
def test_success_is_four_fifths_of_this_drawers_travel_for_half_a_second(env, functions, share, success):
    reset, finish = functions
    state = reset(jax.random.PRNGKey(3))
    joint, sim = env.physics_model.joint("cabinet/drawer"), state.pipeline_state
    sim = sim.replace(qpos=sim.qpos.at[joint.qposadr[0]].set(share * sim.fields["jnt_range"][joint.id, 1]))
    carry = state.info["carry"]
    state = state.replace(info={**state.info, "carry": carry.replace(step=carry.step + env.episode_length - 25)})
    for _ in range(25):
        state = finish(state, jnp.zeros(8), sim, jnp.zeros(()))
    assert state.done == 1 and bool(state.metrics["success"]) == success


def test_pictures_have_the_fixture_where_it_stands(env, functions):
    reset, _ = functions
    state = reset(jax.random.PRNGKey(5))
    look, model = jax.jit(env.scenery)(state).look, env.mj_model
    seen = jax.jit(env.view)(state).fixtures["cabinet"]
    np.testing.assert_allclose(look["body_pos"][model.body("cabinet").id], seen.pos_w, atol=1e-6)
    np.testing.assert_allclose(look["body_pos"][model.body("link3").id], model.body("link3").pos, atol=1e-6)


def test_a_strangers_run_does_not_name_fixtures_elsewhere():
    """The package's own need no trust."""
    named = {"scene.fixtures.cabinet.file": "../theirs", "controllers.follow_joint.file": "knob", "identified": ""}
    assert list(resume._outside(Asked(env=named))) == ["../theirs"]


@pytest.mark.slow
def test_the_script_does_it():
    """A hinge; a slide is below, by a learner's actions, and in ``every_expert.py``. More episodes: docs/guides/fixtures.md."""
    cfg = evaluation.EvalCfg("cobotta_turn_knob", controller="expert", episodes=24, backend="mujoco")
    assert evaluation.play(cfg).result["success_rate"] >= 0.9


@pytest.mark.slow
@pytest.mark.parametrize(("arm", "follow"), [("nero", 0.5), ("piper", 0.0)])
def test_a_hand_that_cannot_turn_with_a_door_does_not(arm, follow):
    """Piper's wrist is straight in front of the handle, and has no way to the side."""
    cfg = for_controllers(env_cfg(f"{arm}_open_door"))
    env = ManipulationEnv(cfg, impl="native", num_envs=1)
    expert = control.make("follow_joint", cfg.robot, env.dt, cfg.controllers["follow_joint"])
    begun = jax.jit(lambda key: expert.init(env.view(env.reset(key))))(jax.random.PRNGKey(0))
    assert float(begun.follow) == follow


def test_a_learner_may_begin_where_the_script_was(env):
    """Half of the script's states have the drawer open by some centimetres, in the hand, and episodes begin there."""
    play = starts._Player(env, 8)
    found, *_ = play(0)
    assert found.won >= 0.75 and found.enough
    bank = jax.tree.map(jnp.asarray, starts.rows(found, 8, wrappers.PHASES, 0))
    opened = np.array(bank.start.fixtures["cabinet"].joint_pos["drawer"])
    assert opened.max() > 0.05 and opened.min() < 0.02
    chances = jnp.zeros(wrappers.PHASES + 1).at[wrappers.PHASES].set(1.0)
    state = jax.jit(lambda key: env.reset(key, starts=(bank, chances)))(jax.random.PRNGKey(0))
    seen = jax.jit(env.view)(state).fixtures["cabinet"]
    at = np.array(seen.joint_pos["drawer"])
    assert np.abs(opened - at).min() < 1e-6 and at > 0.0
    row = int(np.argmin(np.abs(opened - at)))
    np.testing.assert_allclose(seen.pos_w, bank.start.fixtures["cabinet"].pos_w[row], atol=1e-6)


@pytest.mark.slow
def test_training_runs_on_a_cpu(call):
    sizes = ["--num-envs", 16, "--num-timesteps", 1536, "--no-video", "--out", "run"]
    code, out, err = call("train", "--env", "nero_open_drawer", "--impl", "native", *sizes)
    assert code == 0, err
    assert "the scripted expert grasps in" in out + err
