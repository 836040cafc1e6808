"""Throughput: python -m mjx_nero.benchmark --env nero_lift --num-envs 1024,4096,16384 --impl warp,jax

With --what control: whole episodes of the task's controller and the physics in one program.
With --what ik: inverse kinematics of the environment's robot, beside the package mink where it is installed.
"""

import argparse
import contextlib
import dataclasses
import json
import pathlib
import statistics
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from rich.console import Console
from rich.table import Table

from mjx_nero import cli, evaluation, ppo, registry, rollout, run_folder, scene, training, wrappers
from mjx_nero.control import ik
from mjx_nero.env import ManipulationEnv
from mjx_nero.physics import IMPLS, resolve_impl
from mjx_nero.robots import RobotCfg
from mjx_nero.types import UserError

_ENV_COLUMNS: tuple[str, ...] = ("what", "impl", "num_envs", "env_steps_per_s", "physics_steps_per_s", "compile_s", "memory_mb")
_ENV_COLUMNS += ("nan_count", "overflow_count")
_IK_COLUMNS = ("solver", "batch", "ms_per_batch", "solves_per_s", "success", "error_mm", "error_mrad", "compile_s")
_MINK_POSES, _MINK_ITERATIONS = 100, 100


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
    seconds, counts = _timed(compiled, state, [jax.random.PRNGKey(2 + i) for i in range(repeats)])
    nans, overflows = (sum(float(x) for x in column) for column in zip(*counts, strict=True))
    return _row(env, "step", [env.num_envs * steps / s for s in seconds], compile_s, compiled, nans, overflows)


def measure_ppo(env: ManipulationEnv, preset: str, iterations: int, repeats: int) -> dict[str, Any]:
    """PPO end to end: rollouts, updates, auto-resets; ``iterations`` a compiled call."""
    learner = ppo.Learner(
        wrappers.for_training(env), dataclasses.replace(training.learner_cfg(env.cfg, preset), num_envs=env.num_envs)
    )
    begun = time.perf_counter()
    state = jax.jit(learner.init)(jax.random.PRNGKey(0))
    compiled = jax.jit(learner.run, static_argnums=1, donate_argnums=0).lower(state, iterations).compile()
    state, metrics = jax.block_until_ready(compiled(state))
    compile_s = time.perf_counter() - begun
    seconds, metrics = _timed(lambda state, _: compiled(state), state, range(repeats))
    nans, overflows = (sum(float(m[name]) * iterations for m in metrics) for name in ("sum/nan", "sum/overflow"))
    rates = [iterations * learner.steps_per_iteration / s for s in seconds]
    return _row(env, "ppo", rates, compile_s, compiled, nans, overflows)


def measure_control(env: ManipulationEnv, env_name: str, repeats: int) -> dict[str, Any]:
    """Whole episodes with the task's first controller: one compiled program, new starts and goals each time.

    Raises:
        UserError: the task has no controller.
    """
    name = next(iter(env.cfg.controllers), "")
    agent = rollout.controller_agent(env, evaluation.controller(name, env, env_name))
    run = rollout.mjx_runner(env, agent, env.num_envs)
    begun = time.perf_counter()
    run(None, 0)
    compile_s = time.perf_counter() - begun
    seconds, played = _timed(_stateless(run), None, [(None, seed) for seed in range(1, repeats + 1)])
    nans, overflows = (sum(float(p.metrics[key].sum()) for p in played) for key in ("nan", "overflow"))
    rates = [env.num_envs * env.episode_length / s for s in seconds]
    success = statistics.mean(float(p.metrics["success"].mean()) for p in played)
    return {**_row(env, name, rates, compile_s - seconds[0], None, nans, overflows), "success_rate": round(success, 5)}


