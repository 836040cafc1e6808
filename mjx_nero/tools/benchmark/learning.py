"""Measures the time to success: trains several seeds one after another in one process, with one compiled program."""

import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import jax

from mjx_nero.learn.learner import Learner
from mjx_nero.runs import compiled, signals, starts, training
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.runs.programs import Programs
from mjx_nero.tools.benchmark.program import Row

_EVALUATIONS = 24  # per full run, unless --eval-every is given


def measure_learning(run: RunCfg, seeds: int, target: float, kept: Sequence[Row] = ()) -> Iterator[Row]:
    """Yields a row for each seed, then one about all seeds.

    Each seed trains until an evaluation's success rate reaches ``target`` or its env steps are used up. Seconds are wall time of
    training, evaluations and the preparation of start states (by an expert), without compilation. All seeds are evaluated on the
    same episodes. A signal ends the seed after its next update, outside compiled code, because no exception may cross that.

    Args:
        run: from ``run_cfg.fit_machine``; if ``eval_every`` is 0, there are 24 evaluations per full run.
        kept: rows of an earlier, interrupted measurement of the same run; their seeds are not trained again.

    Raises:
        signals.Signalled: a signal arrived.
    """
    rows = [row for row in kept if row["seed"] in range(seeds)]
    yield from rows
    missing = sorted({*range(seeds)} - {row["seed"] for row in rows})
    learner = compiled.make_learner(run)
    head = {"what": "learning", "impl": learner.env.unwrapped.impl, "num_envs": run.num_envs, "target": target}
    if missing:
        between = run.eval_every or run.num_timesteps // _EVALUATIONS
        chunk = max(1, between // learner.steps_per_iteration)
        for row in _measured(run, learner, chunk, missing, target):
            rows.append({**head, **row})
            yield rows[-1]
    yield {**head, **summary(rows)}


def _measured(run: RunCfg, learner: Learner, chunk: int, seeds: Sequence[int], target: float) -> Iterator[Row]:
    """Compiles the run once and trains these seeds."""
    begun, programs = time.perf_counter(), Programs(run, learner)
    fresh = compiled.Fresh(learner, starts.Maker(learner, training.speaker()), programs)
    made = compiled.compile(run, learner, chunk, lambda: fresh.placed(0), programs, lambda beside: fresh.trace(0, beside))
    with signals.after_this(training.speaker()) as stop:
        state, _ = jax.block_until_ready(made.advance(made.state))  # loads what the backend compiles at its first call
        made.evaluate(state)
        compile_s, calls = time.perf_counter() - begun, math.ceil(run.num_timesteps / made.steps)
        for seed in seeds:
            signals.check(stop)
            yield {"seed": seed, **_trained(made, fresh.placed, calls, seed, target, stop), "compile_s": round(compile_s, 1)}


def _trained(
    made: compiled.Compiled, fresh: Callable[[int], Any], calls: int, seed: int, target: float, stop: signals.Stop
) -> Row:
    """Trains one seed until it succeeds or has made ``calls`` updates."""
    begun = time.perf_counter()
    state = jax.block_until_ready(fresh(seed))
    evaluating, nans, overflows, success, done = 0.0, 0.0, 0.0, 0.0, 0
    while done < calls and success < target:
        state, metrics = jax.block_until_ready(made.advance(state))
        done += 1
        lost = {name: float(metrics.get(f"sum/{name}", 0.0)) * made.chunk for name in ("nan", "overflow")}
        nans, overflows = nans + lost["nan"], overflows + lost["overflow"]
        evaluated = time.perf_counter()
        success = made.evaluate(state)["success_rate"]
        evaluating += time.perf_counter() - evaluated
        signals.check(stop)
    return {
        "reached": success >= target,
        "seconds": round(time.perf_counter() - begun, 2),
        "evaluation_s": round(evaluating, 2),
        "env_steps": done * made.steps,
        "success_rate": round(success, 5),
        "nan_count": round(nans),
        "overflow_count": round(overflows),
    }


def summary(rows: list[Row]) -> Row:
    """Counts the seeds that reached the target, with median and worst seconds and env steps (None: that seed did not)."""
    found: Row = {"seed": "all", "seeds": len(rows), "reached": sum(row["reached"] for row in rows)}
    for name, digits in (("seconds", 2), ("env_steps", None)):
        values = [row[name] if row["reached"] else math.inf for row in rows]
        for which, value in (("median", statistics.median(values)), ("worst", max(values))):
            found[f"{name}_{which}"] = round(value, digits) if math.isfinite(value) else None
    return found
