"""Policies: the file, the checks on what it was trained for, the action it chooses."""

import dataclasses
import json
import pathlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import UserError, env_cfg, make
from mjx_nero.envs.task import joint_actions
from mjx_nero.learn import bundled, checkpoint, policy
from mjx_nero.learn.ppo import networks
from mjx_nero.learn.ppo.cfg import NetworkCfg
from mjx_nero.mdp.actions import BinaryGripper
from mjx_nero.mdp.terms import Term

CFG = NetworkCfg(actor=(16, 8), critic=(8,))


@pytest.fixture(scope="module")
def trained(env):
    """Networks, parameters and description of an untrained policy of the default preset."""
    nets = networks.make_networks(env.observation_size, env.action_size, CFG)
    # Jitted, as in training: all leaves become arrays.
    params = jax.jit(lambda key: networks.init_params(nets, env.observation_size, key))(jax.random.PRNGKey(0))
    return nets, params, policy.describe(env, "nero_lift", "default", "ppo", {"network": dataclasses.asdict(CFG)})


@pytest.fixture
def path(trained, tmp_path):
    path = tmp_path / "policy.safetensors"
    checkpoint.save(path, *trained[1:])
    return path


@pytest.fixture(scope="module")
def obs(env):
    return jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(1), 4)).obs


def test_loaded_policy_acts_bit_equal(env, trained, path, obs):
    nets, params, meta = trained
    for loaded in (policy.load(path), policy.load(str(path)), policy.load_for(env, "nero_lift", path)):
        assert loaded.meta == json.loads(json.dumps(meta))
        jax.tree.map(np.testing.assert_array_equal, loaded.params, params)
        np.testing.assert_array_equal(loaded.act(obs), networks.make_act(nets, params)(obs))


def test_act_is_deterministic_single_or_batched_and_reads_the_state_alone(trained, path, obs):
    act = policy.load(path).act
    batched = act(obs)
    assert batched.shape == (4, 8) and np.unique(batched, axis=0).shape[0] == 4
    np.testing.assert_array_equal(act(obs), batched)
    one = act(jax.tree.map(lambda x: x[0], obs))
    assert one.shape == (8,)
    np.testing.assert_allclose(one, batched[0], atol=1e-6)
    blind = {**obs, "privileged_state": jnp.full_like(obs["privileged_state"], jnp.nan)}
    np.testing.assert_array_equal(act(blind), batched)


@pytest.mark.parametrize("distribution", ["normal", "tanh_normal"])
def test_act_is_the_mode_of_the_distribution(env, obs, distribution):
    cfg = dataclasses.replace(CFG, distribution=distribution, init_std=0.5)
    nets = networks.make_networks(env.observation_size, env.action_size, cfg)
    normalizer, params = networks.init_params(nets, env.observation_size, jax.random.PRNGKey(0))
    logits = nets.policy_network.apply(normalizer, params.policy, obs)
    mean = nets.parametric_action_distribution.create_dist(logits).loc
    want = jnp.tanh(mean) if distribution == "tanh_normal" else mean
    np.testing.assert_allclose(networks.make_act(nets, (normalizer, params))(obs), want, atol=1e-6)
    if distribution == "normal":
        np.testing.assert_allclose(nets.parametric_action_distribution.create_dist(logits).scale, 0.5, rtol=1e-5)


def test_a_policy_starts_near_home(trained):
    """Its last layer's weights are a hundredth of LeCun's, which are uniform within the root of 3 / 8 for 8 inputs."""
    _, (_, params), _ = trained
    last = np.abs(params.policy["params"]["Dense_0"]["kernel"])
    most = 0.01 * np.sqrt(3 / 8)
    assert last.shape == (8, 8) and 0.8 * most < last.max() <= most


def test_normalised_observations_have_a_bound(env, trained, obs):
    """Ten deviations."""
    nets, params, _ = trained
    mean, std = params[0].mean["state"], params[0].std["state"]
    far, ten = ({**obs, "state": mean + k * std + 0 * obs["state"]} for k in (1e6, 10))
    act = networks.make_act(nets, params)
    np.testing.assert_array_equal(act(far), act(ten))
    nets = networks.make_networks(env.observation_size, 8, dataclasses.replace(CFG, max_observation=0.0))
    unbounded = networks.make_act(nets, params)
    np.testing.assert_array_equal(unbounded(ten), act(ten))
    assert np.abs(unbounded(far) - act(far)).min() > 1


