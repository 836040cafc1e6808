"""Imitation of an expert: how much it counts, what a clone does, and what it leaves alone."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics

from mjx_nero.learn.ppo import imitation
from mjx_nero.learn.ppo.cfg import NetworkCfg, PpoCfg
from mjx_nero.learn.ppo.networks import init_params, make_act, make_networks
from mjx_nero.types import Shown

SIZES = {"state": (3,), "privileged_state": (4,)}
KEY, N = jax.random.PRNGKey(0), 16_384
NETS = make_networks(SIZES, 2, NetworkCfg(actor=(32,), critic=(8,), init_std=0.5))


@pytest.fixture(scope="module")
def shown() -> Shown:
    """An expert whose actions are the first observation, doubled, and minus the second; observations about 5, a tenth wide."""
    obs = 5.0 + 0.1 * jax.random.normal(KEY, (N, 4))
    action = jnp.stack([2.0 * (obs[:, 0] - 5.0), 5.0 - obs[:, 1]], axis=1)
    return Shown({"state": obs[:, :3], "privileged_state": obs}, action)


@pytest.fixture(scope="module")
def cloned(shown):
    normalizer, params = init_params(NETS, SIZES, KEY)
    normalizer = imitation.seen(normalizer, shown)
    return normalizer, params, jax.jit(lambda: imitation.cloned(NETS, normalizer, params, shown, KEY))()


def _school(weight=1.0, **more):
    return imitation.School(Shown({}, jnp.zeros((1, 2))), jnp.array(weight), jnp.zeros(()), **more)


def _sums(episodes, success, **more):
    return {f"sum/{name}": jnp.array(float(x)) for name, x in {"episodes": episodes, "success": success, **more}.items()}


def test_what_is_shown_counts_less_the_more_succeed():
    """A tenth of every iteration's rate: 0.1 of all after one in which all do, half as much of what is left at 0.25."""
    school = _school()
    same = school.after(_sums(0, 0))
    assert float(same.weight) == 1 and float(same.success) == 0  # no episode has ended
    one = school.after(_sums(30, 30))
    assert float(one.success) == pytest.approx(0.1) and float(one.weight) == pytest.approx(0.8)
    worse = one.after(_sums(5, 0))
    assert float(worse.success) == pytest.approx(0.09) and float(worse.weight) == pytest.approx(0.8)  # never more again
    half = dataclasses.replace(school, success=jnp.array(0.5)).after(_sums(2, 1))
    assert float(half.weight) == 0 == float(half.after(_sums(9, 0)).weight)


def test_imitation_that_lasts_counts_by_what_fails():
    """10 of 40 episodes began in an expert's state and succeeded; 6 of the other 30 did. A tenth of the rate counts."""
    school = _school(lasts=True)
    after = school.after(_sums(40, 16, visited=10, visited_success=10))
    assert float(after.success) == pytest.approx(0.1 * 6 / 30) and float(after.weight) == pytest.approx(1 - 0.02)
    better = after.after(_sums(10, 10))
    assert float(better.weight) == pytest.approx(1 - 0.9 * 0.02 - 0.1) and float(better.after(_sums(9, 0)).weight) > better.weight
    assert float(_school(weight=0.0, lasts=True).after(_sums(9, 0)).weight) == 0  # nobody has demonstrated


def test_statistics_are_of_what_is_shown_for_long(shown, cloned):
    normalizer = cloned[0]
    np.testing.assert_allclose(normalizer.mean["state"], 5.0, atol=0.01)
    np.testing.assert_allclose(normalizer.std["privileged_state"], 0.1, rtol=0.05)
    assert int(normalizer.count) == imitation.LONG
    other = running_statistics.update(normalizer, jax.tree.map(jnp.zeros_like, shown.obs))
    np.testing.assert_allclose(other.mean["state"], 5.0 * imitation.LONG / (imitation.LONG + N), atol=0.02)


def test_a_clone_acts_as_the_expert_with_little_noise(shown, cloned):
    normalizer, before, after = cloned
    act = make_act(NETS, (normalizer, after))(shown.obs)
    assert float(jnp.mean(jnp.square(act - shown.action))) < 0.02 * float(jnp.mean(jnp.square(shown.action)))
    deviations = NETS.parametric_action_distribution.create_dist(
        NETS.policy_network.apply(normalizer, after.policy, shown.obs)
    ).scale
    np.testing.assert_allclose(deviations, imitation.STILL, rtol=1e-5)
    for a, b in zip(jax.tree.leaves(before.value), jax.tree.leaves(after.value), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_pull_is_as_strong_as_its_weight_and_no_critics(shown, cloned):
    normalizer, before, after = cloned

    def pull(params, weight):
        school = imitation.School(Shown({"state": shown.obs["state"]}, shown.action), jnp.array(weight), jnp.zeros(()))
        return imitation.gradient(NETS, normalizer, params, school, KEY)

    def norm(tree):
        return float(jnp.sqrt(sum(jnp.sum(jnp.square(x)) for x in jax.tree.leaves(tree))))

    whole, half, none = (pull(before, weight) for weight in (1.0, 0.5, 0.0))
    assert norm(half.policy) == pytest.approx(norm(whole.policy) / 2) and norm(none) == 0 == norm(whole.value)
    assert norm(pull(after, 1.0).policy) < norm(whole.policy) / 5  # hardly any from where it already acts so


@pytest.mark.parametrize("iteration, weight, waits", [(19, 1.0, True), (20, 1.0, False), (19, 0.0, False)])
def test_a_clone_waits_for_its_critic_and_nobody_else_does(iteration, weight, waits):
    assert bool(_school(weight).waits(jnp.array(iteration), PpoCfg(critic_first=20))) == waits


@pytest.mark.parametrize("waits", [True, False])
def test_what_waits_is_held_back_and_the_critic_never(cloned, waits):
    after = imitation.held_back(jax.tree.map(jnp.ones_like, cloned[2]), jnp.array(waits))
    assert all((leaf == 1.0 - waits).all() for leaf in jax.tree.leaves(after.policy))
    assert all((leaf == 1).all() for leaf in jax.tree.leaves(after.value))
