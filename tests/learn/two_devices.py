"""The training loop on two devices against one: run by tests/test_ppo.py in a process whose CPU counts as two devices."""

import dataclasses
import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from kinematic import Kinematic
from test_ppo import KEY, SMALL, differ, same

from mjx_nero import ManipulationEnv, UserError, make
from mjx_nero.envs import wrappers
from mjx_nero.learn import checkpoint
from mjx_nero.learn.ppo.learner import Learner, PpoCfg
from mjx_nero.runs import compiled, resume, training


def scripted(learner):
    """The learner, exploring by what each environment draws itself, whatever device it is on: the noise of its joint angles."""
    nets = learner.networks
    dist = nets.parametric_action_distribution

    def make_policy(params):
        normalizer, policy = params

        def act(obs, key):
            logits = nets.policy_network.apply(normalizer, policy, obs)
            normal = dist.create_dist(logits)
            noise = 100 * (obs["state"] - obs["privileged_state"][..., :47])[..., :8]  # within +-1
            raw = normal.loc + normal.scale * noise
            return raw, {"log_prob": dist.log_prob(logits, raw), "raw_action": raw, "distribution_params": logits}

        return act

    learner._make_policy = make_policy
    return learner


@pytest.fixture(scope="module")
def env():
    env = make("nero_lift", impl="jax")
    env.physics = Kinematic()
    return wrappers.for_training(env)


@pytest.fixture(scope="module")
def learners(env):
    return [scripted(Learner(env, SMALL, n)) for n in (1, 2)]


@pytest.fixture(scope="module")
def runs(learners):
    """One iteration on one device and on two, the same environments in each minibatch."""

    def in_order(key, n):  # the k-th minibatch is environments k and 4 + k, on two devices one of each
        return jnp.arange(n).reshape(-1, 4).T.reshape(-1)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(jax.random, "permutation", in_order)
        return [jax.jit(learner.run, static_argnums=1).lower(states(learner), 1).compile() for learner in learners]


def states(learner):
    return learner.place(jax.eval_shape(learner.init, KEY))


@pytest.fixture(scope="module")
def after(learners, runs):
    """State and metrics after two iterations: on one device, and on two."""
    results = []
    for learner, run in zip(learners, runs, strict=True):
        fresh = jax.jit(learner.init)(KEY)
        results.append(run(run(learner.place(fresh))[0]))
    return results


def near(a, b, tolerance=1e-4):
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance, err_msg=jax.tree_util.keystr(path))


def test_two_devices_learn_what_one_does(learners, after):
    """Parameters, optimiser, statistics and environments, after eight minibatches an iteration; but for rounding."""
    one, two = (state for state, _ in after)
    fresh = jax.jit(learners[0].init)(KEY)
    moved = [np.abs(x - y).max() for x, y in zip(jax.tree.leaves(one.params), jax.tree.leaves(fresh.params), strict=True)]
    assert max(moved) > 2e-3 and int(one.iteration) == 2
    near(one.params, two.params)
    near(one, two, 1e-3)  # velocities are differences of positions over 0.02 s


def test_two_devices_report_what_one_does(after):
    (_, one), (_, two) = after
    assert one.keys() == two.keys()
    near(one, two, 1e-3)
    assert float(one["sum/reward"]) != 0 and float(one["kl"]) > 0


def test_environments_are_spread_and_the_rest_is_everywhere(learners, after):
    state = after[1][0]
    assert [s.data.shape for s in state.env_state.pipeline_state.qpos.addressable_shards] == [(4, 16)] * 2
    for x in jax.tree.leaves((state.params, state.opt_state, state.normalizer, state.returns, state.key, state.iteration)):
        first, second = (shard.data for shard in x.addressable_shards)
        np.testing.assert_array_equal(first, second)
    local = learners[1].policy(state)
    same(local, (state.normalizer, state.params))
    assert all(len(x.devices()) == 1 for x in jax.tree.leaves(local))


