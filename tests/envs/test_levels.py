"""How much of all that differs an environment gets, by its own successes; and starts that are drawn ahead."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import env_cfg
from mjx_nero.envs import wrappers
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.mdp import curriculum
from mjx_nero.types import LEVEL, TARGET

N = 4


@pytest.fixture(scope="module")
def env():
    cfg = env_cfg("nero_lift", "sim2real", corruption=False)
    return ManipulationEnv(cfg, impl="native", num_envs=N)


@pytest.fixture(scope="module")
def reset(env):
    return jax.jit(jax.vmap(env.reset, in_axes=(0, None)))


@pytest.fixture(scope="module")
def batch(env):
    return wrappers.for_training(env)


@pytest.fixture(scope="module")
def step(batch):
    return jax.jit(batch.step)


KEYS = jax.random.split(jax.random.PRNGKey(0), N)


def drawn(env, state) -> dict[str, float]:
    """How far, at most, each field is from the compiled model's."""
    fields = state.pipeline_state.fields
    return {name: float(jnp.abs(value - getattr(env.physics_model, name)).max()) for name, value in fields.items()}


def test_a_success_raises_the_level_and_a_failure_lowers_it():
    term = curriculum.BySuccess(start=0.2, up=0.1, down=0.02)
    assert float(term.step(jnp.array(0.2), jnp.array(1.0))) == pytest.approx(0.3)
    assert float(term.step(jnp.array(0.2), jnp.array(0.0))) == pytest.approx(0.18)
    assert float(term.step(jnp.array(0.95), jnp.array(1.0))) == 1 and float(term.step(jnp.array(0.01), jnp.array(0.0))) == 0


def test_a_level_lies_between_what_is_plain_and_what_was_drawn():
    plain, found = {"x": jnp.array([1.0, 2.0]), "n": jnp.array(3)}, {"x": jnp.array([3.0, 0.0]), "n": jnp.array(7)}
    half = curriculum.toward(jnp.array(0.25), plain, found)
    np.testing.assert_allclose(half["x"], [1.5, 1.5])
    assert int(half["n"]) == 7 and curriculum.toward(None, plain, found) is found


def test_at_level_0_nothing_differs_and_at_1_all_does(env, reset):
    """Fields, what is seen, and the action's way: at 0 as in the plain task, at 1 and without a level as drawn."""
    plain, full, usual = reset(KEYS, 0.0), reset(KEYS, 1.0), jax.jit(jax.vmap(env.reset))(KEYS)
    far = drawn(env, plain)
    assert max(far[name] for name in ("body_mass", "geom_size", "geom_friction", "actuator_gainprm", "body_ipos")) == 0
    assert max(far.values()) < 1e-4  # inverse weights, by another way than MuJoCo's
    for a, b in zip(jax.tree.leaves(full.pipeline_state), jax.tree.leaves(usual.pipeline_state), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-6, atol=1e-7)
    np.testing.assert_allclose(full.obs["state"], usual.obs["state"], rtol=0, atol=1e-5)
    assert drawn(env, full)["body_mass"] > 0.01 and LEVEL not in usual.info["carry"].memory
    # What the sensors put off is off by as much as the level says.
    off = [jnp.abs(s.obs["state"] - s.obs["privileged_state"][:, : s.obs["state"].shape[1]]).max() for s in (plain, full)]
    assert float(off[0]) < 1e-6 and float(off[1]) > 2e-3


def test_a_level_takes_a_share_of_each_drawn_field(env, reset):
    half, full = (reset(KEYS, level).pipeline_state.fields for level in (0.5, 1.0))
    for name in ("body_mass", "geom_friction", "actuator_gainprm", "dof_frictionloss"):
        nominal = np.asarray(env._randomization._draws.nominal[name])
        np.testing.assert_allclose(np.asarray(half[name]), (nominal + np.asarray(full[name])) / 2, rtol=1e-5, atol=1e-7)


