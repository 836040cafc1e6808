"""Learners by name: one that is not the package's trains, is evaluated, played and measured by the same commands."""

import dataclasses
import json

import jax
import jax.numpy as jnp
import pytest
from flax import struct
from kinematic import Kinematic

from mjx_nero import ManipulationEnv, UserError
from mjx_nero.config.registry import Registry
from mjx_nero.learn import learner
from mjx_nero.learn.learner import Kind


@dataclasses.dataclass(frozen=True)
class SearchCfg:
    """Random search for the best constant action."""

    num_envs: int = 0
    num_timesteps: int = 0
    unroll_length: int = 4
    step: float = 0.3


@struct.dataclass
class SearchState:
    action: jax.Array
    reward: jax.Array
    env_state: object
    key: jax.Array
    iteration: jax.Array


class Search:
    def __init__(self, env, cfg, num_devices):
        self.env, self.cfg, self.num_envs, self.num_devices, self.divisor = env, cfg, cfg.num_envs, num_devices, 1
        self.steps_per_iteration = cfg.num_envs * cfg.unroll_length

    def init(self, key, bank=None):
        k_env, key = jax.random.split(key)
        action = jnp.zeros(self.env.action_size)
        env_state = self.env.reset(jax.random.split(k_env, self.num_envs), bank)
        return SearchState(action, jnp.array(-jnp.inf), env_state, key, jnp.zeros((), jnp.int32))

    def place(self, state):
        return state

    def run(self, state, iterations):
        def iterate(state, _):
            key, k_try = jax.random.split(state.key)
            action = state.action + self.cfg.step * jax.random.normal(k_try, state.action.shape)
            act = jnp.broadcast_to(action, (self.num_envs, action.size))

            def step(env_state, _):
                env_state = self.env.step(env_state, act)
                return env_state, env_state.reward

            env_state, rewards = jax.lax.scan(step, state.env_state, length=self.cfg.unroll_length)
            better = rewards.mean() > state.reward
            best = jnp.where(better, action, state.action), jnp.where(better, rewards.mean(), state.reward)
            return SearchState(*best, env_state, key, state.iteration + 1), rewards.sum()

        state, rewards = jax.lax.scan(iterate, state, length=iterations)
        return state, {"sum/reward": rewards.mean(), "best": state.reward}

    def policy(self, state):
        return {"action": state.action}

    def with_policy(self, state, params):
        return dataclasses.replace(state, action=params["action"])

    def slower(self, state):
        return state

    def act(self, params, obs):
        return jnp.broadcast_to(params["action"], obs["state"].shape[:-1] + params["action"].shape)

    def describe(self):
        return {}

    def footprint(self):
        return 0.0, 4.0


def policy(meta):
    act = Search.act
    return {"action": jax.ShapeDtypeStruct((meta["action_size"],), jnp.float32)}, lambda params, obs: act(None, params, obs)


@pytest.fixture
def search(monkeypatch):
    others = {name: kind for name, kind in learner.KINDS.items() if name != "search"}  # a page of the guides has one, too
    monkeypatch.setattr(learner, "KINDS", Registry("learner", others))
    learner.KINDS.add("search", Kind(make=Search, presets={"default": SearchCfg()}, policy=policy))
    monkeypatch.setattr(ManipulationEnv, "physics", Kinematic())


SIZES = ["--learner", "search", "--num-envs", 8, "--num-timesteps", 128, "--env.episode_length_s", 0.2]


def test_another_learner_trains_is_resumed_played_and_measured(search, call, tmp_path):
    code, out, err = call("train", *SIZES, "--search.step", 0.1, "--no-video", "--out", "run")
    assert code == 0 and "128 env steps" in out, err
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["learner"] == "search" and config["hyperparameters"]["step"] == 0.1
    rows = [json.loads(line) for line in (tmp_path / "run" / "metrics.jsonl").read_text().splitlines()]
    best = [row["search/best"] for row in rows if "search/best" in row]
    assert best == sorted(best) and best[-1] > -1e9

    code, out, _ = call(
        "eval", "--policy", "run/policy.safetensors", "--episodes", 2, "--backend", "mujoco", "--env.episode_length_s", 0.2
    )
    assert code == 0 and "success rate" in out

    argv = ["--what", "ppo,learning", "--impl", "native", "--learner", "search", "--num-envs", 8, "--steps", 8, "--repeats", 1]
    code, _, err = call("benchmark", *argv, "--seeds", 1, "--num-timesteps", 64, "--json", "rows.json")
    assert code == 0, err
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert [(row["what"], row.get("learner", "")) for row in rows][0] == ("ppo", "search")
    assert rows[1]["env_steps"] == 64


def test_names_of_learners(search, call):
    with pytest.raises(UserError, match="there is already a learner 'search': choose another name"):
        learner.KINDS.add("search", learner.find("search"))
    with pytest.raises(
        UserError, match=r"unknown learner 'pop' \(did you mean 'ppo'\?\): choose one of ppo, clone, distill, pixels, search"
    ):
        learner.find("pop")
    code, _, err = call("train", "--learner", "search", "--ppo.num_epochs", 3)
    assert code == 2 and "--ppo.* is for --learner ppo, and this is search" in err
    code, out, _ = call("train", "--learner", "search", "--help")
    assert code == 0 and "--search.unroll_length 4" in out and "--ppo." not in out
