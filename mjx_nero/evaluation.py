"""Plays and measures a policy, the zero agent or the random agent."""

import dataclasses
import json
import os
import pathlib
import time
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

from mjx_nero import config, policy, registry, render, rollout
from mjx_nero.env import ManipulationEnv
from mjx_nero.types import UserError

AGENTS = ("policy", "zero", "random")
BACKENDS = ("auto", "mjx", "mujoco")


def agent(name: str, env: ManipulationEnv, env_name: str, path: pathlib.Path | None) -> tuple[rollout.Act, Any]:
    """An agent's act function and its parameters: ``policy`` is deterministic, ``random`` uniform in +-1, ``zero`` stays home."""
    if name == "policy":
        trained = policy.load_for(env, env_name, path)
        return lambda params, obs, key: trained.act(obs), None

    def act(params, obs, key):
        shape = (obs["state"].shape[0], env.action_size)
        return jnp.zeros(shape) if name == "zero" else jax.random.uniform(key, shape, minval=-1.0, maxval=1.0)

    return act, None


def evaluate(
    env_name: str,
    preset: str = "default",
    agent_name: str = "policy",
    policy_path: pathlib.Path | None = None,
    episodes: int = 64,
    seed: int = 1,
    backend: str = "auto",
    impl: str = "auto",
    video: pathlib.Path | None = None,
    out: pathlib.Path | None = None,
    overrides: dict[str, Any] | None = None,
) -> dict[str, Any]:
    """Plays ``episodes`` episodes side by side, prints the result, writes JSON and video where asked.

    Args:
        backend: ``mjx``, ``mujoco`` (the C library on the CPU), or ``auto``: mjx on an accelerator, mujoco else.
        out: JSON file.
        overrides: config fields by dotted name.

    Raises:
        UserError: unknown names, a policy that does not fit, files that cannot be written.
    """
    cfg = dataclasses.replace(registry.env_cfg(env_name, preset), corruption=False)
    cfg = config.override(cfg, overrides or {})
    if backend == "auto":
        backend = "mujoco" if jax.default_backend() == "cpu" else "mjx"
    env = ManipulationEnv(cfg, impl=impl if backend == "mjx" else "jax", num_envs=episodes)
    act, params = agent(agent_name, env, env_name, policy_path)
    for path in filter(None, (video, out)):
        _check_writable(path)
    runner = rollout.mjx_runner if backend == "mjx" else rollout.native_runner
    started = time.perf_counter()
    played = runner(env, act, episodes, record=min(3, episodes) if video else 0)(params, seed)
    seconds = time.perf_counter() - started
    result = {
        "env": env_name,
        "preset": preset,
        "agent": agent_name,
        "backend": f"mjx-{env.impl}" if backend == "mjx" else "mujoco",
        "episodes": episodes,
        "seed": seed,
        **played.summary(),
        "seconds": round(seconds, 2),
    }
    console = Console()
    console.print(table(result))
    if out:
        part = out.with_name(f".{out.name}.part")
        part.write_text(json.dumps(result, indent=2) + "\n")
        part.replace(out)
    if video:
        try:
            render.write_episodes(video, env.mj_model, played.qpos, played.goals, env.dt)
            console.print(f"video: {video}", highlight=False, soft_wrap=True)
        except UserError as error:
            console.print(str(error), highlight=False, soft_wrap=True)
    return result


def table(result: dict[str, Any]) -> Table:
    """The result for people."""
    low, high = result["success_rate_95"]
    grasp = result["time_to_grasp_mean"]
    title = f"{result['env']} · {result['agent']} · {result['backend']} · {result['episodes']} episodes"
    view = Table(title=title, show_header=False)
    view.add_row("success rate", f"{result['success_rate']:.1%}  (95% interval {low:.1%} to {high:.1%})")
    view.add_row(
        "final distance",
        f"{100 * result['final_distance_mean']:.2f} cm mean, {100 * result['final_distance_median']:.2f} cm median",
    )
    view.add_row("grasped", f"{result['grasp_rate']:.1%}" + (f", first after {grasp:.2f} s" if grasp is not None else ""))
    view.add_row("dropped", f"{result['dropped_rate']:.1%}")
    view.add_row("return", f"{result['return_mean']:.2f}")
    for name, value in result["return_by_term"].items():
        view.add_row(f"  {name}", f"{value:.3f}")
    view.add_row("NaN, overflows", f"{result['nan_count']}, {result['overflow_count']}")
    view.add_row("time", f"{result['seconds']:.1f} s, compilation included")
    return view


def _check_writable(path: pathlib.Path) -> None:
    if path.is_dir():
        raise UserError(f"{path} is a folder: give a file name")
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK):
        raise UserError(f"cannot write {path}: the folder {path.parent} does not exist or is not writable")
