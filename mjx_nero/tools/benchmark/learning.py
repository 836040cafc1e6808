"""Time to success: several seeds trained one after another in one process, by one compiled program."""

import math
import statistics
import time
from collections.abc import Iterator

import jax

from mjx_nero.runs import compiled, starts, training
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.tools.benchmark.program import Row

_EVALUATIONS = 24  # a whole run, where nothing else is asked for


def measure_learning(run: RunCfg, seeds: int, target: float) -> Iterator[Row]:
    """A row a seed, then one about all.

    Each seed trains until an evaluation's success reaches ``target``, or its env steps are used up. Seconds are wall time of
    training, evaluations and whatever a training begins with (an expert's states), without compilation. All seeds are judged by
    the same episodes.

    Args:
        run: of ``run_cfg.fit_machine``; ``eval_every`` 0 evaluates 24 times a whole run.
    """
    learner = compiled.make_learner(run)
    head = {"what": "learning", "impl": learner.env.unwrapped.impl, "num_envs": run.num_envs, "target": target}
    between = run.eval_every or run.num_timesteps // _EVALUATIONS
    chunk = max(1, between // learner.steps_per_iteration)
    begun = time.perf_counter()
    fresh = compiled.starter(learner, starts.maker(learner, training.speaker()))
    made = compiled.compile(run, learner, chunk, lambda: fresh(0))
    calls = math.ceil(run.num_timesteps / made.steps)
    state, _ = jax.block_until_ready(made.advance(made.state))  # loads what the backend compiles at its first call
    made.evaluate(state)
    compile_s = time.perf_counter() - begun

    rows = []
    for seed in range(seeds):
        begun = time.perf_counter()
        state = jax.block_until_ready(fresh(seed))
        evaluating, nans, overflows, success, done = 0.0, 0.0, 0.0, 0.0, 0
        while done < calls and success < target:
            state, metrics = jax.block_until_ready(made.advance(state))
            done += 1
            lost = {name: float(metrics.get(f"sum/{name}", 0.0)) * chunk for name in ("nan", "overflow")}
            nans, overflows = nans + lost["nan"], overflows + lost["overflow"]
            evaluated = time.perf_counter()
            success = made.evaluate(state)["success_rate"]
            evaluating += time.perf_counter() - evaluated
        rows.append(
            {
                **head,
                "seed": seed,
                "reached": success >= target,
                "seconds": round(time.perf_counter() - begun, 2),
                "evaluation_s": round(evaluating, 2),
                "env_steps": done * made.steps,
                "success_rate": round(success, 5),
                "compile_s": round(compile_s, 1),
                "nan_count": round(nans),
                "overflow_count": round(overflows),
            }
        )
        yield rows[-1]
    yield {**head, **summary(rows)}


def summary(rows: list[Row]) -> Row:
    """Counts the seeds that reached the target; median and worst seconds and env steps, None if that seed did not reach it."""
    found: Row = {"seed": "all", "seeds": len(rows), "reached": sum(row["reached"] for row in rows)}
    for name, digits in (("seconds", 2), ("env_steps", None)):
        values = [row[name] if row["reached"] else math.inf for row in rows]
        for which, value in (("median", statistics.median(values)), ("worst", max(values))):
            found[f"{name}_{which}"] = round(value, digits) if math.isfinite(value) else None
    return found
