"""Time to success: several seeds trained one after another in one process, by one compiled program."""

import math
import statistics
import time
from collections.abc import Iterator

import jax

from mjx_nero import ppo, training, wrappers
from mjx_nero.benchmark.program import Row
from mjx_nero.env import ManipulationEnv
from mjx_nero.physics import compiler_options

_EVALUATIONS = 24  # a whole run, where nothing else is asked for


def measure_learning(run: training.RunCfg, seeds: int, target: float) -> Iterator[Row]:
    """A row a seed, then one about all.

    Each seed trains until an evaluation's success reaches ``target``, or its env steps are used up. Seconds are wall time of
    training and evaluations, without compilation. All seeds are judged by the same episodes.

    Args:
        run: of ``training.fit_machine``; ``eval_every`` 0 evaluates 24 times a whole run.
    """
    learner = make_learner(run)
    impl, per = learner.env.unwrapped.impl, learner.steps_per_iteration
    head = {"what": "learning", "impl": impl, "num_envs": run.ppo.num_envs, "target": target}
    chunk = max(1, (run.eval_every or run.ppo.num_timesteps // _EVALUATIONS) // per)  # iterations between evaluations
    calls = math.ceil(run.ppo.num_timesteps / (chunk * per))

    begun = time.perf_counter()
    init = jax.jit(learner.init)
    state = learner.place(init(jax.random.PRNGKey(0)))
    lowered = jax.jit(learner.run, static_argnums=1, donate_argnums=0).lower(state, chunk)
    advance = lowered.compile(compiler_options(impl))
    evaluate = training.Evaluator(run, learner)
    state, _ = jax.block_until_ready(advance(state))  # loads what the backend compiles at its first call
    evaluate(learner.on_one_device(state))
    compile_s = time.perf_counter() - begun

    rows = []
    for seed in range(seeds):
        state = jax.block_until_ready(learner.place(init(jax.random.PRNGKey(seed))))
        evaluating, nans, overflows, success, done = 0.0, 0.0, 0.0, 0.0, 0
        begun = time.perf_counter()
        while done < calls and success < target:
            state, metrics = jax.block_until_ready(advance(state))
            done += 1
            nans, overflows = nans + float(metrics["sum/nan"]) * chunk, overflows + float(metrics["sum/overflow"]) * chunk
            evaluated = time.perf_counter()
            success = evaluate(learner.on_one_device(state))["success_rate"]
            evaluating += time.perf_counter() - evaluated
        rows.append(
            {
                **head,
                "seed": seed,
                "reached": success >= target,
                "seconds": round(time.perf_counter() - begun, 2),
                "evaluation_s": round(evaluating, 2),
                "env_steps": done * chunk * per,
                "success_rate": round(success, 5),
                "compile_s": round(compile_s, 1),
                "nan_count": round(nans),
                "overflow_count": round(overflows),
            }
        )
        yield rows[-1]
    yield {**head, **summary(rows)}


def make_learner(run: training.RunCfg) -> ppo.Learner:
    """The learner of a run.

    Raises:
        UserError: the number of environments or devices does not suit it.
    """
    env = ManipulationEnv(run.env, impl=run.impl, num_envs=run.ppo.num_envs)
    return ppo.Learner(wrappers.for_training(env), run.ppo, run.num_devices)


def summary(rows: list[Row]) -> Row:
    """How many seeds reached the target; median and worst of seconds and env steps, None where such a seed did not."""
    found: Row = {"seed": "all", "seeds": len(rows), "reached": sum(row["reached"] for row in rows)}
    for name, digits in (("seconds", 2), ("env_steps", None)):
        values = [row[name] if row["reached"] else math.inf for row in rows]
        for which, value in (("median", statistics.median(values)), ("worst", max(values))):
            found[f"{name}_{which}"] = round(value, digits) if math.isfinite(value) else None
    return found
