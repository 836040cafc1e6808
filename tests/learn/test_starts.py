"""Starts from an expert's states: which states, how often, what is kept, and where there are none."""

import dataclasses
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import env_cfg
from mjx_nero.envs import wrappers
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import CurriculumCfg
from mjx_nero.learn import checkpoint
from mjx_nero.mdp import curriculum, events
from mjx_nero.runs import starts
from mjx_nero.types import PHASE, Bank, Shown, Start

N, PHASES = 16, wrappers.PHASES
KEYS = jax.random.split(jax.random.PRNGKey(5), N)


# --- by hand


def test_how_likely_each_phase_is():
    """Nothing has ended: all phases alike. Half of one phase's episodes succeed: it has six times the weight of the others."""
    share, none = jnp.array(0.5), jnp.full(4, -1)
    np.testing.assert_allclose(curriculum.chances(none, jnp.zeros(4), share, 2), [0.5, 0.25, 0.25])
    last, won = jnp.array([1, 1, 2, 0]), jnp.array([1.0, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(curriculum.chances(last, won, share, 2), [0.5, 0.5 * 6 / 7, 0.5 / 7], rtol=1e-6)


def test_the_share_falls_as_the_usual_starts_succeed():
    """A quarter of them: to half of it; half of them: to nothing at all."""
    last = jnp.array([0, 0, 0, 0, 1, 1])
    for successes, share in ((0, 0.5), (1, 0.25), (2, 0.0), (4, 0.0)):
        won = jnp.array([float(i < successes) for i in range(4)] + [1.0, 0.0])
        chances = curriculum.chances(last, won, jnp.array(0.5), 2)
        assert chances[0] == pytest.approx(1 - share) and chances[1:].sum() == pytest.approx(share)
    assert chances[0] == 1  # exactly: no draw is another


def row(i: int) -> Start:
    x = jnp.full(3, float(i))
    quat = jnp.full(4, float(i))
    return Start(jnp.full(2, float(i)), {"cube": x}, {"cube": quat}, x, quat, jnp.array(i), jnp.full(2, 0.1 * i))


def test_a_visited_start_is_a_row_of_its_phase():
    """Six rows of two phases: those of the second are 1, 3 and 5; where the object has not arrived the goal is the usual one."""
    arrived = jnp.array([False, False, False, True, False, True])
    bank = Bank(jax.tree.map(lambda *x: jnp.stack(x), *(row(i) for i in range(6))), arrived)
    usual = row(9)

    def draw(*chances):
        start = lambda key: events.visited(key, usual, bank=bank, chances=jnp.array(chances))  # noqa: E731
        return jax.jit(jax.vmap(start))(jax.random.split(jax.random.PRNGKey(0), 400))

    drawn = draw(0.0, 0.0, 1.0)
    rows = np.asarray(drawn.target)
    assert set(rows) == {1, 3, 5} and (drawn.phase == 2).all()
    np.testing.assert_array_equal(drawn.object_pos_w["cube"][:, 0], rows)
    np.testing.assert_allclose(drawn.pull[:, 0], 0.1 * rows, rtol=1e-6)
    np.testing.assert_array_equal(drawn.goal_pos_w[:, 2], np.where(rows == 1, 9, rows))
    for a, b in zip(jax.tree.leaves(draw(1.0, 0.0, 0.0)), jax.tree.leaves(usual), strict=True):
        np.testing.assert_array_equal(a, np.broadcast_to(b, a.shape))
    often = np.bincount(draw(0.5, 0.25, 0.25).phase) / 400
    np.testing.assert_allclose(often, [0.5, 0.25, 0.25], atol=0.08)


def test_what_is_worth_starting_from():
    """Ten steps. Two of four have succeeded for 3 and 10 steps; grasped at the steps 2 and 9; one has not grasped."""
    grasped = np.zeros((10, 4), bool)
    grasped[2:, :2], grasped[9:, 2] = True, True
    won, hold = np.array([True, True, False, False]), np.array([3, 10, 0, 0])
    about = {"coming": 1, "past": 3}
    most = starts.way(None, grasped, won, hold, **about)
    assert most.begins.tolist() == [1, 0, 0, 0] and most.ends.tolist() == [7, 1, 0, 0]
    rare = starts.way(None, grasped, won & (hold == 3), hold, **about)
    assert rare.begins.tolist() == [1, 1, 8, 0] and rare.ends.tolist() == [7, 5, 10, 0]
    assert (rare.won, rare.held) == (0.25, 0.75) and rare.enough
    assert starts.way(None, grasped, won, hold, **about, whole=False).ends.tolist() == [5, 5, 10, 0]
    few = starts.way(None, np.zeros((10, 5), bool), np.arange(5) == 0, np.full(5, 3), **about)
    assert few.ends.tolist() == [7, 0, 0, 0, 0] and not few.enough


def test_rows_are_of_their_phases():
    """Eight steps worth it, from the third on, in four phases: two each; nothing of the episode that is worth nothing."""
    step, episode = np.indices((20, 3))
    way = starts.Way({"step": step, "episode": episode}, np.array([2, 0, 2]), np.array([10, 0, 10]), 1.0, 1.0)
    found = starts.rows(way, 200, 4, seed=0)
    np.testing.assert_array_equal(found["step"] // 2, 1 + np.arange(200) % 4)
    assert set(found["episode"]) == {0, 2} and set(found["step"]) == set(range(2, 10))


def test_steps_that_are_shown_are_of_episodes_worth_it():
    """Three steps of four episodes, of which the second and the last are worth it: each step of those as often as any other."""
    step, episode = np.indices((3, 4))
    way = starts.Way(None, np.zeros(4, int), np.array([0, 2, 0, 3]), 1.0, 1.0)
    found = starts.steps(way, Shown({"state": 10 * step + episode}, step), 16_384, seed=0)
    which, often = np.unique(found.obs["state"], return_counts=True)
    assert which.tolist() == [1, 3, 11, 13, 21, 23] and (found.obs["state"] // 10 == found.action).all()
    np.testing.assert_allclose(often / 16_384, 1 / 6, atol=0.02)


# --- with physics


@pytest.fixture(scope="module")
def env():
    cfg = env_cfg("lift", robot="nero", **{"curriculum.expert_starts": 0.5}).uncorrupted()
    return ManipulationEnv(cfg, impl="native", num_envs=N)


@pytest.fixture(scope="module")
def batch(env):
    return wrappers.for_training(env)


def asked(env, num_envs=N):
    """What ``starts.Maker`` asks of a learner."""
    return types.SimpleNamespace(env=env, num_envs=num_envs)


@pytest.fixture(scope="module")
def told():
    return []


@pytest.fixture(scope="module")
def bank(batch, told):
    found = starts.Maker(asked(batch), told.append)(3)
    assert set(found) == {"bank"}  # its learner imitates nobody
    return found["bank"]


@pytest.fixture(scope="module")
def reset(env):
    return jax.jit(lambda bank, chances: jax.vmap(lambda key: env.reset(key, starts=(bank, chances)))(KEYS))


def certain(phase: int):
    return jnp.zeros(PHASES + 1).at[phase].set(1.0)


@pytest.mark.slow
def test_a_start_is_a_visited_state(env, reset, bank, told):
    """Joints, cube and what the fingers press with are one of the bank's rows; all is at rest, under a goal of its own."""
    assert len(told) == 1 and "grasps in 100%" in told[0] and "some episodes start from its states" in told[0]
    state = reset(bank, certain(PHASES))
    sim, carry, view = state.pipeline_state, state.info["carry"], jax.jit(jax.vmap(env.view))(state)
    rows = np.asarray(bank.start.object_pos_w["cube"])[PHASES - 1 :: PHASES]
    which = PHASES - 1 + PHASES * np.argmin(np.abs(np.asarray(view.objects["cube"].pos_w)[:, None] - rows).sum(-1), axis=1)
    np.testing.assert_allclose(view.objects["cube"].pos_w, bank.start.object_pos_w["cube"][which], atol=1e-7)
    np.testing.assert_allclose(view.joint_pos, bank.start.joint_pos[which], atol=1e-7)
    np.testing.assert_allclose(sim.ctrl, bank.start.joint_pos[which] + bank.start.pull[which], atol=1e-6)
    assert (sim.qvel == 0).all() and (carry.memory[PHASE] == PHASES).all() and (carry.step == 0).all()
    kept = np.isclose(view.goal_pos_w, bank.start.goal_pos_w[which], atol=1e-6).all(axis=1)
    np.testing.assert_array_equal(kept, bank.arrived[which])
    # The fingers press, and the actions' memory knows it: the last action closed.
    assert (np.abs(bank.start.pull[which][:, -2:]).max(axis=1) > 0.005).all() and (bank.start.pull[:, :7] == 0).all()
    assert carry.memory["actions.gripper"].all() and (carry.action[:, -1] == -1).all() and (carry.action[:, :7] == 0).all()


@pytest.mark.slow
def test_a_held_cube_is_still_held(env, reset, bank):
    """After 20 steps without any action."""
    state, step = reset(bank, certain(PHASES)), jax.jit(jax.vmap(env.step))
    before = jax.jit(jax.vmap(env.view))(state)
    for _ in range(20):
        state = step(state, jnp.zeros((N, env.action_size)))
    view = jax.jit(jax.vmap(env.view))(state)
    moved = (view.objects["cube"].pos_w - view.ee_pos_w) - (before.objects["cube"].pos_w - before.ee_pos_w)
    assert (before.objects["cube"].pos_w[:, 2] > 0.02).all()
    assert np.linalg.norm(moved, axis=1).max() < 0.005, moved


@pytest.mark.slow
def test_usual_starts_are_as_without_a_bank(env, bank):
    """Computed one operation after another, because a compiler rounds two programs in two ways."""
    rows = jax.tree.map(jnp.asarray, bank)
    with jax.disable_jit():
        with_bank = jax.vmap(lambda key: env.reset(key, starts=(rows, certain(0))))(KEYS)
        without = jax.vmap(env.reset)(KEYS)
    for a, b in zip(jax.tree.leaves(with_bank.pipeline_state), jax.tree.leaves(without.pipeline_state), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(with_bank.obs["state"], without.obs["state"])
    memory = {name: with_bank.info["carry"].memory[name] for name in without.info["carry"].memory}
    for a, b in zip(jax.tree.leaves(memory), jax.tree.leaves(without.info["carry"].memory), strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_episodes_start_by_what_came_of_the_last_ones(batch, bank):
    """Half of them visited while no usual start succeeds, none from when all do; each is counted at its end."""
    state = jax.jit(batch.reset)(KEYS, bank)
    begun = np.asarray(state.info["carry"].memory[PHASE])
    assert 0 < (begun > 0).sum() < N
    carry = state.info["carry"]
    ending = carry.replace(
        step=jnp.full(N, batch.unwrapped.episode_length - 1, jnp.int32),
        command=jax.jit(jax.vmap(batch.unwrapped.view))(state).objects["cube"].pos_w,
        memory={**carry.memory, "success.hold": jnp.full(N, 1000, jnp.int32)},
    )
    state = state.replace(info={**state.info, "carry": ending})
    after = jax.jit(lambda s: batch.step(s, s.info["carry"].action, batch.following(s)))(state)
    progress = after.info["starts"]
    np.testing.assert_array_equal(progress.last, begun)
    np.testing.assert_array_equal(progress.won, after.metrics["success"])
    np.testing.assert_array_equal(after.metrics["visited"], begun > 0)
    assert progress.won[begun == 0].all()
    assert (jax.jit(batch.following)(after)[1].memory[PHASE] == 0).all()
    failed = after.replace(info={**after.info, "starts": progress.replace(won=jnp.zeros(N))})
    assert (jax.jit(batch.following)(failed)[1].memory[PHASE] > 0).any()


@pytest.mark.slow
def test_the_bank_is_kept_with_the_run(batch, bank, tmp_path):
    """A checkpoint holds it, so the next starts are the same to the bit; and its shapes are known before it is made."""
    reset = jax.jit(batch.reset)
    state = reset(KEYS, bank)
    checkpoint.save(tmp_path / "state.safetensors", state, {})
    again = checkpoint.load(tmp_path / "state.safetensors", jax.eval_shape(reset, KEYS))
    following = jax.jit(batch.following)
    for a, b in zip(jax.tree.leaves(following(state)), jax.tree.leaves(following(again)), strict=True):
        np.testing.assert_array_equal(a, b)
    assert (following(again)[1].memory[PHASE] > 0).any()


def test_no_bank_no_visited_starts(batch):
    state = jax.jit(batch.reset)(KEYS)
    assert (state.info["carry"].memory[PHASE] == 0).all() and (state.info["starts"].share == 0).all()
    assert (jax.jit(batch.following)(state)[1].memory[PHASE] == 0).all()


def test_episodes_that_are_played_have_none(env):
    """Evaluations, Gymnasium and viewers reset without a bank."""
    carry = jax.eval_shape(env.reset, KEYS[0]).info["carry"]
    assert PHASE not in carry.memory
    plain = dataclasses.replace(env.cfg, curriculum=CurriculumCfg())
    assert not isinstance(wrappers.for_training(ManipulationEnv(plain, impl="native")), wrappers.ExpertStarts)


def test_a_task_without_an_expert_says_so():
    told = []
    cfg = env_cfg("nero_push", **{"curriculum.expert_starts": 0.5})
    env = wrappers.for_training(ManipulationEnv(cfg, impl="native"))
    assert starts.Maker(asked(env), told.append)(0) == {}
    assert told == ["no expert demonstrates: the task has no script that grasps"]


def test_a_run_that_begins_with_a_policy_imitates_nobody():
    told, env = [], wrappers.for_training(ManipulationEnv(env_cfg("nero_lift"), impl="native"))
    learner = types.SimpleNamespace(**vars(asked(env)), imitates=True)
    assert starts.Maker(learner, told.append, new=False)(0) == {} and not told


def test_all_that_differs_is_left_out_where_the_expert_plays():
    cfg = starts.playground(env_cfg("nero_lift", "sim2real"))
    assert not cfg.randomization and not cfg.sensors and cfg.robot.gravity_compensation
    assert not any(group.corruption for group in cfg.observations.values())
    assert cfg.actions == env_cfg("nero_lift", "sim2real").actions  # it plays by what a policy acts by
