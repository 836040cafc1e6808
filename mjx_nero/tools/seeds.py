"""Several seeds, trained one after another in one process: one compiled program, and one run per seed."""

import dataclasses
import functools
import math
import pathlib
import statistics
from collections.abc import Sequence
from typing import Any

from mjx_nero import files
from mjx_nero.config import values
from mjx_nero.config.bounds import NonNegative, Seed, Share, Whole
from mjx_nero.errors import UserError
from mjx_nero.learn import device_memory, machines
from mjx_nero.learn.play.rollout import wilson
from mjx_nero.runs import compiled, starts, training
from mjx_nero.runs import folder as run_folder
from mjx_nero.runs.cfg import RunCfg, fit_machine
from mjx_nero.runs.helpers import ALONE, Helpers
from mjx_nero.runs.loop import Diverged, Tally
from mjx_nero.runs.programs import Programs

SEEDS = "seeds.json"
Row = dict[str, Any]


@dataclasses.dataclass(frozen=True)
class SeedRow:
    """One seed's row in ``seeds.json``."""

    seed: Seed
    success_rate: Share
    success_rate_95: tuple[float, float] | None
    seconds_to_95: NonNegative | None
    env_steps: Whole
    train_s: NonNegative
    stopped: str


def train(
    run: RunCfg, seeds: Sequence[int], command: str = "train.py", helpers: Helpers = ALONE
) -> tuple[list[Row], pathlib.Path, int]:
    """Trains each seed as ``training.train`` does, in ``seed_<n>`` of the run's folder, and writes ``seeds.json``, one row per
    seed.

    A seed that diverges becomes a row without success, and the next seed follows. A signal ends them all.

    Args:
        helpers: processes that help the first seed's start (see ``apart.begin``).

    Returns:
        the rows of all seeds in the folder, the folder, and an exit status.

    Raises:
        UserError: something that the user can fix.
        signals.Signalled: a signal came before training began.
    """
    if machines.several():
        raise UserError("--seeds trains on one machine: on several, start one run per seed with --seed")
    say = training.speaker()
    run, note = fit_machine(run)
    learner = compiled.make_learner(run)
    device_memory.check(learner)
    meta = training.describe(run, learner)
    with run_folder.claim(run.out, run.env_name, goes_on=False) as folder:
        homes = {seed: folder / f"seed_{seed}" for seed in seeds}
        for home in homes.values():
            if (home / run_folder.CONFIG).exists():
                raise UserError(f"{home} already holds a run: pass other --seeds or another --out, or --restore {home} alone")
        if note:
            say(note)
        programs = Programs(run, learner)
        fresh, one = compiled.Fresh(learner, starts.Maker(learner, say, elsewhere=helpers.expert), programs), seeds[0]
        begin, trace = functools.partial(fresh.placed, one), functools.partial(fresh.trace, one)
        made = training.prepare(dataclasses.replace(run, seed=one), learner, begin, folder, programs, trace, helpers.kernels)
        found = {row["seed"]: row for row in _earlier(folder / SEEDS)}
        for i, (seed, home) in enumerate(homes.items()):
            say(f"seed {seed}, {i + 1} of {len(seeds)}")
            if i:
                made = dataclasses.replace(made, state=fresh.placed(seed), evaluate=made.evaluate.of_seed(seed), seconds=0.0)
            with run_folder.claim(home, run.env_name, goes_on=False):
                row, code = _run(dataclasses.replace(run, seed=seed, out=home), made, meta, home, command)
            found[seed] = row
            rows = [found[seed] for seed in sorted(found)]
            files.write_json(folder / SEEDS, {**summary(rows), "rows": rows})
            if code:
                left = ",".join(map(str, seeds[i + 1 :]))
                say(f"seeds {left} were not started: --seeds {left} --out {folder} trains them" if left else "no seed is left")
                return rows, folder, code
    return rows, folder, 0


def _run(run: RunCfg, made: compiled.Compiled, meta: dict[str, Any], home: pathlib.Path, command: str) -> tuple[Row, int]:
    """Trains one seed; returns its row and exit status."""
    tally = Tally()
    try:
        found = training.carry_out(run, made, tally, meta, home, command)
    except Diverged as error:
        training.speaker()(f"warning: {error}")
        nothing = {"success_rate": 0.0, "success_rate_95": None}
        found = {"evaluation": nothing, "seconds_to_95": None, "stopped": "diverged", "code": 0}
    row = {
        "seed": run.seed,
        **{name: found["evaluation"][name] for name in ("success_rate", "success_rate_95")},
        "seconds_to_95": found["seconds_to_95"],
        "env_steps": tally.steps,
        "train_s": round(tally.wall_s, 1),
        "stopped": found["stopped"],
    }
    return row, found["code"]


def _earlier(path: pathlib.Path) -> list[Row]:
    """Reads the rows of seeds that this folder already holds."""
    if not path.exists():
        return []
    try:
        rows = values.read(tuple[SeedRow, ...], files.read_json(path)["rows"], "rows")
    except (UserError, KeyError, TypeError):
        raise UserError(f"{path} is damaged: move it away, or pass another --out") from None
    return [dataclasses.asdict(row) for row in rows]


def summary(rows: list[Row]) -> Row:
    """Summarizes all seeds, with 95% intervals: how many reached 95% success (Wilson), and the mean success (Student's t).

    The seconds to 95% success are a median over the seeds that reached it, and an interval of the mean if all did.
    """
    seconds = [row["seconds_to_95"] for row in rows if row["seconds_to_95"] is not None]
    successes = [row["success_rate"] for row in rows]
    return {
        "seeds": len(rows),
        "reached_95": len(seconds),
        "reached_95_interval": wilson(float(len(seconds)), len(rows)),
        "success_rate_mean": statistics.mean(successes),
        "success_rate_interval": mean_interval(successes, most=1.0),
        "seconds_to_95_median": statistics.median(seconds) if seconds else None,
        "seconds_to_95_interval": mean_interval(seconds) if len(seconds) == len(rows) else None,
    }


def mean_interval(values: Sequence[float], most: float = math.inf) -> tuple[float, float] | None:
    """Returns Student's 95% interval of the mean of independent values from 0 to ``most``; None for a single value."""
    if len(values) < 2:
        return None
    from scipy.special import stdtrit  # slow to import

    half = float(stdtrit(len(values) - 1, 0.975)) * statistics.stdev(values) / math.sqrt(len(values))
    return max(0.0, statistics.mean(values) - half), min(most, statistics.mean(values) + half)
