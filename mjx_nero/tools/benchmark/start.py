"""Measures the start of a training run: the time before the first step, with empty and with filled caches."""

import functools
import json
import os
import pathlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence

import jax

from mjx_nero.errors import UserError
from mjx_nero.learn import device_memory
from mjx_nero.runs import compiled, starts, training
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.runs.helpers import Helpers
from mjx_nero.runs.programs import Programs
from mjx_nero.runs.spans import Span, Spans
from mjx_nero.tools.benchmark.program import Row

_MISSED = "/compilation_cache/cache_misses"  # JAX's event for a program that it compiles
# As ``train.py`` begins.
_CHILD = "from mjx_nero.tools import cli; cli.tune_python(); from mjx_nero.tools.benchmark import command; command.begin()"


def measure_start(argv: Sequence[str], run: RunCfg) -> Iterator[Row]:
    """Yields a row for each stage of a start, twice: with empty caches of JAX and Warp, then with the caches that this start
    filled.

    Stages overlap, so each row says when its stage begins and how long it takes. Each start is a separate process.

    Args:
        argv: this benchmark's arguments, for the new process.
        run: the run to start, from ``run_cfg.fit_machine``.

    Raises:
        UserError: a start failed.
    """
    with tempfile.TemporaryDirectory() as folder:
        for caches in ("empty", "filled"):
            stages, misses = _started(argv, pathlib.Path(folder))
            for stage in stages:
                seconds = {"begins_s": round(stage.begun, 1), "seconds": round(stage.seconds, 1)}
                yield {
                    "what": "start",
                    "impl": run.impl,
                    "num_envs": run.num_envs,
                    "caches": caches,
                    "stage": stage.name,
                    **seconds,
                    **({"compiled": misses} if stage is stages[-1] else {}),
                }


def _started(argv: Sequence[str], caches: pathlib.Path) -> tuple[list[Span], int]:
    """Returns the stages of a start, and the number of programs that were not in JAX's cache."""
    env = {key: value for key, value in os.environ.items() if key not in ("JAX_COMPILATION_CACHE_DIR", "WARP_CACHE_PATH")}
    begun = time.time()
    done = subprocess.run(
        [sys.executable, "-c", _CHILD, str(begun), *argv],
        env={**env, "XDG_CACHE_HOME": str(caches)},
        stdout=subprocess.PIPE,
        text=True,
    )
    if done.returncode:
        raise UserError("the start to be measured failed: see its error above")
    rows, misses = json.loads(done.stdout.splitlines()[-1])
    stages = [Span(*row) for row in rows]
    whole = Span("until the first training step", 0.0, max(s.begun for s in stages if s.name == "first iterations"))
    return [*stages, whole], misses


def begin(spawned: float, imported: float, run: RunCfg, helpers: Helpers) -> None:
    """Starts a run as ``train.py`` does, up to its first call of the learner, and prints the stages as one line of JSON.

    Args:
        spawned, imported: when the process was started, and when its imports were done [s since 1970].
        run: from ``run_cfg.fit_machine``.
        helpers: from ``apart.begin``.
    """
    so_far = time.time() - spawned
    spans, misses = Spans(), list[str]()
    jax.monitoring.register_event_listener(lambda event, **_: misses.append(event) if event.endswith(_MISSED) else None)
    with spans.span("environments"):
        learner = compiled.make_learner(run)
        device_memory.check(learner)
    before = time.time() - spawned
    programs = Programs(run, learner)
    fresh = compiled.Fresh(learner, starts.Maker(learner, training.speaker(), elsewhere=helpers.expert), programs)
    place = pathlib.Path("start")
    start, trace = functools.partial(fresh.placed, 0), functools.partial(fresh.trace, 0)
    made = training.prepare(run, learner, start, place, programs, trace, helpers.kernels)
    with spans.span("first iterations"):
        state, _ = jax.block_until_ready(made.advance(made.state))
    with spans.span("first evaluation"):
        made.evaluate(state)
    stages = [Span("imports", 0.0, imported - spawned), Span("config", imported - spawned, spawned + so_far - imported)]
    stages += [Span(name, begun + so_far, seconds) for name, begun, seconds in spans.found]
    stages += [Span(name, begun + before, seconds) for name, begun, seconds in made.spans]
    print(json.dumps([sorted(stages, key=lambda stage: stage.begun), len(misses)]))
