"""Reach tasks: what they command, observe and reward, robots that are given, and the policies that ship."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import UserError, env_cfg, list_envs, make
from mjx_nero.math import quat_mul
from mjx_nero.sim.robot import GripperCfg
from mjx_nero.tasks import reach
from mjx_nero.tasks.arms.nero import NERO

REACHES = [name for name in list_envs() if name.endswith("_reach")]


@pytest.fixture(scope="module")
def env():
    return make("nero_reach", impl="native", corruption=False)


@pytest.fixture(scope="module")
def finish(env):
    """The MDP on the state as it is: nothing moves."""
    step = jax.jit(env.finish)
    return lambda state: step(state, jnp.zeros(7), state.pipeline_state, jnp.zeros(()))


def test_the_recipes_numbers():
    cfg = env_cfg("so100_reach", "isaac")
    assert cfg.sim.dt == pytest.approx(1 / 60) and cfg.sim.decimation == 2 and cfg.episode_length_s == 12.0
    assert cfg.actions["arm"].params["scale"] == 0.5 and cfg.command.resample_s == 5.0
    weights = {name: term.weight for name, term in cfg.rewards.items()}
    assert weights == {"position_tracking": -0.2, "position_tracking_fine": 0.1, "action_rate": -1e-4, "joint_vel": -1e-4}
    assert cfg.rewards["position_tracking_fine"].params == {"std": 0.1}
    assert {name: (term.params["to"], term.params["num_steps"]) for name, term in cfg.curriculum.weights.items()} == {
        "action_rate": (-5e-3, 4500),
        "joint_vel": (-1e-3, 4500),
    }
    noise = {name: term.noise for name, term in cfg.observations["state"].terms.items()}
    assert noise == {"joint_pos": 0.01, "joint_vel": 0.01, "pose_command": 0.0, "actions": 0.0}
    assert cfg.events["reset_robot_joints"].params == {"low": 0.5, "high": 1.5}
    assert env_cfg("nero_reach", "isaac").rewards["orientation_tracking"].weight == -0.1
    assert cfg.robot.arm.stiffness == (200.0, 170.0, 120.0, 80.0, 50.0) and cfg.robot.arm.damping[0] == 80.0
    piper = env_cfg("piper_reach", "isaac")
    assert (piper.sim.decimation, piper.episode_length_s) == (1, 6.0)
    ranges = [piper.command.params[name] for name in ("x", "y", "z", "roll", "pitch", "yaw")]
    assert ranges == [(0.3, 0.4), (0.1, 0.15), (0.3, 0.3), (0, 0), (math.pi / 2, math.pi / 2), (0, 0)]


def test_drives_that_tremble_get_shorter_steps_of_the_same_control():
    cfg = env_cfg("so100_reach")
    assert cfg.robot.arm.stiffness == (998.22,) * 5 and (cfg.sim.dt, cfg.sim.decimation) == (pytest.approx(1 / 240), 8)
    sim = env_cfg("so100_lift").sim
    assert (sim.dt, sim.decimation) == (0.005, 4)


def test_the_arm_alone_acts():
    env = make("nero_reach", impl="native", **{"actions.delay.params.steps": (0, 0)})
    assert env.action_size == 7
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    targets = jax.jit(env.targets)(state, jnp.full(7, 100.0))
    np.testing.assert_allclose(targets[7:], NERO.gripper.home, atol=1e-7)
    assert (targets[:7] > state.pipeline_state.ctrl[:7]).all()


def test_joints_start_at_scaled_home(env):
    joints = jax.jit(jax.vmap(lambda key: env.sample(key)[0].qpos))(jax.random.split(jax.random.PRNGKey(0), 500))
    assert joints[:, 3].min() == pytest.approx(1.0, abs=0.02)  # 2 rad by 0.5 to 1.5, up to the joint's limit
    assert joints[:, 3].max() == pytest.approx(2.14)
    np.testing.assert_array_equal(joints[:, :3], 0)


def test_success_needs_position_and_orientation_for_half_a_second(env, finish):
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    view = jax.jit(env.view)(state)
    at, turn = view.ee_pos_w, view.ee_quat_w
    carry = state.info["carry"]
    off = jnp.array([0.015, 0.0, 0.0])
    quarter = jnp.array([math.cos(0.06), math.sin(0.06), 0, 0])  # 0.12 rad about x, times whatever the hand's turn is

    def played(command, quat, steps):
        now = state.replace(info={**state.info, "carry": carry.replace(command=command, command_quat=quat, step=jnp.int32(160))})
        for _ in range(steps):
            now = finish(now)
        return int(now.info["carry"].memory["success.hold"])

    assert played(at + off, turn, 15) == 15  # half a second, 30 steps a second
    assert played(at + 2 * off, turn, 3) == 0
    assert played(at, quat_mul(quarter, turn), 3) == 0
    assert played(at, -turn, 3) == 3  # the same orientation
    assert round(env.cfg.success.hold_s / env.dt) == 15


def test_a_new_command_every_five_seconds(env, finish):
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    carry = state.info["carry"]
    before = state.replace(info={**state.info, "carry": carry.replace(step=jnp.int32(148))})
    kept = finish(before)
    changed = finish(kept)
    np.testing.assert_array_equal(kept.info["carry"].command, carry.command)
    assert not np.allclose(changed.info["carry"].command, carry.command)


def test_a_position_alone_leaves_orientation_out():
    cfg = env_cfg("so101_reach")
    assert "pose_tracking" not in cfg.rewards and "ee_turn_to_goal" not in cfg.observations["state"].terms
    assert cfg.success.condition.params == {"threshold": 0.02}


def test_any_robot_reaches():
    env = make("reach", robot="nero", impl="native")
    assert env.cfg.robot == NERO and env.cfg.command.params["x"] == (0.3, 0.4)
    moved = dataclasses.replace(NERO, workspace=((0.1, 0.2), (0.0, 0.1), (0.3, 0.3)))
    assert env_cfg("reach", robot=moved).command.params["x"] == (0.1, 0.2)
    assert env_cfg("nero_lift", robot="piper").robot.name == "piper"


def test_an_arm_without_gripper_reaches():
    arm = dataclasses.replace(NERO, gripper=GripperCfg())
    env = make("reach", robot=arm, impl="native")
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    assert env.action_size == 7 and state.pipeline_state.ctrl.shape == (7,)
    assert make("nero_lift", robot=arm, impl="native").action_size == 7


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: env_cfg("reach"), r"reach is for any robot: pass one \(--robot, a folder that import-urdf made, or cobotta"),
        (lambda: env_cfg("reach", robot="nerro"), r"no robot 'nerro' \(did you mean 'nero'\?\): choose one of"),
        (
            lambda: make("cobotta_follow_target", robot="nero", impl="native"),
            "nero.xml has no site or body 'flange'",
        ),
        (lambda: env_cfg("reach", robot=dataclasses.replace(NERO, workspace=None)), "nero has no workspace to command from"),
    ],
)
def test_robots_that_do_not_do(call, message):
    with pytest.raises(UserError, match=message):
        call()


def test_presets_are_fresh():
    assert reach.presets()["default"](NERO).rewards is not reach.presets()["default"](NERO).rewards
