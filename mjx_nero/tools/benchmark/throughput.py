"""Measures env steps and resets per second: bare physics, random actions, PPO, controllers."""

import concurrent.futures
import time
from collections.abc import Callable

import jax
import jax.numpy as jnp

from mjx_nero import control
from mjx_nero.envs import wrappers
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.learn import device_memory
from mjx_nero.learn.learner import Learner
from mjx_nero.learn.play import rollout
from mjx_nero.runs import compiled, iteration
from mjx_nero.runs.programs import Programs
from mjx_nero.runs.spans import Spans
from mjx_nero.tools.benchmark.program import Program, Row, device_peak_mb, mb, spread, warp_mb


def physics(env: ManipulationEnv, steps: int) -> Program:
    """Applies random actions to the bare physics, without rewards, observations and resets: ``steps`` control steps per call."""

    def step(state, key):
        action = jax.random.normal(key, (env.num_envs, env.action_size))
        sim, overflow = jax.vmap(env.physics.step)(state.pipeline_state, jax.vmap(env.targets)(state, action))
        return state.replace(pipeline_state=sim), {"overflow": jnp.sum(overflow)}

    return Program.compiled(_repeated(step, steps), _start(env), env.num_envs * steps, env.physics.compiler_options)


def step(env: ManipulationEnv, steps: int) -> Program:
    """Applies standard normal actions in the auto-resetting training environment: ``steps`` control steps per call."""
    batch = wrappers.for_training(env)

    def step(state, key):
        state = batch.step(state, jax.random.normal(key, (env.num_envs, env.action_size)))
        return state, {name: jnp.sum(state.metrics[name]) for name in ("nan", "overflow")}

    return Program.compiled(_repeated(step, steps), _start(env), env.num_envs * steps, env.physics.compiler_options)


def reset(env: ManipulationEnv, times: int) -> Program:
    """Resets every environment ``times`` times per call."""
    batch = wrappers.for_training(env)

    def again(state, key):
        return batch.reset(jax.random.split(key, env.num_envs)), {}

    return Program.compiled(_repeated(again, times), _start(env), env.num_envs * times, env.physics.compiler_options)


def training(learner: Learner, iterations: int) -> Program:
    """Trains a fresh policy end to end, with rollouts, updates and resets: ``iterations`` per call."""
    begun = time.perf_counter()
    with concurrent.futures.ThreadPoolExecutor() as pool:
        advance = iteration.Lowered(learner, iterations, Programs(None, learner)).compiling(pool, Spans())()

    def run(state, _):  # the state has its own key
        state, metrics = advance(state)
        return state, {name: metrics.get(f"sum/{name}", 0.0) * iterations for name in ("nan", "overflow")}

    program = Program(run, compiled.Fresh(learner).placed(0), iterations * learner.steps_per_iteration)
    program.warm_up(begun)
    size = device_memory.largest(advance.programs)
    program.memory_mb = None if size is None else mb(size)
    return program


def controlled(env: ManipulationEnv, controller: control.Controller) -> Program:
    """Plays whole episodes of a controller in one compiled program, with new starts and goals at each call."""
    run = rollout.runner(env, rollout.controller_agent(env, controller), env.num_envs)

    def play(seed, _):
        metrics = run(None, seed).metrics
        return seed + 1, {name: metrics[name].sum() for name in ("nan", "overflow", "success")}

    begun = time.perf_counter()
    program = Program(play, 0, env.num_envs * env.episode_length)
    program.warm_up(begun)
    return program


def measure(what: str, env: ManipulationEnv, make: Callable[[], Program], repeats: int) -> Row:
    """Measures ``repeats`` calls of a program and returns the row."""
    program, unit = make(), "resets" if what == "reset" else "env_steps"
    row = {
        "what": what,
        "impl": env.impl,
        "num_envs": env.num_envs,
        **spread(f"{unit}_per_s", program.rates(repeats)),
        "compile_s": round(program.compile_s, 1),
        "memory_mb": program.memory_mb,
        "device_peak_mb": device_peak_mb(),
        "warp_mb": warp_mb(env) if unit == "env_steps" else None,
    }
    if unit == "env_steps":
        row["physics_steps_per_s"] = round(row["env_steps_per_s"] * env.cfg.sim.decimation)
    counts = dict(program.counts)
    if "success" in counts:
        row["success_rate"] = round(counts.pop("success") / (repeats * env.num_envs), 5)
    return {**row, **{f"{name}_count": round(value) for name, value in counts.items()}}


def _start(env: ManipulationEnv) -> Callable:
    return lambda: jax.jit(wrappers.for_training(env).reset)(jax.random.split(jax.random.PRNGKey(0), env.num_envs))


def _repeated(function: Callable, times: int) -> Callable:
    """Repeats ``function`` of state and key ``times`` times in one program, and sums the counts."""

    def run(state, key):
        state, counts = jax.lax.scan(function, state, jax.random.split(key, times))
        return state, jax.tree.map(jnp.sum, counts)

    return run
