"""Agents of a viewed environment: policies, controllers, and the user."""

import pathlib
from collections.abc import Callable, Mapping
from typing import Any

from mjx_nero.sim.quiet import State

import jax
import jax.numpy as jnp

from mjx_nero import control, files
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.learn import bundled, policy
from mjx_nero.learn.play import rollout
from mjx_nero.runs.checkpoints import POLICY, saved
from mjx_nero.tools.view import hand

SLIDERS = "joint sliders"
Make = Callable[[], rollout.Agent]


def known(env: ManipulationEnv, env_name: str, policies: list[pathlib.Path], preset: str = "default") -> dict[str, Make]:
    """Lists all agents by name, each with a function that makes it: policies, controllers, sliders, the user's hand."""
    found: dict[str, Make] = {}
    shipped = bundled.shipped(env_name, preset)
    for path in [*policies, *([shipped] if shipped.is_file() else [])]:
        name = f"policy {path.stem}" if path == shipped else f"policy {path}"
        found[name] = lambda path=path: of_policy(policy.load_for(env, env_name, path))  # type: ignore[misc]
    able: dict[str, Mapping[str, Any]] = dict(env.cfg.controllers)
    if not able and env.cfg.scene.goal == "frame":  # a commanded pose is all that a follower needs
        able["ik"] = {}
        if (env.cfg.robot.xml.parent / "rmpflow").is_dir():
            able["rmpflow"] = {}
    for name, fields in able.items():
        found[name] = lambda name=name, fields=fields: of_controller(  # type: ignore[misc]
            env, control.make(name, env.cfg.robot, env.dt, fields, env.cfg.scene.robots)
        )
    found[SLIDERS] = lambda: of_targets(env)
    found[hand.NAME] = lambda: hand.agent(env)
    found["zero"] = lambda: _always(lambda key, n: jnp.tile(jnp.asarray(env.home_action), (n, 1)))
    found["random"] = lambda: _always(lambda key, n: jax.random.uniform(key, (n, env.action_size), minval=-1, maxval=1))
    return found


def of_policy(trained: policy.Policy) -> rollout.Agent:
    """Makes a deterministic agent of a policy."""
    return rollout.policy_agent(lambda params, obs, key: trained.act(obs))


def of_controller(env: ManipulationEnv, controller: control.Controller) -> rollout.Agent:
    """Makes an agent of a controller in any environment, by inverting its drive targets into actions."""
    return rollout.through_actions(env, rollout.controller_agent(env, controller))


def of_targets(env: ManipulationEnv) -> rollout.Agent:
    """Makes an agent whose parameters are the drives' position targets [joints]."""

    def act(targets, memory, state, key):
        wanted = jnp.broadcast_to(targets, (state.done.shape[0], *targets.shape))
        return env.actions.invert(wanted, _joint_pos(env, state), wanted), memory

    return rollout.Agent(act, init=lambda state: ())


def _joint_pos(env: ManipulationEnv, state: State) -> jax.Array:
    """Returns the joint positions of each environment [n, joints]."""
    return jax.vmap(lambda each: env.view(each).joint_pos)(state)


def _always(draw: Callable) -> rollout.Agent:
    return rollout.Agent(lambda params, memory, state, key: (draw(key, state.done.shape[0]), memory), init=lambda state: ())


def newest(run: pathlib.Path) -> pathlib.Path | None:
    """Returns the newest policy or checkpoint in a run's folder; None if there is none."""
    last = files.inside(run, POLICY)
    found = [*([last] if last.is_file() else []), *saved(run)]
    return max(found, key=lambda path: (path.stat().st_mtime, path.name), default=None)
