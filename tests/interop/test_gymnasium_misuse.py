"""Misuse of the Gymnasium environments: an error of Gymnasium's own, or one line; what is no misuse goes on."""

import copy
import dataclasses
import pickle

import cloudpickle
import gymnasium
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium import error

import mjx_nero
from mjx_nero.interop.gymnasium import Env, VectorEnv
from mjx_nero.mdp.terms import CommandTerm
from mjx_nero.types import UserError

N = 3
NAN, INF = float("nan"), float("inf")


@pytest.fixture(scope="module")
def reach():
    return mjx_nero.make("nero_reach", impl="native", num_envs=N, episode_length_s=1.0)


@pytest.fixture(scope="module", params=[Env, VectorEnv], ids=["one", "many"])
def started(request, reach):
    """An environment of either kind, in its first episode, and the shape of its actions."""
    made = Env(reach) if request.param is Env else VectorEnv(reach, N)
    made.reset(seed=0)
    return made, made.action_space.shape


def refused(call, *kinds):
    with pytest.raises(kinds) as found:
        call()
    assert str(found.value).isprintable() and 10 < len(str(found.value)) < 500
    return str(found.value)


WRONG = [None, {}, {"a": 1}, "left", b"left", [], [[1.0], [1.0, 2.0]], ["x"] * 7, [None] * 7, [[NAN] * 7], object(), 3, NAN]
WRONG += [np.datetime64("2024-01-01"), np.zeros(7, complex), np.array(["1"] * 7), np.full(7, None), [10**400] * 7]
NOT_FINITE = [NAN, INF, -INF, 1e39, -1e300]


def test_actions_that_are_none(started):
    env, shape = started
    for wrong in WRONG:
        refused(lambda wrong=wrong: env.step(wrong), error.InvalidAction)
    for kind in (complex, object, str, "datetime64[s]", np.void):
        given = np.zeros(shape).astype(kind) if kind is not object else np.full(shape, None)
        assert "take numbers" in refused(lambda given=given: env.step(given), error.InvalidAction)
    for value in NOT_FINITE:
        one = np.zeros(shape)
        one.flat[-1] = value
        for given in (one, one.tolist(), np.full(shape, value)):
            refused(lambda given=given: env.step(given), error.InvalidAction)
    for given in (np.zeros(shape, bool), np.zeros(shape, np.int8), np.zeros(shape).tolist(), jnp.ones(shape, jnp.bfloat16)):
        assert np.isfinite(env.step(given)[0]).all()


def test_what_is_not_finite_on_the_device_ends_the_episode(started):
    """The host does not wait to look at it."""
    env, shape = started
    env.reset(seed=0)
    obs, reward, terminated, truncated, info = env.step(jnp.full(shape, NAN))
    assert np.all(terminated) and not np.any(truncated) and np.isfinite(obs).all() and np.isfinite(reward).all()
    assert np.all(info.get("final_info", info)["nan"] == 1)
    env.reset(seed=0)


def test_torch_actions_that_are_none(started):
    torch = pytest.importorskip("torch", reason="the extra torch is not installed")
    env, shape = started
    for kind in (torch.complex64, torch.float32):
        given = torch.zeros(shape, dtype=kind, device="cpu" if kind.is_complex else "meta")
        refused(lambda given=given: env.step(given), error.InvalidAction)
    refused(lambda: env.step(torch.zeros(5)), error.InvalidAction)
    for given in (torch.zeros(shape, requires_grad=True), torch.zeros(shape, dtype=torch.int64), torch.zeros(shape).double()):
        assert np.isfinite(env.step(given)[0]).all()


def test_resets_that_are_none(started):
    env, _ = started
    for seed in ([1, 2], (), -1, 2**32, 2**80, "x", 0.5, NAN, True, {}, np.arange(3), object()):
        assert refused(lambda seed=seed: env.reset(seed=seed), error.Error).startswith("seed ")
    for options in ({"reset_mask": [True]}, {3: 4}, 5, [1], "x", True):
        refused(lambda options=options: env.reset(options=options), error.Error)
    for seed in (0, 2**32 - 1, np.int64(3), np.uint8(3)):
        env.reset(seed=seed, options={})


