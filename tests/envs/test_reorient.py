"""Turning a cube over: what it lies on at first, what counts as done, which arms can, and that the script does it."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import UserError, env_cfg, list_envs, make
from mjx_nero.mdp import sides
from mjx_nero.runs import evaluation


@pytest.fixture(scope="module")
def env():
    return make("nero_reorient", impl="native", num_envs=8)


@pytest.mark.parametrize("robot", ["nero", "cobotta_pro_900", "piper"])
def test_every_arm_of_six_joints_turns_a_cube_of_its_own_size(robot):
    cfg = env_cfg("reorient", robot=robot)
    edge, script = cfg.scene.objects["box"].size[0], cfg.controllers["turn_over"]
    lying = cfg.success.condition.params["lying"]
    assert lying.rest == script["rest"] == pytest.approx(edge / 2) and script["lift"] > edge
    assert lying.minimal_height > edge / 2**0.5  # a cube that is tipped over an edge is not held
    assert script["before"] > lying.clearance  # or the hand never counts as away
    (x, y), spot = (cfg.events["reset_object_position"].params[name] for name in "xy"), script["spot"]
    assert spot == pytest.approx((np.mean(x), np.mean(y)))


def test_arms_of_five_joints_are_told_in_one_line():
    with pytest.raises(UserError, match="so_arm101 has 5 joints, so its hand can only lean along its arm: .* needs 6"):
        env_cfg("reorient", robot="so_arm101")
    assert "so100_reorient" not in list_envs() and "piper_reorient" in list_envs()


def test_another_side_is_up_at_first_and_the_cube_lies_on_the_table(env):
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 300))
    view = jax.jit(jax.vmap(env.view))(state)
    up = np.asarray(jax.jit(jax.vmap(lambda v: sides.normal(v, "box")))(view))[:, 2]
    assert up.max() < 1e-5 and 0.1 < (up < -0.9).mean() < 0.3
    np.testing.assert_allclose(view.objects["box"].pos_w[:, 2], env.cfg.scene.objects["box"].rest_height, atol=1e-6)


@pytest.mark.parametrize(("degrees", "success"), [(9, True), (11, False)])
def test_success_is_the_side_up_for_half_a_second(env, functions, degrees, success):
    reset, finish = functions
    state = reset(jax.random.PRNGKey(3))
    at, sim, carry = int(env.physics_model.joint("box").qposadr[0]), state.pipeline_state, state.info["carry"]
    half = np.radians(degrees) / 2
    tipped = jnp.array([np.cos(half), np.sin(half), 0.0, 0.0])
    sim = sim.replace(qpos=sim.qpos.at[at + 3 : at + 7].set(tipped))
    carry = carry.replace(step=carry.step + env.episode_length - 25, command=jnp.array([0.0, 0.0, 1.0]))
    state = state.replace(info={**state.info, "carry": carry})
    for _ in range(25):
        state = finish(state, jnp.zeros(env.action_size), sim, jnp.zeros(()))
    assert state.done == 1 and bool(state.metrics["success"]) == success


@pytest.mark.slow
def test_the_script_does_it():
    """The Nero's: ``every_expert.py``. Over more episodes: docs/guides/putting.md. Few leave room for chance."""
    cfg = evaluation.EvalCfg("cobotta_reorient", controller="expert", episodes=24, backend="mujoco")
    assert evaluation.play(cfg).result["success_rate"] >= 0.5
