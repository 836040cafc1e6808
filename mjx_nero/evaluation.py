"""Plays and measures a policy, a controller, the zero agent or the random agent."""

import dataclasses
import json
import pathlib
import sys
import time
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

from mjx_nero import config, control, policy, registry, render, rollout, run_folder
from mjx_nero.env import ManipulationEnv
from mjx_nero.physics import warp_available
from mjx_nero.types import UserError

AGENTS = ("policy", "zero", "random")
BACKENDS = ("auto", "mjx", "mujoco")


def agent(name: str, env: ManipulationEnv, env_name: str, path: pathlib.Path | None) -> tuple[rollout.Act, Any]:
    """An agent's act function and its parameters: ``policy`` is deterministic, ``random`` uniform in +-1, ``zero`` stays home."""
    if name == "policy":
        trained = policy.load_for(env, env_name, path)
        return lambda params, obs, key: trained.act(obs), None

    # Where actions are drive targets, staying home means home's; random ones go as far about it as a policy's would.
    home = jnp.array(env.cfg.robot.home) if env.cfg.action.absolute else jnp.zeros(env.action_size)

    def act(params, obs, key):
        shape = (obs["state"].shape[0], env.action_size)
        still = jnp.broadcast_to(home, shape)
        return still if name == "zero" else still + jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)

    return act, None


def controller(name: str, env: ManipulationEnv, env_name: str, overrides: dict[str, Any] | None = None) -> control.Controller:
    """A controller that can do the environment's task.

    Raises:
        UserError: it cannot, or a field of its config is wrong.
    """
    able = env.cfg.controllers
    if not able:
        raise UserError(f"{env_name} has no controller, only policies")
    if name not in able:
        raise UserError(f"controller {name!r} cannot do {env_name}: choose one of {', '.join(able)}")
    return control.make(name, env.cfg.robot, env.dt, {**able[name], **(overrides or {})})


def evaluate(
    env_name: str,
    preset: str = "default",
    robot: str | None = None,
    agent_name: str | None = None,
    policy_path: pathlib.Path | None = None,
    episodes: int = 64,
    seed: int = 1,
    backend: str = "auto",
    impl: str = "auto",
    video: pathlib.Path | None = None,
    out: pathlib.Path | None = None,
    overrides: dict[str, Any] | None = None,
    controller_name: str | None = None,
    control_overrides: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Plays ``episodes`` episodes side by side, prints the result, writes JSON and video where asked.

    Args:
        robot: another than the environment's own, by name or folder.
        agent_name: one of ``AGENTS``; None: the controller, where one is named or the task has its own and no policy is given.
        backend: ``mjx``, ``mujoco`` (the C library on the CPU), or ``auto``: what ``impl`` says.
        impl: one of ``physics.IMPLS``.
        out: JSON file.
        overrides: config fields by dotted name.
        controller_name: one of the task's.
        control_overrides: fields of the controller's config by dotted name.

    Raises:
        UserError: unknown names, agent and controller together, a policy that does not fit, files that cannot be written.
    """
    cfg = dataclasses.replace(registry.env_cfg(env_name, preset, robot), corruption=False)
    cfg = config.override(cfg, overrides or {})
    env = ManipulationEnv(cfg, impl=_impl(backend, impl), num_envs=episodes)
    if controller_name and (agent_name or policy_path):
        raise UserError("one can play: give --controller, or --agent or --policy")
    if not (controller_name or agent_name or policy_path):
        controller_name = next(iter(cfg.controllers), None)
    act: rollout.Act | rollout.Agent
    steering, params = None, None
    if controller_name:
        steering = controller(controller_name, env, env_name, control_overrides)
        act = rollout.controller_agent(env, steering)
    elif control_overrides:
        raise UserError("--control.* needs --controller")
    else:
        act, params = agent(agent_name or "policy", env, env_name, policy_path)
    for path in filter(None, (video, out)):
        run_folder.check_writable(path)
    started = time.perf_counter()
    played = rollout.runner(env, act, episodes, record=min(3, episodes) if video else 0)(params, seed)
    seconds = time.perf_counter() - started
    result = {
        "env": env_name,
        "preset": preset,
        **({"controller": controller_name} if controller_name else {"agent": agent_name or "policy"}),
        "backend": env.backend,
        "episodes": episodes,
        "seed": seed,
        **played.summary(),
        "seconds": round(seconds, 2),
    }
    if not cfg.scene.cube:
        for name in ("grasp_rate", "time_to_grasp_mean", "dropped_rate"):
            del result[name]
    if steering:
        result |= tracking(played, round(cfg.success.hold_s / env.dt))
        if cfg.scene.cube:  # the way of a cube is no error
            del result["settled_error_mean"], result["settled_error_max"]
        result["warning"] = steering.warning(played.memory)
    console = Console()
    console.print(table(result))
    if result.get("warning"):
        print(f"warning: {result['warning']}", file=sys.stderr)
    if out:
        with run_folder.whole(out) as part:
            part.write_text(json.dumps(result, indent=2) + "\n")
    if video:
        try:
            render.write_episodes(video, env.mj_model, played.qpos, played.goals, env.dt)
            console.print(f"video: {video}", highlight=False, soft_wrap=True)
        except UserError as error:
            console.print(str(error), highlight=False, soft_wrap=True)
    return result


def _impl(backend: str, impl: str) -> str:
    """The physics that a backend stands for; ``impl`` chooses among MJX's own."""
    native = backend == "mujoco"
    if backend != "auto" and impl != "auto" and native != (impl == "native"):
        raise UserError(f"--backend {backend} cannot play with --impl {impl}: give one of them")
    if impl == "auto" and backend != "auto":
        return "native" if native else "warp" if warp_available() else "jax"
    return impl


def tracking(played: rollout.Episodes, last: int) -> dict[str, float]:
    """Distances to the goal [m]: over the last ``last`` steps, and over the second half of the episodes, when all has settled."""
    half = played.distance[len(played.distance) // 2 :]
    return {
        "position_error_mean": float(played.distance[-last:].mean()),
        "settled_error_mean": float(half.mean()),
        "settled_error_max": float(half.max()),
    }


def table(result: dict[str, Any]) -> Table:
    """The result for people."""
    low, high = result["success_rate_95"]
    who = result.get("controller") or result["agent"]
    title = f"{result['env']} · {who} · {result['backend']} · {result['episodes']} episodes"
    view = Table(title=title, show_header=False)
    view.add_row("success rate", f"{result['success_rate']:.1%}  (95% interval {low:.1%} to {high:.1%})")
    view.add_row(
        "final distance",
        f"{100 * result['final_distance_mean']:.2f} cm mean, {100 * result['final_distance_median']:.2f} cm median",
    )
    if "settled_error_max" in result:
        view.add_row(
            "second half",
            f"{100 * result['settled_error_mean']:.2f} cm mean, {100 * result['settled_error_max']:.2f} cm at most",
        )
    if "grasp_rate" in result:
        grasp = result["time_to_grasp_mean"]
        view.add_row("grasped", f"{result['grasp_rate']:.1%}" + (f", first after {grasp:.2f} s" if grasp is not None else ""))
        view.add_row("dropped", f"{result['dropped_rate']:.1%}")
    view.add_row("return", f"{result['return_mean']:.2f}")
    for name, value in result["return_by_term"].items():
        view.add_row(f"  {name}", f"{value:.3f}")
    view.add_row("NaN, overflows", f"{result['nan_count']}, {result['overflow_count']}")
    view.add_row("time", f"{result['seconds']:.1f} s, compilation included")
    return view