def test_a_file_without_the_bound_is_played_without(trained, obs, tmp_path):
    _, params, meta = trained
    network = {name: value for name, value in meta["network"].items() if name != "max_observation"}
    checkpoint.save(tmp_path / "old.safetensors", params, {**meta, "network": network})
    far = {**obs, "state": obs["state"] + 1e6}
    old, new = (policy.load(tmp_path / "old.safetensors").act(x) for x in (far, obs))
    assert np.abs(old - new).min() > 1


def test_normalizer_is_part_of_the_policy(trained, obs):
    nets, (normalizer, params), _ = trained
    shifted = normalizer.replace(mean=jax.tree.map(lambda x: x + 0.5, normalizer.mean))
    moved = networks.make_act(nets, (shifted, params))({**obs, "state": obs["state"] + 0.5})
    np.testing.assert_allclose(moved, networks.make_act(nets, (normalizer, params))(obs), atol=1e-5)


def test_critic_reads_the_privileged_group_where_there_is_one(env, trained, obs):
    nets, (normalizer, params), _ = trained
    value = nets.value_network.apply(normalizer, params.value, obs)
    other = {**obs, "privileged_state": obs["privileged_state"] + 1}
    assert (nets.value_network.apply(normalizer, params.value, other) != value).all()
    recipe = make("nero_lift", "isaac", impl="native")
    nets = networks.make_networks(recipe.observation_size, recipe.action_size, CFG)
    normalizer, params = networks.init_params(nets, recipe.observation_size, jax.random.PRNGKey(0))
    assert nets.value_network.apply(normalizer, params.value, jax.jit(recipe.reset)(jax.random.PRNGKey(0)).obs).shape == ()


def test_policy_of_another_environment(env, trained, tmp_path):
    path = tmp_path / "policy.safetensors"
    checkpoint.save(path, trained[1], {**trained[2], "env": "other_lift"})
    with pytest.raises(UserError, match=f"^{path} is a policy of other_lift, not of nero_lift: pass --env other_lift$"):
        policy.load_for(env, "nero_lift", path)


def test_policy_of_another_preset(path):
    recipe = make("nero_lift", "isaac", impl="native")
    with pytest.raises(UserError, match=r"was trained on other observations \(preset default\): pass --preset default$"):
        policy.load_for(recipe, "nero_lift", path)


def test_policy_of_the_same_terms_of_other_sizes(path):
    longer = make("nero_lift", impl="native", **{"observations.state.joint_pos.history": 2})
    with pytest.raises(UserError, match=r"of size \[47\], but here it is \[56\]: pass the --preset \(it had default\) and the"):
        policy.load_for(longer, "nero_lift", path)


def test_policy_of_other_actions(env, trained, tmp_path):
    """Of before 0.5.0, which had positions and did not say so; and the other way round."""
    positions = make("nero_lift", impl="native", actions=joint_actions())
    _, params, meta = trained
    old = {name: value for name, value in meta.items() if name != "actions"}
    checkpoint.save(tmp_path / "old.safetensors", params, old)
    assert policy.load_for(positions, "nero_lift", tmp_path / "old.safetensors").meta["env"] == "nero_lift"
    with pytest.raises(UserError, match=r"was trained on other actions \(JointPosition; here JointVelocity, BinaryGripper\)"):
        policy.load_for(env, "nero_lift", tmp_path / "old.safetensors")
    checkpoint.save(tmp_path / "new.safetensors", params, policy.describe(env, "nero_lift", "default", "ppo", old))
    with pytest.raises(UserError, match=r"\(JointVelocity, BinaryGripper; here JointPosition, BinaryGripper\)"):
        policy.load_for(positions, "nero_lift", tmp_path / "new.safetensors")


def test_policy_of_another_gripper():
    hand = make("nero_stack", impl="native", actions={**env_cfg("nero_stack").actions, "gripper": Term(BinaryGripper)})
    with pytest.raises(UserError, match=r"\(JointVelocity, ContinuousGripper; here JointVelocity, BinaryGripper\): pass"):
        policy.load_for(hand, "nero_stack", policy.shipped("nero_stack"))


