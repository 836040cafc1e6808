"""Throughput: python -m mjx_nero.benchmark --env nero_lift --num-envs 1024,4096,16384 --impl warp,jax"""

import argparse
import contextlib
import dataclasses
import json
import pathlib
import statistics
import time
from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from rich.console import Console
from rich.table import Table

from mjx_nero import cli, ppo, registry, wrappers
from mjx_nero.env import ManipulationEnv
from mjx_nero.physics import IMPLS, resolve_impl
from mjx_nero.types import UserError


def measure_step(env: ManipulationEnv, steps: int, repeats: int) -> dict[str, Any]:
    """Random actions (standard normal) in the auto-resetting training environment, ``steps`` control steps a compiled call."""
    batch = wrappers.for_training(env)
    begun = time.perf_counter()
    state = jax.jit(batch.reset)(jax.random.split(jax.random.PRNGKey(0), env.num_envs))

    def roll(state, key):
        def step(state, key):
            state = batch.step(state, jax.random.normal(key, (env.num_envs, env.action_size)))
            return state, (jnp.sum(state.metrics["nan"]), jnp.sum(state.metrics["overflow"]))

        state, counts = jax.lax.scan(step, state, jax.random.split(key, steps))
        return state, jax.tree.map(jnp.sum, counts)

    compiled = jax.jit(roll, donate_argnums=0).lower(state, jax.random.PRNGKey(1)).compile()
    state, counts = jax.block_until_ready(compiled(state, jax.random.PRNGKey(1)))  # also loads the backend's own kernels
    compile_s = time.perf_counter() - begun
    rates, nans, overflows = [], 0.0, 0.0
    for i in range(repeats):
        begun = time.perf_counter()
        state, counts = jax.block_until_ready(compiled(state, jax.random.PRNGKey(2 + i)))
        rates.append(env.num_envs * steps / (time.perf_counter() - begun))
        nans, overflows = nans + float(counts[0]), overflows + float(counts[1])
    return _row(env, "step", rates, compile_s, compiled, nans, overflows)


def measure_ppo(env: ManipulationEnv, preset: str, iterations: int, repeats: int) -> dict[str, Any]:
    """PPO end to end: rollouts, updates, auto-resets; ``iterations`` a compiled call."""
    learner = ppo.Learner(wrappers.for_training(env), dataclasses.replace(ppo.preset(preset), num_envs=env.num_envs))
    begun = time.perf_counter()
    state = jax.jit(learner.init)(jax.random.PRNGKey(0))
    compiled = jax.jit(learner.run, static_argnums=1, donate_argnums=0).lower(state, iterations).compile()
    state, metrics = jax.block_until_ready(compiled(state))
    compile_s = time.perf_counter() - begun
    rates, nans, overflows = [], 0.0, 0.0
    for _ in range(repeats):
        begun = time.perf_counter()
        state, metrics = jax.block_until_ready(compiled(state))
        rates.append(iterations * learner.steps_per_iteration / (time.perf_counter() - begun))
        nans += float(metrics["sum/nan"]) * iterations
        overflows += float(metrics["sum/overflow"]) * iterations
    return _row(env, "ppo", rates, compile_s, compiled, nans, overflows)


def _row(
    env: ManipulationEnv, what: str, rates: list[float], compile_s: float, compiled, nans: float, overflows: float
) -> dict[str, Any]:
    memory = None
    with contextlib.suppress(Exception):  # not every backend tells
        use = compiled.memory_analysis()
        memory = use.argument_size_in_bytes + use.output_size_in_bytes + use.temp_size_in_bytes - use.alias_size_in_bytes
    rate = statistics.median(rates)
    return {
        "what": what,
        "impl": env.impl,
        "num_envs": env.num_envs,
        "env_steps_per_s": round(rate),
        "env_steps_per_s_min": round(min(rates)),
        "env_steps_per_s_max": round(max(rates)),
        "physics_steps_per_s": round(rate * env.cfg.sim.decimation),
        "compile_s": round(compile_s, 1),
        "memory_mb": None if memory is None else round(memory / 2**20),
        "nan_count": round(nans),
        "overflow_count": round(overflows),
        "device": jax.devices()[0].device_kind,
    }


def _list(values: str, what: str, valid: Sequence[str]) -> list[str]:
    chosen = [v.strip() for v in values.split(",") if v.strip()]
    unknown = [v for v in chosen if v not in valid]
    if unknown or not chosen:
        raise UserError(f"unknown {what} {', '.join(unknown) or '(none)'}: choose from {', '.join(valid)}")
    return chosen


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = cli.Parser(prog="python -m mjx_nero.benchmark", description="Measures env steps per second.")
    parser.add_argument("--env", default="nero_lift", help="environment (default: %(default)s)")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--num-envs", default="1024,4096,16384", help="list (default: %(default)s)")
    parser.add_argument("--impl", default="auto", help="list of auto, jax, warp (default: %(default)s)")
    parser.add_argument("--what", default="step", help="list of step (random actions) and ppo (training) (default: %(default)s)")
    parser.add_argument("--steps", type=cli.positive, default=100, help="control steps a measurement (default: %(default)s)")
    parser.add_argument(
        "--repeats", type=cli.positive, default=5, help="measurements, of which the median counts (default: %(default)s)"
    )
    parser.add_argument("--json", type=pathlib.Path, help="write the rows as JSON")
    args, _ = parser.parse(argv)
    try:
        sizes = [cli.positive(n) for n in args.num_envs.split(",")]
    except argparse.ArgumentTypeError as error:
        raise UserError(f"--num-envs: {error}") from None
    impls, whats = _list(args.impl, "impl", IMPLS), _list(args.what, "what", ("step", "ppo"))
    if args.json and not args.json.parent.is_dir():
        raise UserError(f"cannot write {args.json}: the folder {args.json.parent} does not exist")
    cli.setup_jax()
    cfg = registry.env_cfg(args.env, args.preset)
    impls = [resolve_impl(impl) for impl in impls]
    rows = []
    for impl in impls:
        for what in whats:
            for n in sizes:
                env = ManipulationEnv(cfg, impl=impl, num_envs=n)
                if what == "step":
                    row = measure_step(env, args.steps, args.repeats)
                else:
                    row = measure_ppo(env, args.preset, max(1, args.steps // 24), args.repeats)
                rows.append({"env": args.env, **row})
    view = Table(title=f"{args.env} on {rows[0]['device']}")
    names = (
        "what",
        "impl",
        "num_envs",
        "env_steps_per_s",
        "physics_steps_per_s",
        "compile_s",
        "memory_mb",
        "nan_count",
        "overflow_count",
    )
    for name in names:
        view.add_column(name, justify="right")
    for row in rows:
        view.add_row(*(f"{row[n]:,}" if isinstance(row[n], int) else str(row[n]) for n in names))
    Console().print(view)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    cli.run(main)
