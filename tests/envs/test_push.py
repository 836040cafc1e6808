"""Push: where the box starts and has to go, and what counts as there."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import UserError, env_cfg, make
from mjx_nero.sim import contacts, scene
from mjx_nero.sim.robot import GripperCfg
from mjx_nero.tasks.arms.nero import NERO


@pytest.fixture(scope="module")
def env():
    return make("nero_push", impl="native", num_envs=8)


def placed(env, state, off=(0.0, 0.0, 0.0), degrees=0.0):
    """The state with the box at its goal but for an offset and a turn."""
    shown, at = jax.jit(env.scenery)(state), env.physics_model.joint("box").qposadr[0]
    goal = jnp.concatenate([shown.goal_pos_w, shown.goal_quat_w])
    turn = jnp.array([math.cos(math.radians(degrees) / 2), 0.0, 0.0, math.sin(math.radians(degrees) / 2)])
    w, z = goal[3] * turn[0] - goal[6] * turn[3], goal[3] * turn[3] + goal[6] * turn[0]
    qpos = state.pipeline_state.qpos.at[at : at + 7].set(jnp.array([*(goal[:3] + jnp.array(off)), w, 0.0, 0.0, z]))
    return dataclasses.replace(state.pipeline_state, qpos=qpos)


def test_the_box_starts_and_ends_where_the_hand_can_point_down(env):
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 300))
    at = env.physics_model.joint("box").qposadr[0]
    box, shown = np.asarray(state.pipeline_state.qpos[:, at : at + 7]), jax.jit(jax.vmap(env.scenery))(state)
    goal = np.concatenate([shown.goal_pos_w, shown.goal_quat_w], axis=1)
    for pose in (box, goal):
        np.testing.assert_allclose([pose[:, :2].min(0), pose[:, :2].max(0)], [[0.3, -0.1], [0.4, 0.2]], atol=5e-3)
        yaw = np.degrees(2 * np.arctan2(pose[:, 6], pose[:, 3]))
        assert -60 <= yaw.min() < -55 and 55 < yaw.max() <= 60
        np.testing.assert_allclose(pose[:, 2], 0.4 * 0.04, atol=1e-6)  # half the height, 0.8 of the 4 cm of the gripper's cube
    gripper = np.asarray(state.pipeline_state.ctrl[:, 7:])
    np.testing.assert_allclose(gripper, np.tile([0.0, -0.001], (300, 1)), atol=1e-6)  # closed


@pytest.mark.parametrize(
    ("off", "degrees", "success"),
    [
        ((0.0, 0.0, 0.0), 0, True),
        ((0.019, 0, 0), 14, True),
        ((0.021, 0, 0), 0, False),
        ((0, 0, 0), 16, False),
        ((0, 0, 0), 180, True),
    ],
)
def test_success_is_two_centimetres_and_fifteen_degrees_for_half_a_second(env, functions, off, degrees, success):
    reset, finish = functions
    state = reset(jax.random.PRNGKey(0))
    carry = state.info["carry"]
    state = state.replace(info={**state.info, "carry": carry.replace(step=carry.step + env.episode_length - 25)})
    for _ in range(25):
        state = finish(state, jnp.zeros(7), placed(env, state, off, degrees), jnp.zeros(()))
    assert state.done == 1 and bool(state.metrics["success"]) == success


def test_the_marker_has_the_boxs_shape(env):
    model = env.mj_model
    np.testing.assert_array_equal(model.geom("goal").size, model.geom("box").size)
    assert model.geom("goal").type == model.geom("box").type and model.geom("goal").contype == 0


def test_an_arm_without_a_gripper_pushes_too():
    cfg = env_cfg("push", robot=dataclasses.replace(NERO, gripper=GripperCfg()))
    assert cfg.scene.objects["box"].size == pytest.approx((0.08, 0.05, 0.04))
    with pytest.raises(UserError, match="nero has no pick, where on the table it can point down: give it in its config"):
        env_cfg("push", robot=dataclasses.replace(NERO, pick=None))


def test_buffers_hold_the_worst_case():
    cfg = env_cfg("cobotta_push")
    model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False)
    assert cfg.sim.contacts_per_env == sum(pair.contacts for pair in contacts.contact_pairs(model))
    assert cfg.sim.constraints_per_env == sum(contacts.constraint_rows(model).values())


def test_a_box_left_where_it_starts_earns_little(env):
    """On the average of 64 starts, a few of them near their goals: less than a quarter of what it earns there, and no success."""
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 64))

    def rewards(s):
        start, goal = (env.advance(s, jnp.zeros(7), sim, jnp.zeros(())) for sim in (s.pipeline_state, placed(env, s)))
        return start.reward, goal.reward, env.cfg.success.condition(env.view(s))

    start, goal, met = jax.jit(jax.vmap(rewards))(state)
    assert float(start.mean()) < float(goal.mean()) / 4 and (start < goal).all() and met.mean() < 0.05