def test_devices_act_with_noise_of_their_own(env):
    learner = Learner(env, SMALL, 2)
    fresh = jax.jit(learner.init)(KEY)
    twins = fresh.replace(env_state=jax.tree.map(lambda x: jnp.concatenate([x[:4], x[:4]]), fresh.env_state))
    action = np.asarray(jax.jit(learner.run, static_argnums=1)(learner.place(twins), 1)[0].env_state.info["carry"].action)
    assert np.abs(action[:4] - action[4:]).max(axis=1).min() > 0.1


def test_a_checkpoint_goes_on_with_as_many_devices_and_with_others(learners, runs, after, tmp_path):
    fresh = jax.jit(learners[1].init)(KEY)
    half, _ = runs[1](learners[1].place(fresh))
    checkpoint.save(tmp_path / "state.safetensors", half, {})
    loaded = checkpoint.load(tmp_path / "state.safetensors", jax.eval_shape(learners[0].init, KEY))
    same(loaded, half)
    again = [run(learner.place(loaded))[0] for learner, run in zip(learners, runs, strict=True)]
    near(again[0], after[0][0], 1e-3)
    same(again[1], after[1][0])
    assert differ(again[1], half)


def test_a_run_on_two_devices_goes_on_with_one(tmp_path, monkeypatch):
    """Its evaluations get the policy on one device, as their program is for one."""

    class Evaluator(compiled.Evaluator):
        def __call__(self, state):
            self._made.result()
            assert all(len(x.devices()) == 1 for x in jax.tree.leaves(self._learner.policy(state)))
            return {"success_rate": 0.0, "return_mean": 0.0}

        def _lowered(self, state):
            assert all(isinstance(x, jax.ShapeDtypeStruct) for x in jax.tree.leaves(self._learner.policy(state)))
            return None, types.SimpleNamespace(compile=lambda: None)

    monkeypatch.setattr(compiled, "Evaluator", Evaluator)
    monkeypatch.setattr(ManipulationEnv, "physics", Kinematic())
    sizes = {"num_envs": 16, "num_minibatches": 2, "unroll_length": 4, "network.actor": (8,), "network.critic": (8,)}

    def stored():
        return json.loads((tmp_path / "run" / "config.json").read_text())

    def train(iterations, out="run", **rest):
        run = training.resolve(
            "nero_lift", "default", None, {}, {**sizes, "num_timesteps": iterations * 16 * 4}, impl="native", **rest
        )
        return training.train(dataclasses.replace(run, out=tmp_path / out, eval_episodes=2))

    summary = train(2, num_devices=2)
    assert (summary["num_devices"], summary["env_steps"], summary["stopped"]) == (2, 128, "finished")
    assert (stored()["num_devices"], stored()["hyperparameters"]["minibatch_size"]) == (2, 12_288)
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["num_devices"] == 2
    asked = training.resolve("nero_lift", "default", None, {}, {"num_timesteps": 256})
    summary = training.train(resume.same_run(tmp_path / "run", asked, {"num_devices", "num_timesteps"}, {}))
    assert (summary["num_devices"], summary["env_steps"]) == (1, 256)
    assert (stored()["num_devices"], stored()["hyperparameters"]["minibatch_size"]) == (1, 12_288)
    policy = tmp_path / "run" / "policy.safetensors"
    assert train(1, "again", num_devices=2, restore=policy)["num_devices"] == 2  # a policy is told what shapes it must have


def test_two_devices_make_as_many_updates_as_one_with_half_the_environments(env):
    one, two = Learner(env, PpoCfg(num_envs=8192)), Learner(env, PpoCfg(num_envs=16_384), 2)
    assert one.cfg.num_minibatches == two.cfg.num_minibatches == 32


def test_sizes_must_fit_the_devices(env):
    with pytest.raises(UserError, match=r"\(12\) must be a multiple of ppo.num_minibatches \(4\) x num_devices \(2\) = 8"):
        Learner(env, dataclasses.replace(SMALL, num_envs=12), 2)
    with pytest.raises(UserError, match=r"num_devices is 3, but JAX finds 2 here \(cpu\)"):
        Learner(env, SMALL, 3)
