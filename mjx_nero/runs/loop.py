"""The training loop, from compiled programs to the last checkpoint."""

import dataclasses
import functools
import math
import time
from collections.abc import Callable
from typing import Any

import jax

from mjx_nero.errors import UserError
from mjx_nero.learn import checkpoint, learner, machines, waiting
from mjx_nero.learn.play import figures
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.runs.checkpoints import Checkpoints
from mjx_nero.runs.compiled import Compiled
from mjx_nero.runs.console import Show
from mjx_nero.runs.logs import Logs
from mjx_nero.runs.signals import Stop
from mjx_nero.types import LEVEL

_ROWS = 2000  # rows of metrics per run, besides evaluations
_Ahead = tuple[float, Callable[[], tuple[Any, Any]]]  # when a chunk began, and what waits for its state and metrics


@dataclasses.dataclass
class Tally:
    """The counts of a run, which continue when it resumes."""

    steps: int = 0  # env steps
    wall_s: float = 0.0  # time of training and evaluations
    steps_per_s: float = 0.0
    nan_count: int = 0
    overflow_count: int = 0
    seconds_to_95: float | None = None
    steps_to_95: int | None = None
    best_success: float = -1.0
    best_return: float = -1e30  # JSON has no infinity
    best_steps: int = 0
    rewound_at: int | None = None  # env steps
    evaluation: dict[str, Any] = dataclasses.field(default_factory=dict)  # the latest evaluation

    def evaluated(self, result: dict[str, Any]) -> bool:
        """Records an evaluation; returns True if it is the best so far, by success and then by return."""
        self.evaluation = result
        if self.seconds_to_95 is None and result["success_rate"] >= 0.95:
            self.seconds_to_95, self.steps_to_95 = round(self.wall_s, 1), self.steps
        found = result["success_rate"], -1e30 if result["return_mean"] is None else result["return_mean"]
        if found <= (self.best_success, self.best_return):
            return False
        (self.best_success, self.best_return), self.best_steps = found, self.steps
        return True


class Diverged(UserError):
    """Training produced numbers that are not finite."""


class Mean:
    """The mean of metrics over several chunks."""

    def __init__(self) -> None:
        self._sums: dict[str, float] = {}
        self._count = 0

    def add(self, metrics: dict[str, float]) -> None:
        """Adds the metrics of a chunk."""
        self._sums = {name: self._sums.get(name, 0.0) + value for name, value in metrics.items()}
        self._count += 1

    def take(self) -> dict[str, float]:
        """Returns the mean since the last call; empty if nothing was added."""
        found = {name: value / self._count for name, value in self._sums.items()}
        self._sums, self._count = {}, 0
        return found


