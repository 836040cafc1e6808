"""Plays and measures a policy, a controller, the zero agent or the random agent."""

import dataclasses
import pathlib
import time
from collections.abc import Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero import config, control
from mjx_nero.config import flag
from mjx_nero.config.bounds import Bounds, OneOf, Seed
from mjx_nero.envs import registry
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import EnvCfg, for_controllers
from mjx_nero.errors import UserError
from mjx_nero.learn import policy
from mjx_nero.learn.play import rollout
from mjx_nero.mdp import metrics
from mjx_nero.sim.physics import warp_available

AGENTS = ("policy", "zero", "random")
EXPERT = "expert"  # the first of the controllers that can do a task
BACKENDS = ("auto", "mjx", "mujoco")


def agent(cfg: "EvalCfg", env: ManipulationEnv) -> tuple[rollout.Act, Any]:
    """An agent's act function and its parameters: ``policy`` is deterministic, ``random`` uniform in +-1, ``zero`` stays home."""
    if cfg.agent in (None, "policy"):
        trained = policy.load_for(env, cfg.env_name, cfg.policy, cfg.robot, cfg.any_robot, cfg.preset)
        return lambda params, obs, key: trained.act(obs), None

    # Where actions are drive targets, staying home means home's; random ones go as far about it as a policy's would.
    home = jnp.asarray(env.home_action)

    def act(params, obs, key):
        shape = (obs["state"].shape[0], env.action_size)
        still = jnp.broadcast_to(home, shape)
        return still if cfg.agent == "zero" else still + jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)

    return act, None


def controller(name: str, env: ManipulationEnv, env_name: str, fields: Mapping[str, Any] | None = None) -> control.Controller:
    """A controller that can do the environment's task.

    Raises:
        UserError: it cannot, or a field of its config is wrong.
    """
    able = env.cfg.controllers
    if not able:
        raise UserError(f"{env_name} has no controller, only policies")
    if name not in able:
        raise UserError(f"controller {name!r} cannot do {env_name}: choose one of {', '.join(able)}")
    return control.make(name, env.cfg.robot, env.dt, {**able[name], **(fields or {})})


@dataclasses.dataclass(frozen=True)
class EvalCfg:
    """What to play.

    Attributes:
        robot: another than the environment's own, by name or folder.
        agent: who acts (default: the policy, else the task's controller).
        policy: policy file (default: the bundled one of the environment).
        any_robot: play a policy though it was trained for another model of the robot.
        controller: instead of an agent: one of the task's controllers, or expert, the first of them.
        episodes: played side by side.
        backend: mjx, or mujoco: the C library on the CPU; auto: what impl says.
        impl: one of ``physics.impls()``.
        record: of how many of the episodes every step is kept, for a video, say.
        env_fields, control_fields: of the environment's and the controller's config by dotted name.
    """

    env_name: str
    preset: str = flag("default")
    robot: str | None = flag(None)
    agent: Annotated[str, OneOf(*AGENTS)] | None = flag(None)
    policy: pathlib.Path | None = flag(None)
    any_robot: bool = flag(False)
    controller: str | None = flag(None)
    episodes: Annotated[int, Bounds(1, 1_000_000)] = flag(64)
    seed: Seed = flag(1)
    backend: Annotated[str, OneOf(*BACKENDS)] = flag("auto")
    impl: str = flag("auto")
    record: int = 0
    env_fields: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    control_fields: Mapping[str, Any] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        if self.controller and (self.agent or self.policy):
            raise UserError("one can play: give --controller, or --agent or --policy")
        if self.control_fields and (self.agent or self.policy):
            raise UserError("--control.* needs --controller")


@dataclasses.dataclass(frozen=True)
class Played:
    """Episodes, where they were played, and their figures (plain JSON)."""

    env: ManipulationEnv
    episodes: rollout.Episodes
    result: dict[str, Any]


def _controller_name(cfg: EvalCfg, env_cfg: EnvCfg) -> str | None:
    """The controller that plays; None: an agent does."""
    usual = next(iter(env_cfg.controllers), None)
    if cfg.controller:
        return (usual or EXPERT) if cfg.controller == EXPERT else cfg.controller
    return None if cfg.agent or cfg.policy or policy.shipped(cfg.env_name, cfg.preset).exists() else usual


def play(cfg: EvalCfg) -> Played:
    """Plays episodes side by side.

    Raises:
        UserError: unknown names or fields, a policy that does not fit.
    """
    env_cfg = registry.env_cfg(cfg.env_name, cfg.preset, cfg.robot).uncorrupted()
    env_cfg = config.override(env_cfg, cfg.env_fields)
    name = _controller_name(cfg, env_cfg)
    env_cfg = for_controllers(env_cfg) if name else env_cfg
    env_cfg = dataclasses.replace(env_cfg, metrics={**metrics.calmness(len(env_cfg.robot.arm.joints)), **env_cfg.metrics})
    env = ManipulationEnv(env_cfg, impl=_impl(cfg.backend, cfg.impl), num_envs=cfg.episodes)
    if cfg.control_fields and not name:
        raise UserError("--control.* needs --controller")
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
    if all(term.time_out for term in env_cfg.terminations.values()):
        del result["dropped_rate"]  # nothing can be
    if steering:
        result |= tracking(episodes.distance, round(env_cfg.success.hold_s / env.dt))
        if not env_cfg.success.follows:
            del result["settled_error_mean"], result["settled_error_max"]
        result["warning"] = steering.warning(episodes.memory)
    return Played(env, episodes, result)


def _impl(backend: str, impl: str) -> str:
    """The physics that a backend stands for; ``impl`` chooses among MJX's own."""
    native = backend == "mujoco"
    if backend != "auto" and impl != "auto" and native != (impl == "native"):
        raise UserError(f"--backend {backend} cannot play with --impl {impl}: give one of them")
    if impl == "auto" and backend != "auto":
        return "native" if native else "warp" if warp_available() else "jax"
    return impl


def tracking(distance: np.ndarray, last: int) -> dict[str, float]:
    """Distances to the goal over the last ``last`` steps, and over the second half of the episodes, when all has settled [m].

    Args:
        distance: [steps, episodes], of ``Episodes``.
    """
    half = distance[len(distance) // 2 :]
    return {
        "position_error_mean": float(distance[-last:].mean()),
        "settled_error_mean": float(half.mean()),
        "settled_error_max": float(half.max()),
    }
