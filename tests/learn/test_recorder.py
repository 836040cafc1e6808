"""Records of steps: what the policy saw and did, and what came of it, before an episode that ends restarts."""

import operator

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import make
from mjx_nero.interop.batch import Batch
from mjx_nero.learn.play import recorder, rollout

N, STEPS = 3, 12  # an episode has 5 control steps, so two end and a third runs on


@pytest.fixture(scope="module")
def env():
    return make("nero_lift", impl="native", episode_length_s=0.1)


@pytest.fixture(scope="module")
def played(env):
    """Steps with random actions: states before, actions, states as ``step`` left them, and the recorder."""
    batch, keep = Batch(env, N), recorder.Recorder()
    step, record = jax.jit(batch.step), jax.jit(lambda *args: recorder.of_batch(env, *args))
    state, steps = jax.jit(batch.reset)(jax.random.PRNGKey(0)), []
    for i, key in enumerate(jax.random.split(jax.random.PRNGKey(1), STEPS)):
        action = jax.random.uniform(key, (N, env.action_size), minval=-1)
        after, last = step(state, action, jax.random.fold_in(key, i))
        keep(record(state, action, last))
        steps.append((state, action, last))
        state = after
    return steps, keep


def test_whole_episodes_are_parted_and_what_still_runs_is_left_out(played):
    found = played[1].episodes()
    assert [len(episode.reward) for episode in found] == [5] * 2 * N
    for episode in found:
        np.testing.assert_array_equal(episode.truncated, [False] * 4 + [True])
        assert not episode.terminated.any()
    assert recorder.Recorder().episodes() == []


def test_a_record_has_what_the_policy_saw_and_what_came_of_it(env, played):
    steps, keep = played
    for i in range(N):
        for number, episode in enumerate(keep.episodes()[2 * i : 2 * i + 2]):
            for t in range(5):
                before, action, last = jax.tree.map(operator.itemgetter(i), steps[5 * number + t])
                for group in env.cfg.observations:
                    np.testing.assert_array_equal(episode.obs[group][t], before.obs[group])
                np.testing.assert_array_equal(episode.action[t], action)
                np.testing.assert_array_equal(episode.qpos[t], last.pipeline_state.qpos)
                np.testing.assert_array_equal(episode.qvel[t], last.pipeline_state.qvel)
                np.testing.assert_array_equal(episode.reward[t], last.reward)


def test_targets_are_what_the_drives_were_told(env, played):
    steps, keep = played
    (state, action, _), first = steps[0], keep.episodes()[0]
    want = jax.jit(jax.vmap(env.targets))(state, action)
    np.testing.assert_allclose(first.targets[0], want[0], atol=1e-6)


def test_an_episode_ends_before_it_restarts(env, played):
    """Its last pose follows the one before; the cube of the next episode lies elsewhere."""
    first, second = played[1].episodes()[:2]
    cube = slice(9, 11)
    np.testing.assert_allclose(first.qpos[-1, cube], first.qpos[-2, cube], atol=1e-3)
    assert np.abs(second.qpos[0, cube] - first.qpos[-1, cube]).max() > 1e-2
    np.testing.assert_array_equal(first.scenery.goal_pos_w[-1], first.scenery.goal_pos_w[0])
    assert np.abs(second.scenery.goal_pos_w[0] - first.scenery.goal_pos_w[0]).max() > 1e-2


def test_a_rollout_keeps_every_step_until_the_episodes_end():
    """The table ends at y = 0.05, so cubes beyond it are lost in the first step."""
    env = make("nero_lift", impl="native", episode_length_s=0.1, **{"terminations.object_off_table.params.center": (0.3, -0.55)})
    seen = []

    def act(params, obs, key):
        return 0.1 * obs["state"][:, : env.action_size]

    episodes = rollout.runner(env, act, 8, record=6)(None, 0)
    for i in range(6):
        seen.append(episodes.episode(i))
        lost = episodes.lengths[i] == 1
        assert len(seen[-1].reward) == (1 if lost else 5) and seen[-1].done.sum() == 1 and seen[-1].done[-1]
        assert seen[-1].terminated[-1] == lost
        np.testing.assert_allclose(seen[-1].action, 0.1 * seen[-1].obs["state"][:, : env.action_size], rtol=1e-6)
        np.testing.assert_allclose(seen[-1].reward.sum(), episodes.returns[i], rtol=1e-4)
    assert 0 < sum(len(each.reward) == 1 for each in seen) < 6
    assert episodes.record.targets.shape == (5, 6, env.physics_model.nu)
    assert episodes.recorded(np.array([4, 1])).record.action.shape == (5, 2, env.action_size)


def test_readings_are_kept_by_name():
    env = make("nero_reach_obstacles", impl="native", episode_length_s=0.1)
    record = rollout.runner(env, lambda params, obs, key: jnp.zeros((2, env.action_size)), 2, record=1)(None, 0).record
    assert record.readings["touch"].shape == record.reward.shape