@dataclasses.dataclass
class Loop:
    """Trains until the steps or minutes are used up, or a signal comes."""

    run: RunCfg
    made: Compiled
    tally: Tally
    meta: dict[str, Any]  # description for a policy's file
    checkpoints: Checkpoints
    logs: Logs
    back: Callable[[], tuple[Any, Tally]]  # loads state and tally of the newest checkpoint
    say: Callable[[str], None]
    show: Show
    stop: Stop

    def __call__(self, state: Any) -> str:
        """Trains from ``state``; returns why training ended.

        Raises:
            Diverged: training diverged (see ``RunCfg.on_nan``).
            NotWritten: a checkpoint could not be written.
        """
        tally, total = self.tally, self.run.num_timesteps
        mean, begun = Mean(), time.perf_counter() - tally.wall_s
        saved = time.perf_counter()
        every = {
            "eval": self.run.eval_every or max(1, total // 12),
            "save": self.run.checkpoint_every or max(1, total // 5),
            "row": max(1, total // _ROWS),
        }
        due = {name: _next(tally.steps, steps) for name, steps in every.items()}
        ahead: _Ahead | None = None
        if not tally.steps:
            ended, ahead = self._first(state)
            if ended:
                return ended
        while True:
            t, take = ahead or (time.perf_counter(), functools.partial(waiting.result_of, self.made.advance, state))
            (state, metrics), ahead = take(), None
            means = {name: float(value) for name, value in metrics.items()}  # waits for the device
            tally.steps_per_s = self.made.steps / (time.perf_counter() - t)
            tally.steps += self.made.steps
            tally.wall_s = time.perf_counter() - begun
            if bad := self._not_finite(means, state):
                state = self._after_divergence(bad)
                mean.take()
                due = {name: _next(tally.steps, steps) for name, steps in every.items()}
                continue
            mean.add(self._counted(means))
            stop, tally.wall_s, unsaved = self._agree(time.perf_counter() - saved)
            ended = self._ended(stop)
            now = {name for name in due if tally.steps >= due[name] or (ended and (name != "eval" or not stop))}
            if 0 < 60 * self.run.checkpoint_minutes <= unsaved:
                now.add("save")
            due |= {name: _next(tally.steps, every[name]) for name in now}
            best = False
            if "eval" in now:
                best = self._evaluate(state)
                tally.wall_s = time.perf_counter() - begun
            if now & {"eval", "row"}:
                self._log(self._row(mean.take()), evaluated="eval" in now)
            if "save" in now or best:
                self._save(state)
                saved = time.perf_counter()
            self.show.update(tally.steps, tally.wall_s, tally.steps_per_s, tally.evaluation.get("success_rate"))
            if ended:
                self.checkpoints.wait()
                return ended

    def _first(self, state: Any) -> tuple[str, _Ahead | None]:
        """Evaluates and saves the first state, and begins the first chunk before that: the evaluation's program may still be in
        the making.

        Returns:
            why training ends here, empty if it does not; and the chunk, if it has begun.
        """
        ahead = None
        if not self._draws:  # such programs run one after another
            own = jax.device_put(state, jax.tree.map(lambda x: x.sharding, state), may_alias=False)
            ahead = time.perf_counter(), waiting.ahead(self.made.advance, own)
        self._evaluate(state)
        self._log({})
        self._save(state)
        ended = self._ended(self._agree(0.0)[0])
        if ended:
            self.checkpoints.wait()
            if ahead:
                ahead[1]()  # JAX may crash if the process ends meanwhile
        return ended, ahead

    @property
    def _draws(self) -> bool:
        return bool(self.made.learner.env.unwrapped.cfg.scene.cameras)

    def _agree(self, unsaved: float) -> tuple[int, float, float]:
        """Returns any process's signal (0: none) and the first process's clocks [s].

        They are read once per chunk, so that a signal never takes effect half-way.
        """
        found = machines.gather([self.stop.number or 0, self.tally.wall_s, unsaved])
        return int(found[:, 0].max()), float(found[0, 1]), float(found[0, 2])

    def _ended(self, stop: int) -> str:
        """Says why training ends here; empty if it does not."""
        if stop:
            self.stop.number = stop
            return "interrupted"
        if self.tally.steps >= self.run.num_timesteps:
            return "finished"
        return "time limit" if 0 < 60 * self.run.max_minutes <= self.tally.wall_s else ""

    def _not_finite(self, means: dict[str, float], state: Any) -> str | None:
        """Names the first quantity that is not finite: a metric, or an array of the policy."""
        bad = next((name for name, value in means.items() if not math.isfinite(value)), None)
        return bad or checkpoint.not_finite(self.made.learner.policy(state))

    def _after_divergence(self, what: str) -> Any:
        """Returns the state to continue with, at most once: the newest checkpoint, which was finite when saved."""
        self.checkpoints.wait()
        machines.wait()  # the first process's files must be complete
        at, before = self.tally.steps, self.tally.rewound_at
        state, tally = self.back()
        said = f"{what} is not finite after {at:,} steps"
        if self.run.on_nan != "rewind" or before is not None:
            again = f" (for the second time, after rewinding from {before:,} steps)" if before is not None else ""
            raise Diverged(
                f"{said}{again}: training stopped. The last finite checkpoint is at {tally.steps:,} steps: start a new run from "
                "it with a lower learning rate" + ("" if before is not None else ", or pass --on-nan rewind")
            )
        for field in dataclasses.fields(tally):  # in place: the summary reads it
            setattr(self.tally, field.name, getattr(tally, field.name))
        self.tally.rewound_at = at
        self.say(f"warning: {said}: back to {tally.steps:,} steps, with a lower learning rate")
        return self.made.learner.place(self.made.learner.slower(state))

    def _counted(self, metrics: dict[str, float]) -> dict[str, float]:
        self.tally.nan_count += round(metrics.get("sum/nan", 0.0) * self.made.chunk)
        self.tally.overflow_count += round(metrics.get("sum/overflow", 0.0) * self.made.chunk)
        return metrics

    def _evaluate(self, state: Any) -> bool:
        best = False
        if machines.first():
            result = self.made.evaluate(state)
            self.show.evaluated(self.tally.steps, self.tally.wall_s, result)
            best = self.tally.evaluated(result)
        return bool(machines.gather([best])[0, 0])

    def _save(self, state: Any) -> None:
        tally, policy = self.tally, self.made.learner.policy(state)
        policy = learner.find(self.run.learner).stored(policy, self.meta)
        meta = {**self.meta, "env_steps": tally.steps, "tally": dataclasses.asdict(tally)}
        self.checkpoints.save(state, policy, meta, tally.steps, tally.best_steps)

    def _row(self, metrics: dict[str, float]) -> dict[str, float]:
        """Turns sums over an iteration into figures per episode."""
        env, per = self.made.learner.env.unwrapped, self.made.learner.steps_per_iteration
        length = env.episode_length
        sums = {name.removeprefix("sum/"): value for name, value in metrics.items() if name.startswith("sum/")}
        row = {
            "steps_per_s": self.tally.steps_per_s,
            "train/return": sums.get("reward", 0.0) / per * length,
            "nan_count": self.tally.nan_count,
            "overflow_count": self.tally.overflow_count,
        }
        episodes = max(sums.get("episodes", 0.0), 1e-9)
        row |= {f"train/{n}": sums[n] / episodes for n in ("success", "dropped", "final_distance", "visited", LEVEL) if n in sums}
        terms = env.cfg.metrics
        row |= {f"train/{name}": value for name, value in figures.of_sums(terms, sums, episodes)}
        row |= {name: value / per * length for name, value in sums.items() if name.startswith("reward/")}
        return row | {f"{self.run.learner}/{name}": value for name, value in metrics.items() if not name.startswith("sum/")}

    def _log(self, row: dict[str, float], evaluated: bool = True) -> None:
        shown = {f"eval/{k}": v for k, v in self.tally.evaluation.items() if isinstance(v, float | int)} if evaluated else {}
        self.logs.write({"steps": self.tally.steps, "wall_s": round(self.tally.wall_s, 3), **row, **shown})


def _next(steps: int, every: int) -> int:
    """Returns the next multiple of ``every``, so that a resumed run keeps its rhythm."""
    return (steps // every + 1) * every