def test_late_actions_are_as_late_as_the_level_says(env, reset):
    """After a first action, its share that arrives at once is 1 - level wherever the drawn delay holds it back."""
    action = jnp.zeros((N, env.action_size)).at[:, 0].set(1.0)
    moved = {}
    for level in (0.0, 0.5, 1.0):
        state = reset(KEYS, level)
        lag = state.info["carry"].memory["actions.delay"].lag
        late = np.asarray(lag) > 0
        after = jax.jit(jax.vmap(env.act))(state, action)[0].info["carry"].memory["actions.arm"][1][:, 0]  # the set-point's rate
        moved[level] = np.asarray(after)[late]
    assert len(moved[0.0]) and (moved[1.0] == 0).all()
    np.testing.assert_allclose(moved[0.5], moved[0.0] / 2, rtol=1e-5)


def test_an_environments_level_follows_its_own_episodes(env, batch, step):
    state = jax.jit(batch.reset)(KEYS)
    carry = state.info["carry"]
    assert (carry.memory[LEVEL] == 0).all() and env.first_level == 0
    # One step before the end of the episode; in two environments the cube has long been where it has to be.
    view = jax.jit(jax.vmap(env.view))(state)
    there = view.objects["cube"].pos_w - view.root_pos_w
    met = jnp.array([1, 0, 1, 0])
    carry = carry.replace(
        step=jnp.full(N, env.episode_length - 1, jnp.int32),
        command=jnp.where(met[:, None] > 0, there, carry.command),
        memory={**carry.memory, LEVEL: jnp.full(N, 0.5), "success.hold": 1000 * met.astype(jnp.int32)},
    )
    after = step(state.replace(info={**state.info, "carry": carry}), jnp.zeros((N, env.action_size)))
    np.testing.assert_array_equal(after.done, 1)
    np.testing.assert_array_equal(after.metrics["success"], met)
    np.testing.assert_allclose(after.metrics[LEVEL], 0.5)
    np.testing.assert_allclose(after.info["carry"].memory[LEVEL], jnp.where(met > 0, 0.6, 0.48), atol=1e-6)
    assert drawn(env, after)["body_mass"] > 0  # the new episodes have that much of it
    again = step(after, jnp.zeros((N, env.action_size)))
    np.testing.assert_array_equal(again.info["carry"].memory[LEVEL], after.info["carry"].memory[LEVEL])


def test_a_task_that_is_played_has_all_of_it(env):
    """``reset`` without a level, as evaluations, viewers and Gymnasium call it."""
    state = jax.jit(env.reset)(jax.random.PRNGKey(1))
    assert LEVEL not in state.info["carry"].memory and LEVEL not in state.metrics
    single = state.pipeline_state.fields["body_mass"]
    assert float(jnp.abs(single - env.physics_model.body_mass).max()) > 0


def test_a_start_drawn_ahead_is_the_next_episodes(batch, step):
    state = jax.jit(batch.reset)(KEYS)
    sim, carry = start = jax.jit(batch.following)(state)
    last = state.info["carry"].replace(step=jnp.array([249, 249, 10, 10], jnp.int32))
    ending, action = state.replace(info={**state.info, "carry": last}), jnp.zeros((N, batch.action_size))
    after = step(ending, action, start)
    np.testing.assert_array_equal(after.done, [1, 1, 0, 0])
    np.testing.assert_array_equal(after.pipeline_state.qpos[:2], sim.qpos[:2])
    np.testing.assert_array_equal(after.info["carry"].command[:2], carry.command[:2])
    assert (after.info["carry"].command[2:] == last.command[2:]).all() and (carry.command != last.command).any(axis=1).all()
    # Later starts are others, also of environments that have not begun anew.
    again = jax.jit(batch.following)(after)[1]
    assert (again.command != carry.command).any(axis=1).all()
    # Without one the step draws its own.
    own = step(ending, action).info["carry"].command
    assert (own[:2] != last.command[:2]).any(axis=1).all() and (own[:2] != carry.command[:2]).any(axis=1).all()


def test_levels_go_with_any_task_that_draws_objects():
    """A task with targets has both in the episode's memory."""
    cfg = dataclasses.replace(env_cfg("nero_clutter"), curriculum=env_cfg("nero_lift", "sim2real").curriculum)
    env = ManipulationEnv(cfg, impl="native")
    memory = jax.eval_shape(lambda key: env.reset(key, 0.0), jax.random.PRNGKey(0)).info["carry"].memory
    assert {LEVEL, TARGET} <= set(memory)
