"""Networks that read observation groups whose terms stay apart, through an encoder for each term."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from brax.training.acme import running_statistics
from flax import linen
from kinematic import Kinematic

from mjx_nero import UserError, make
from mjx_nero.config.registry import Registry
from mjx_nero.envs import wrappers
from mjx_nero.learn import checkpoint, policy
from mjx_nero.learn.ppo import encoders, networks
from mjx_nero.learn.ppo.cfg import NetworkCfg, PpoCfg, described
from mjx_nero.learn.ppo.learner import Learner

SIZES = {"state": {"picture": (4, 4, 2), "joint_pos": (9,)}, "privileged_state": (5,)}
CFG = NetworkCfg(actor=(16, 8), critic=(8,), encoders=(("picture", "mlp"),), encoder_layers=(12, 6))
KEY = jax.random.PRNGKey(0)


def drawn(n=3):
    shapes = jax.tree.map(lambda size: (n, *size), SIZES, is_leaf=lambda node: isinstance(node, tuple))
    return jax.tree.map(lambda shape: jax.random.normal(KEY, shape), shapes, is_leaf=lambda node: isinstance(node, tuple))


def made(cfg=CFG):
    """Networks, and parameters with statistics that are not those of the start."""
    nets = networks.make_networks(SIZES, 7, cfg)
    normalizer, params = jax.jit(lambda key: networks.init_params(nets, SIZES, key))(KEY)
    obs = jax.tree.map(lambda x: 2.0 * x + 1.0, drawn(50))
    return nets, (running_statistics.update(normalizer, obs), params)


def test_features_of_every_term_by_hand():
    """Terms are normalised, the picture goes through its layers, the joints stay as they are; side by side, by name."""
    nets, (normalizer, params) = made()
    obs, layers = drawn(), params.policy["encoders"]["picture"]["params"]
    seen = {name: (x - normalizer.mean["state"][name]) / normalizer.std["state"][name] for name, x in obs["state"].items()}
    seen = {name: jnp.clip(x, -10, 10) for name, x in seen.items()}
    picture = seen["picture"].reshape(3, 32)
    for name in ("Dense_0", "Dense_1"):
        picture = linen.elu(picture @ layers[name]["kernel"] + layers[name]["bias"])
    assert picture.shape == (3, 6) and params.policy["params"]["MLP_0"]["hidden_0"]["kernel"].shape == (6 + 9, 16)
    plain = networks.make_networks({"state": (15,)}, 7, dataclasses.replace(CFG, encoders=(), max_observation=0.0))
    still = running_statistics.init_state({"state": jnp.zeros(15)})
    trunk = {"params": params.policy["params"]}
    want = plain.policy_network.apply(still, trunk, {"state": jnp.concatenate([seen["joint_pos"], picture], axis=-1)})
    for found, expected in zip(nets.policy_network.apply(normalizer, params.policy, obs), want, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-6)


def test_one_observation_is_encoded_as_a_batch_of_them():
    nets, params = made()
    act, obs = networks.make_act(nets, params), drawn()
    np.testing.assert_allclose(act(jax.tree.map(lambda x: x[1], obs)), act(obs)[1], atol=1e-6)


def test_a_policys_file_says_which_encoders_it_has(tmp_path):
    nets, params = made()
    meta = policy.load(policy.shipped("nero_reach")).meta
    sizes = {"state": {"picture": [4, 4, 2], "joint_pos": [9]}, "privileged_state": [5]}
    meta = {**meta, "observation_size": sizes, "network": dataclasses.asdict(CFG)}
    checkpoint.save(tmp_path / "p.safetensors", params, meta)
    loaded = policy.checkpoint_policy(tmp_path / "p.safetensors")
    assert described(loaded.meta["network"]) == CFG
    np.testing.assert_array_equal(loaded.act(drawn()), networks.make_act(nets, params)(drawn()))


def test_files_of_before_have_none():
    shipped = policy.load(policy.shipped("nero_lift")).meta["network"]
    assert "encoders" not in shipped and described(shipped).encoders == ()


def test_encoders_of_ones_own(monkeypatch):
    monkeypatch.setattr(encoders, "ENCODERS", Registry("encoder", encoders.ENCODERS))

    class Mean(linen.Module):
        @linen.compact
        def __call__(self, x):
            return x.mean(axis=(-3, -2))

    encoders.ENCODERS.add("mean", lambda shape, cfg: Mean())
    _, (_, params) = made(dataclasses.replace(CFG, encoders=(("picture", "mean"),)))
    assert params.policy["params"]["MLP_0"]["hidden_0"]["kernel"].shape == (2 + 9, 16)
    with pytest.raises(UserError, match="there is already an encoder 'mean': choose another name"):
        encoders.ENCODERS.add("mean", lambda shape, cfg: Mean())


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ((("picture", "cnm"),), "unknown encoder 'cnm': choose one of flat, mlp"),
        (
            (("image", "mlp"),),
            "network.encoders names image: an encoder can only read .* not concatenated, and these are joint_pos, picture",
        ),
    ],
)
def test_encoders_that_are_none_are_refused(chosen, message):
    with pytest.raises(UserError, match=message):
        networks.make_networks(SIZES, 7, dataclasses.replace(CFG, encoders=chosen))
    with pytest.raises(UserError, match="network.encoders takes each term once"):
        NetworkCfg(encoders=(("picture", "mlp"), ("picture", "flat")))


def test_ppo_learns_through_encoders():
    """One update changes the encoder's layers, of actor and critic."""
    apart = {f"observations.{group}.apart": True for group in ("state", "privileged_state")}
    env = make("nero_lift", impl="jax", **apart)
    env.physics = Kinematic()
    network = NetworkCfg(actor=(8,), critic=(8,), encoders=(("joint_pos", "mlp"),), encoder_layers=(4,))
    learner = Learner(wrappers.for_training(env), PpoCfg(num_envs=8, unroll_length=4, num_minibatches=4, network=network))
    fresh = jax.jit(learner.init)(KEY)
    state, metrics = jax.jit(learner.run, static_argnums=1)(fresh, 1)
    assert np.isfinite(metrics["loss"])
    for name in ("policy", "value"):
        encoder = [getattr(each.params, name)["encoders"]["joint_pos"]["params"]["Dense_0"]["kernel"] for each in (fresh, state)]
        before, after = map(np.asarray, encoder)
        assert before.shape == (9, 4) and np.abs(after - before).max() > 0
    assert learner.act(learner.policy(state), state.env_state.obs).shape == (8, 8)