def test_policy_of_another_robot_of_the_same_name(trained, path):
    """Its arm has other limits to its drives' forces."""
    other = make("nero_lift", impl="native", **{"robot.arm.effort": (1.0,) * 7})
    with pytest.raises(UserError, match=r"another model of nero .* pass the --robot or --env.identified that it was .*, train"):
        policy.load_for(other, "nero_lift", path)
    assert policy.load_for(other, "nero_lift", path, any_robot=True).meta["robot"] == "nero"


def test_a_preset_may_ship_a_policy_of_its_own(monkeypatch, tmp_path):
    monkeypatch.setattr(bundled, "ASSETS", tmp_path)
    (tmp_path / "policies").mkdir()
    (tmp_path / "policies" / "nero_lift_sim2real.safetensors").touch()
    stems = {preset: policy.shipped("nero_lift", preset).stem for preset in ("default", "isaac", "sim2real")}
    assert stems == {"default": "nero_lift", "isaac": "nero_lift", "sim2real": "nero_lift_sim2real"}


def test_fingerprint_knows_models_apart():
    robots = [make(f"{name}_reach", impl="native").cfg.robot for name in ("nero", "piper")]
    nero = policy.fingerprint(robots[0])
    assert nero == policy.fingerprint(robots[0]) != policy.fingerprint(robots[1])
    heavier = dataclasses.replace(robots[0].arm, damping=tuple(1.01 * d for d in robots[0].arm.damping))
    assert policy.fingerprint(dataclasses.replace(robots[0], arm=heavier)) != nero
    rounded = dataclasses.replace(robots[0].arm, damping=tuple(d * (1 + 1e-9) for d in robots[0].arm.damping))
    assert policy.fingerprint(dataclasses.replace(robots[0], arm=rounded)) == nero


def test_missing_and_damaged_policies(env, path):
    with pytest.raises(UserError, match="^no such file: /nowhere/policy.safetensors$"):
        policy.load_for(env, "nero_lift", "/nowhere/policy.safetensors")
    data = path.read_bytes()
    for spoilt in (data[:-100], b"\x00" * 64, np.random.default_rng(0).bytes(2000)):
        path.write_bytes(spoilt)
        with pytest.raises(UserError, match="is not a policy or checkpoint of mjx_nero, or it is damaged"):
            policy.load(path)


def test_arrays_of_other_shapes(env, trained, tmp_path):
    path = tmp_path / "policy.safetensors"
    meta = {**trained[2], "network": {**trained[2]["network"], "actor": [16, 9]}}
    checkpoint.save(path, trained[1], meta)
    with pytest.raises(UserError, match=r"does not fit: .*kernel.* is float32\(8, 8\), expected float32\(9, 8\)"):
        policy.load(path)
    checkpoint.save(path, trained[1][0], trained[2])  # the normalizer alone
    with pytest.raises(UserError, match="does not fit this environment and these networks, or it is damaged"):
        policy.load(path)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"network": None}, "does not describe a policy: give the policy.safetensors of a run"),
        ({"network": {"layers": [3]}}, "does not describe a policy: give the policy.safetensors of a run"),
        ({"observation_size": 3}, "does not describe a policy: give the policy.safetensors of a run"),
        ({"network": {"activation": "gelu"}}, "unknown activation 'gelu'"),
    ],
)
def test_files_that_describe_no_policy(trained, tmp_path, changes, message):
    path = tmp_path / "policy.safetensors"
    checkpoint.save(path, trained[1], {**trained[2], **changes})
    with pytest.raises(UserError, match=message):
        policy.load(path)


def test_no_policy_ships(env, monkeypatch):
    monkeypatch.setattr(bundled, "ASSETS", pathlib.Path("/nowhere"))
    with pytest.raises(UserError, match=r"^there is no bundled policy for nero_lift: train one \(python train.py --env"):
        policy.load_for(env, "nero_lift", None)
    with pytest.raises(UserError, match=r"train one \(python train.py --env reach --robot \./my_arm\)"):
        policy.load_for(env, "reach", None, robot="./my_arm")


def test_the_policy_that_ships_fits(env):
    loaded = policy.load_for(env, "nero_lift", None)
    assert loaded.act(jax.jit(env.reset)(jax.random.PRNGKey(0)).obs).shape == (8,)
