"""Evaluation: whole episodes, their bookkeeping and summary."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import make
from mjx_nero.learn.play import figures, rollout
from mjx_nero.learn.play.recorder import Record
from mjx_nero.mdp import metrics as terms
from mjx_nero.mdp.terms import MetricTerm
from mjx_nero.runs import evaluation
from mjx_nero.sim import physics
from mjx_nero.types import Scenery

N = 8
_NONE = np.zeros((5, 0))
NOTHING = Record(
    {}, _NONE, _NONE, _NONE, _NONE, {}, Scenery(np.zeros((5, 0, 3)), np.zeros((5, 0, 4))), _NONE, _NONE > 0, _NONE > 0
)


def idle(params, obs, key):
    """Stays at home, the gripper open."""
    return jnp.zeros((obs["state"].shape[0], 8))


@pytest.fixture(scope="module")
def play(env):
    return rollout.runner(env, idle, N, record=3)


@pytest.fixture(scope="module")
def episodes(play):
    return play(None, 0)


def test_idle_episodes(env, episodes):
    assert (episodes.lengths == 250).all()
    assert not episodes.metrics["success"].any() and not episodes.metrics["grasped"].any()
    assert not episodes.metrics["dropped"].any() and not episodes.metrics["nan"].any()
    for name, values in episodes.metrics.items():
        assert values.shape == (N,) and np.isfinite(values).all(), name
    # The return is the sum of its terms: here the reaching term alone, but for the sinking arm's speed.
    terms = sum(v for k, v in episodes.metrics.items() if k.startswith("reward/"))
    np.testing.assert_allclose(episodes.returns, terms, rtol=1e-4)
    assert (episodes.metrics["reward/reaching_object"] > 0).all() and (episodes.metrics["reward/holding_object"] == 0).all()


@pytest.mark.parametrize(
    ("backend", "impl", "played"),
    [
        ("auto", "auto", "auto"),
        ("auto", "jax", "jax"),
        ("mujoco", "auto", "native"),
        ("mujoco", "native", "native"),
        ("mjx", "jax", "jax"),
        ("mjx", "auto", "warp" if physics.warp_available() else "jax"),
    ],
)
def test_what_a_backend_of_eval_means(backend, impl, played):
    assert evaluation._impl(backend, impl) == played


def test_records(env, episodes):
    assert episodes.qpos.shape == (250, 3, 16) and episodes.scenery.goal_pos_w.shape == (250, 3, 3)
    assert np.isfinite(episodes.qpos).all()
    assert (episodes.scenery.goal_pos_w == episodes.scenery.goal_pos_w[0]).all()
    assert (np.abs(episodes.qpos[:, :, 11] - 0.015) < 1e-3).all()  # the cubes lie on the table
    distance = np.linalg.norm(episodes.qpos[-1, :, 9:12] - episodes.scenery.goal_pos_w[-1], axis=1)
    np.testing.assert_allclose(episodes.metrics["final_distance"][:3], distance, rtol=1e-5)
    assert episodes.distance.shape == (250, N) and episodes.memory == ()
    np.testing.assert_allclose(episodes.distance[-1], episodes.metrics["final_distance"], rtol=1e-6)


GRASPING = terms.grasping(minimal_height=0.02, grasp_radius=0.04)


class Counter:
    """A controller that stays and counts its steps; its targets are where the drives already are."""

    def init(self, view):
        return jnp.zeros((), jnp.int32)

    def step(self, memory, view):
        return memory + 1, view.ctrl

    def warning(self, memory):
        return ""


def test_controllers_play_every_environment_of_a_batch_with_a_memory_of_their_own():
    env = make("cobotta_follow_target", "static", impl="native", episode_length_s=0.2, corruption=False)
    episodes = rollout.runner(env, rollout.controller_agent(env, Counter()), 3, record=3)(None, 0)
    np.testing.assert_array_equal(episodes.memory, [10, 10, 10])
    np.testing.assert_array_equal(episodes.lengths, [10, 10, 10])
    np.testing.assert_allclose(episodes.qpos[:, :, :6], np.broadcast_to(env.cfg.robot.arm.home, (10, 3, 6)), atol=1e-4)
    home = np.array([0.5, 0.0, 0.54])  # of the flange, which follows
    np.testing.assert_allclose(episodes.distance[-1], np.linalg.norm(episodes.scenery.goal_pos_w[-1] - home, axis=1), atol=1e-3)


def test_same_seed_same_episodes(play, episodes):
    again, other = play(None, 0), play(None, 1)
    np.testing.assert_array_equal(again.qpos, episodes.qpos)
    np.testing.assert_array_equal(again.returns, episodes.returns)
    assert (other.qpos[0, :, 9] != episodes.qpos[0, :, 9]).all()


def test_evaluation_draws_other_episodes_than_training(batch, episodes):
    starts = np.asarray(batch.reset(0).pipeline_state.qpos[:, 9])
    assert not np.isin(episodes.qpos[0, :, 9], starts).any()


def test_summary(episodes):
    summary = episodes.summary()
    assert set(summary) == {
        "success_rate",
        "success_rate_95",
        "final_distance_mean",
        "final_distance_median",
        "grasp_rate",
        "time_to_grasp_mean",
        "dropped_rate",
        "return_mean",
        "return_by_term",
        "episode_length_mean",
        "diverged",
        "nan_count",
        "overflow_count",
    }
    assert summary["success_rate"] == 0 and summary["success_rate_95"][0] == 0
    assert summary["time_to_grasp_mean"] is None and summary["grasp_rate"] == 0
    assert summary["episode_length_mean"] == 250 and summary["nan_count"] == summary["overflow_count"] == 0
    assert summary["return_mean"] == pytest.approx(sum(summary["return_by_term"].values()), rel=1e-4)


def test_summary_by_hand():
    metrics = {
        "success": np.array([1.0, 0, 0, 1]),
        "final_distance": np.array([0.01, 0.2, 0.5, 0.01]),
        "grasped": np.array([1.0, 1, 0, 1]),
        "grasp_time": np.array([1.0, 2.0, 0.0, 3.0]),
        "dropped": np.array([0.0, 0, 1, 0]),
        "nan": np.array([0.0, 1, 0, 0]),
        "overflow": np.array([0.0, 0, 3, 0]),
        "reward/a": np.array([1.0, 2, 3, 4]),
    }
    returns, lengths = np.array([1.0, 2, 3, 6]), np.array([250.0, 250, 10, 250])
    summary = rollout.Episodes(metrics, returns, lengths, NOTHING, np.zeros((250, 4)), (), terms=GRASPING).summary()
    assert summary["success_rate"] == 0.5 and summary["grasp_rate"] == 0.5 and summary["dropped_rate"] == 0.25
    assert summary["diverged"] == 1  # the second, a failure that is in no mean
    assert summary["time_to_grasp_mean"] == 2.0  # of those that grasped
    assert summary["final_distance_mean"] == pytest.approx(0.52 / 3) and summary["final_distance_median"] == 0.01
    assert summary["return_mean"] == pytest.approx(10 / 3) and summary["return_by_term"] == {"a": pytest.approx(8 / 3)}
    assert summary["episode_length_mean"] == 190
    assert summary["nan_count"] == 1 and summary["overflow_count"] == 3
    # 2 of 4, z = 1.96: middle 0.5, half width 1.96 * sqrt(1/16 + 0.96040 / 16) / 1.96040 = 0.34996
    np.testing.assert_allclose(summary["success_rate_95"], [0.15004, 0.84996], atol=1e-5)


def test_summary_of_nothing_but_divergence():
    metrics = dict.fromkeys(("success", "final_distance", "grasped", "grasp_time", "dropped", "overflow"), np.zeros(2))
    metrics |= {"nan": np.array([1.0, 0]), "reward/a": np.zeros(2)}
    summary = rollout.Episodes(
        metrics, np.array([0.0, np.nan]), np.ones(2), NOTHING, np.zeros((5, 2)), (), terms=GRASPING
    ).summary()
    assert summary["grasp_rate"] == 0 and summary["time_to_grasp_mean"] is None
    assert summary["diverged"] == 2 and summary["success_rate"] == 0
    assert summary["return_mean"] is None and summary["final_distance_median"] is None
    assert summary["return_by_term"] == {"a": None}


def test_metrics_become_figures_as_their_terms_say():
    plain = MetricTerm(terms.Touched)
    said = {
        **GRASPING,
        "touched": plain,
        "hits": MetricTerm(terms.Touched, over="rate"),
        "way": MetricTerm(terms.Touched, at_end=False),
    }
    values = {
        "grasped": [1.0, 1, 0, 1],
        "grasp_time": [1.0, 2, 0, 3],
        "touched": [0.0, 1, 1, 0],
        "hits": [2.0, 0, 9, 9],
        "way": [4.0, 0, 2, 9],
    }
    whole = np.array([True, True, True, False])  # the last left the numbers: a failure, and in no mean
    assert figures.of_episodes(said, {name: np.array(x) for name, x in values.items()}, whole) == {
        "grasp_rate": 0.5,
        "time_to_grasp_mean": 1.5,
        "touched_mean": pytest.approx(2 / 3),
        "hits_rate": 0.5,
        "way_mean": 2.0,
    }
    sums = {"grasped": 3.0, "grasp_time": 6.0, "touched": 2.0, "way": 15.0}
    found = dict(figures.of_sums(said, sums, episodes=4.0))
    assert found == {"grasped": 0.75, "time_to_grasp": 2.0, "touched": 0.5}  # what is not of an episode's end stays away
    assert dict(figures.of_sums(GRASPING, {"grasped": 0.0, "grasp_time": 0.0}, 1e-9))["time_to_grasp"] == 0


@pytest.mark.parametrize(
    ("successes", "n", "interval"),
    [
        (5, 10, (0.23659, 0.76341)),  # published tables: 0.237, 0.763
        (0, 10, (0.0, 0.27753)),
        (10, 10, (0.72247, 1.0)),
        (81, 263, (0.25530, 0.36621)),  # Newcombe 1998, table I: 0.2553, 0.3662
        (1, 29, (0.00611, 0.17176)),  # the same: 0.0061, 0.1718
    ],
)
def test_wilson(successes, n, interval):
    np.testing.assert_allclose(rollout.wilson(float(successes), n), interval, atol=6e-5)


def test_ended_episodes_freeze():
    """Episodes that end early count once; nothing is added after their end, and their picture stands still."""
    env = make("nero_lift", impl="native", **{"terminations.object_off_table.params.center": (0.3, -0.55)})
    # The table now ends at y = 0.05: cubes beyond it are lost in the first step, the others not at all.
    episodes = rollout.runner(env, idle, N, record=N)(None, 0)
    lost = episodes.qpos[0, :, 10] > 0.05
    assert 0 < lost.sum() < N
    np.testing.assert_array_equal(episodes.lengths, np.where(lost, 1, 250))
    np.testing.assert_array_equal(episodes.metrics["dropped"], lost)
    assert (episodes.qpos[:, lost] == episodes.qpos[0, lost]).all()
    assert (episodes.qpos[-1, ~lost] != episodes.qpos[0, ~lost]).any()
    assert (episodes.returns[lost] < episodes.returns[~lost].min() / 50).all()
    assert (episodes.metrics["final_distance"][lost] > 0).all()


@pytest.mark.parametrize("early", [True, False])
def test_accumulate(env, early):
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 2))
    names = (*state.metrics, "return", "length")
    after = state.replace(reward=jnp.array([2.0, 3.0]), done=jnp.array([float(early), 0.0]))
    totals, active = dict.fromkeys(names, jnp.zeros(2)), jnp.ones(2)
    for _ in range(3):
        state, totals, active = rollout._accumulate(state, after, totals, active)
    np.testing.assert_array_equal(totals["return"], [2.0 if early else 6.0, 9.0])
    np.testing.assert_array_equal(totals["length"], [1 if early else 3, 3])
    np.testing.assert_array_equal(active, [0.0 if early else 1.0, 1.0])