@pytest.mark.parametrize("kind", [Env, VectorEnv])
def test_after_close(reach, kind):
    env = kind(reach) if kind is Env else kind(reach, N)
    for call in (lambda: env.step(env.action_space.sample()), env.render):
        refused(call, error.ResetNeeded)
    env.close(), env.close()
    for call in (env.reset, lambda: env.step(env.action_space.sample()), env.render):
        assert "after close" in refused(call, error.ClosedEnvironmentError)


ARGUMENTS = {
    "env": [None, 3, "nero", "", "x" * 1000, [], object(), Env, "nero_reach\n"],
    "num_envs": [0, -1, 0.5, "x", None, NAN, INF, 2**30, 10**400, [3], True],
    "arrays": [None, 3, "cupy", [], "Numpy"],
    "group": [3, [], "pixels", {}, b"state", ("state",)],
    "render_mode": ["human", 3, [], "rgb_array_list", True],
    "num_rendered": [0, -1, None, "x", NAN, 10**400],
    "impl": ["x", "", "warp\n"],
    "preset": ["x", ""],
    "robot": ["x", "/dev/zero", "", "../" * 50, "nero\0"],
    "sim.dt": [0, -1, NAN, INF, 1e-12, "x", None, [1]],
    "episode_length_s": [0, 1e25, NAN, "x", -1, []],
    "no_field": [1],
}


@pytest.mark.parametrize("name", ARGUMENTS)
def test_arguments_that_are_none(name):
    """One line, before anything is made; those of one environment likewise."""
    for value in ARGUMENTS[name]:
        given = {"env": "nero_reach", "num_envs": 2, "impl": "native", name: value}
        refused(lambda given=given: VectorEnv(**given), UserError)
        if name not in ("num_envs", "arrays", "num_rendered"):
            del given["num_envs"]
            refused(lambda given=given: Env(**given), UserError)


def test_fields_of_one_that_is_made(reach):
    assert "pass them to mjx_nero.make" in refused(lambda: VectorEnv(reach, N, **{"sim.dt": 0.01}), UserError)


def test_pickles_hold_the_arguments(reach):
    """What comes out is the same environment, before its first reset."""
    made = gymnasium.make("mjx_nero/nero_reach-v0", impl="native", robot=mjx_nero.env_cfg("nero_reach").robot)
    made.reset(seed=0)
    many = VectorEnv(reach, N, group=None)
    for env in (made, Env("nero_reach", impl="native", episode_length_s=1.0), many):
        for copied in (pickle.loads(pickle.dumps(env)), cloudpickle.loads(cloudpickle.dumps(env)), copy.deepcopy(env)):
            assert copied.observation_space == env.observation_space and copied.action_space == env.action_space
            assert copied.unwrapped.env.cfg == env.unwrapped.env.cfg and copied.unwrapped.env.impl == "native"
            refused(lambda copied=copied: copied.unwrapped.step(copied.action_space.sample()), error.ResetNeeded)
    assert pickle.loads(pickle.dumps(many)).num_envs == N
    own = dataclasses.replace(reach.cfg, command=CommandTerm(lambda key: jnp.zeros(3)))
    with pytest.raises((pickle.PicklingError, AttributeError), match="lambda|local"):  # pickle's own words
        pickle.dumps(Env(mjx_nero.ManipulationEnv(own, "native")))


def test_stable_baselines_likewise(reach):
    pytest.importorskip("stable_baselines3", reason="the extra torch is not installed")
    from mjx_nero.interop.stable_baselines3 import VecEnv

    for wrong in ({"arrays": "jax"}, {"num_envs": 0}, {"env": 3}, {"group": "x"}):
        refused(lambda wrong=wrong: VecEnv(**{"env": reach, "num_envs": N, **wrong}), UserError)
    env = VecEnv(reach, N, group=None)
    refused(env.step_wait, error.NoAsyncCallError)
    for seed in (-1, 2**32, "x", [0]):
        refused(lambda seed=seed: env.seed(seed), error.Error)
    refused(lambda: env.step(np.zeros((N, 7))), error.ResetNeeded)
    env.seed(3), env.reset()
    refused(lambda: env.step(np.full((N, 7), NAN)), error.InvalidAction)
    for _ in range(30):
        *_, infos = env.step(np.zeros((N, 7)))
    assert {name: x.shape for name, x in infos[0]["terminal_observation"].items()} == {"state": (47,)}
    assert pickle.loads(pickle.dumps(env)).reset()["state"].shape == (N, 47)
    env.close(), env.close()
    refused(env.reset, error.ClosedEnvironmentError)
