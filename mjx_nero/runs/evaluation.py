"""Plays and measures a policy, a controller, the zero agent or the random agent."""

import dataclasses
import time
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero import control
from mjx_nero.config import values
from mjx_nero.envs import things
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import EnvCfg, for_controllers
from mjx_nero.errors import UserError
from mjx_nero.learn import bundled, policy
from mjx_nero.learn.play import rollout
from mjx_nero.mdp import metrics
from mjx_nero.runs.evaluation_cfg import EXPERT, EvalCfg, controller_of
from mjx_nero.sim.physics import warp_available
from mjx_nero.tasks import registry


def agent(cfg: EvalCfg, env: ManipulationEnv) -> tuple[rollout.Act, Any]:
    """Returns an agent's act function and parameters.

    ``policy`` is deterministic, ``random`` uniform in +-1, and ``zero`` stays at home.
    """
    if cfg.agent in (None, "policy"):
        trained = policy.load_for(env, cfg.env_name, cfg.policy, cfg.robot, cfg.any_robot, cfg.preset)
        return lambda params, obs, key: trained.act(obs), None

    # If actions are drive targets, ``zero`` sends the home targets, and ``random`` spreads about them.
    def act(params, obs, key):
        shape = (obs["state"].shape[0], env.action_size)
        still = jnp.broadcast_to(env.home_action, shape)
        return still if cfg.agent == "zero" else still + jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)

    return act, None


def controller(name: str, env: ManipulationEnv, env_name: str, fields: Mapping[str, Any] | None = None) -> control.Controller:
    """Makes a controller that can do the environment's task.

    Raises:
        UserError: the controller cannot do the task, or a field of its config is wrong.
    """
    able = env.cfg.controllers
    if name not in able:
        names = ", ".join(["policy", EXPERT, *able]) if able else "policy, it has no expert"
        raise UserError(f"{values.short(name)} cannot play {env_name}: choose {'one of ' if able else ''}{names}")
    return control.make(name, env.cfg.robot, env.dt, {**able[name], **(fields or {})}, env.cfg.scene.robots)


@dataclasses.dataclass(frozen=True)
class Played:
    """The episodes, the environment that they were played in, and their figures (plain JSON)."""

    env: ManipulationEnv
    episodes: rollout.Episodes
    result: dict[str, Any]


def _controller_name(cfg: EvalCfg, env_cfg: EnvCfg) -> str | None:
    """Returns the name of the controller that plays, or None if an agent does."""
    if cfg.player:
        return controller_of(cfg.player, env_cfg.controllers)
    return None if cfg.policy or bundled.shipped(cfg.env_name, cfg.preset).exists() else next(iter(env_cfg.controllers), None)


def play(cfg: EvalCfg) -> Played:
    """Plays episodes side by side.

    Raises:
        UserError: a name or field is unknown, or a policy does not fit.
    """
    env_cfg = registry.env_cfg(cfg.env_name, cfg.preset, cfg.robot).uncorrupted()
    env_cfg = things.overridden(env_cfg, cfg.env_fields)
    name = _controller_name(cfg, env_cfg)
    env_cfg = for_controllers(env_cfg) if name else env_cfg
    env_cfg = dataclasses.replace(env_cfg, metrics={**metrics.calmness(len(env_cfg.robot.arm.joints)), **env_cfg.metrics})
    env = ManipulationEnv(env_cfg, impl=_impl(cfg.backend, cfg.impl), num_envs=cfg.episodes)
    if cfg.control_fields and not name:
        raise UserError("--control.* needs --agent with a controller's name")
    steering = controller(name, env, cfg.env_name, cfg.control_fields) if name else None
    act, params = (rollout.controller_agent(env, steering), None) if steering else agent(cfg, env)
    begun = time.perf_counter()
    episodes = rollout.runner(env, act, cfg.episodes, record=min(cfg.record, cfg.episodes))(params, cfg.seed)
    result = {
        "env": cfg.env_name,
        "preset": cfg.preset,
        **({"controller": name} if name else {"agent": cfg.agent or "policy"}),
        "backend": env.backend,
        "episodes": cfg.episodes,
        "seed": cfg.seed,
        **episodes.summary(),
        "seconds": round(time.perf_counter() - begun, 2),
    }
    if by_shape := _by_shape(env, episodes):
        result["success_by_shape"] = by_shape
    if all(term.time_out for term in env_cfg.terminations.values()):
        del result["dropped_rate"]  # nothing can be dropped
    if steering:
        result |= tracking(episodes.distance, round(env_cfg.success.hold_s / env.dt))
        if not env_cfg.success.follows:
            del result["settled_error_mean"], result["settled_error_max"]
        result["warning"] = steering.warning(episodes.memory)
    return Played(env, episodes, result)


def _by_shape(env: ManipulationEnv, episodes: rollout.Episodes) -> dict[str, list[float | None]]:
    """Returns, for objects with a bank of shapes, the success rate with each shape (None: no episode), and the number of its
    episodes."""
    out = {}
    for name, item in env.cfg.scene.objects.items():
        if (which := episodes.metrics.get(f"shape/{name}")) is None:
            continue
        for k, file in enumerate((item.file, *item.bank)):
            chosen = np.asarray(episodes.success)[np.round(which) == k]
            out[file] = [float(chosen.mean()) if len(chosen) else None, len(chosen)]
    return out


def _impl(backend: str, impl: str) -> str:
    """Returns the physics of a backend; ``impl`` chooses among MJX's own."""
    native = backend == "mujoco"
    if backend != "auto" and impl != "auto" and native != (impl == "native"):
        raise UserError(f"--backend {backend} cannot play with --impl {impl}: pass only one of them")
    if impl == "auto" and backend != "auto":
        return "native" if native else "warp" if warp_available() else "jax"
    return impl


def tracking(distance: np.ndarray, last: int) -> dict[str, float]:
    """Computes distances to the goal [m] over the last ``last`` steps, and over the second half, when the robot has settled.

    Args:
        distance: ``Episodes.distance`` [steps, episodes].
    """
    half = distance[len(distance) // 2 :]
    return {
        "position_error_mean": float(distance[-last:].mean()),
        "settled_error_mean": float(half.mean()),
        "settled_error_max": float(half.max()),
    }