def measure_ik(robot: RobotCfg, sizes: Sequence[int], repeats: int) -> list[dict[str, Any]]:
    """Inverse kinematics from the home position to poses of random configurations within the joint limits.

    Each measurement has a batch of its own, and there are at least a hundred poses of each size. A row of mink's follows, for
    the first hundred of the same poses.
    """
    solver = ik.InverseKinematics(robot)
    counts = {n: max(repeats, -(-_MINK_POSES // n)) for n in sizes}
    lower, upper = solver.chain.lower, solver.chain.upper
    total = max(n * count for n, count in counts.items())
    q = jax.random.uniform(jax.random.PRNGKey(0), (total, len(lower)), minval=lower, maxval=upper)
    pos, quat = (np.asarray(x[:, 0]) for x in jax.jit(jax.vmap(solver.chain.poses))(q))
    rows = []
    for n, count in counts.items():
        home, keys = jnp.tile(jnp.array(robot.arm.home), (n, 1)), jax.random.split(jax.random.PRNGKey(1), count)
        parts = [slice(i * n, (i + 1) * n) for i in range(count)]
        batches = [(jnp.array(pos[part]), jnp.array(quat[part]), home, key) for part, key in zip(parts, keys, strict=True)]
        begun = time.perf_counter()
        compiled = jax.jit(solver.solve_batch).lower(*batches[0]).compile()
        jax.block_until_ready(compiled(*batches[0]))
        compile_s = time.perf_counter() - begun
        seconds, solutions = _timed(_stateless(compiled), None, batches)
        found = jax.tree.map(lambda *x: jnp.concatenate(x), *solutions)
        errors = found.position_error, found.orientation_error
        device = jax.devices()[0].device_kind
        rows.append(_ik_row("mjx_nero", n, statistics.median(seconds), found.success, *errors, compile_s, device))
    return rows + measure_mink(robot, pos[:_MINK_POSES], quat[:_MINK_POSES])


def measure_mink(robot: RobotCfg, pos: np.ndarray, quat: np.ndarray) -> list[dict[str, Any]]:
    """One row: differential inverse kinematics with mink, pose after pose, from the home position to our solver's tolerances."""
    try:
        import mink
    except ImportError:
        print("mink is not installed (pip install mink): no comparison")
        return []
    cfg, model = ik.IkCfg(), scene.robot_model(robot)
    home = model.qpos0.copy()
    home[[model.joint(j).qposadr[0] for j in robot.arm.joints]] = robot.arm.home
    task = mink.FrameTask(robot.ee_site, "site", position_cost=1.0, orientation_cost=cfg.orientation_weight, lm_damping=1e-3)
    limits = [mink.ConfigurationLimit(model)]
    configuration = mink.Configuration(model)
    errors = []
    begun = time.perf_counter()
    for p, r in zip(pos.astype(float), quat.astype(float), strict=True):
        target = mink.SE3.from_rotation_and_translation(mink.SO3(r / np.linalg.norm(r)), p)
        configuration.update(home)
        task.set_target(target)
        for i in range(_MINK_ITERATIONS + 1):
            at = configuration.get_transform_frame_to_world(robot.ee_site, "site")
            position = np.linalg.norm(p - at.translation())
            orientation = np.linalg.norm((at.rotation().inverse() @ target.rotation()).log())
            done = position <= cfg.position_tolerance and orientation <= cfg.orientation_tolerance
            if done or i == _MINK_ITERATIONS:
                break
            configuration.integrate_inplace(mink.solve_ik(configuration, [task], 1.0, "daqp", limits=limits), 1.0)
        errors.append((done, position, orientation))
    seconds = (time.perf_counter() - begun) / len(pos)
    success, position, orientation = np.array(errors).T
    return [_ik_row("mink", 1, seconds, success, position, orientation, 0.0, "cpu")]


def _ik_row(solver: str, n: int, seconds: float, success, position, orientation, compile_s: float, device: str) -> dict[str, Any]:
    return {
        "what": "ik",
        "solver": solver,
        "batch": n,
        "poses": len(success),
        "ms_per_batch": round(1e3 * seconds, 3),
        "solves_per_s": round(n / seconds),
        "success": round(float(np.mean(success)), 5),
        "error_mm": round(1e3 * float(np.median(position)), 4),
        "error_mrad": round(1e3 * float(np.median(orientation)), 4),
        "compile_s": round(compile_s, 1),
        "device": device,
    }


def _timed(call: Callable[[Any, Any], tuple[Any, Any]], state: Any, inputs: Iterable[Any]) -> tuple[list[float], list[Any]]:
    """Calls ``(state, input) -> (state, output)`` in a row; gives the seconds and the output of each call."""
    seconds, outputs = [], []
    for x in inputs:
        begun = time.perf_counter()
        state, output = jax.block_until_ready(call(state, x))
        seconds.append(time.perf_counter() - begun)
        outputs.append(output)
    return seconds, outputs


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


def _stateless(call: Callable[..., Any]) -> Callable[[Any, Any], tuple[Any, Any]]:
    """What ``_timed`` calls, of a function that keeps no state."""
    return lambda _, args: (None, call(*args))


def _sizes(flag: str, values: str) -> list[int]:
    try:
        return [cli.positive(n) for n in values.split(",")]
    except argparse.ArgumentTypeError as error:
        raise UserError(f"{flag}: {error}") from None


def _show(title: str, rows: list[dict[str, Any]], columns: Sequence[str]) -> None:
    view = Table(title=title)
    for name in columns:
        view.add_column(name, justify="right", overflow="fold")
    for row in rows:
        view.add_row(*(f"{row[n]:,}" if isinstance(row[n], int) else str(row[n]) for n in columns))
    Console().print(view)


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = cli.Parser(prog="python -m mjx_nero.benchmark", description="Measures env steps and inverse kinematics per second.")
    parser.add_argument("--env", default="nero_lift", help="environment (default: %(default)s)")
    parser.add_argument("--preset", default="default")
    parser.add_argument("--num-envs", default="1024,4096,16384", help="list (default: %(default)s)")
    parser.add_argument("--impl", default="auto", help="list of auto, jax, warp (default: %(default)s)")
    parser.add_argument(
        "--what",
        default="step",
        help="list of step (random actions), ppo (training), control (the task's controller) and ik (inverse kinematics) "
        "(default: %(default)s)",
    )
    parser.add_argument("--batch", default="1,100,1000,2000,10000", help="list, poses of ik (default: %(default)s)")
    parser.add_argument("--steps", type=cli.positive, default=100, help="control steps a measurement (default: %(default)s)")
    parser.add_argument(
        "--repeats", type=cli.positive, default=5, help="measurements, of which the median counts (default: %(default)s)"
    )
    parser.add_argument("--json", type=pathlib.Path, help="write the rows as JSON")
    args, _ = parser.parse(argv)
    sizes, batches = _sizes("--num-envs", args.num_envs), _sizes("--batch", args.batch)
    impls, whats = _list(args.impl, "impl", IMPLS), _list(args.what, "what", ("step", "ppo", "control", "ik"))
    if args.json:
        run_folder.check_writable(args.json)
    cli.setup_jax()
    cfg = registry.env_cfg(args.env, args.preset)
    env_rows: list[dict[str, Any]] = []
    for impl in [resolve_impl(impl) for impl in impls]:
        for what in whats:
            for n in sizes if what != "ik" else ():
                env = ManipulationEnv(cfg, impl=impl, num_envs=n)
                if what == "step":
                    row = measure_step(env, args.steps, args.repeats)
                elif what == "control":
                    row = measure_control(env, args.env, args.repeats)
                else:
                    row = measure_ppo(env, args.preset, max(1, args.steps // 24), args.repeats)
                env_rows.append({"env": args.env, **row})
    ik_rows = measure_ik(cfg.robot, batches, args.repeats) if "ik" in whats else []
    rows = env_rows + [{"env": args.env, **row} for row in ik_rows]
    title = f"{args.env} on {rows[0]['device']}"
    for part, columns in ((env_rows, _ENV_COLUMNS), (ik_rows, _IK_COLUMNS)):
        if part:
            _show(title, part, columns)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    cli.run(main)
