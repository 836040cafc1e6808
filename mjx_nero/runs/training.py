"""A training run: compile, loop, finish. All its results are left in its folder."""

import dataclasses
import functools
import pathlib
from collections.abc import Callable, Mapping
from multiprocessing.process import BaseProcess
from typing import Any

import jax

from mjx_nero import config, files
from mjx_nero.config import values
from mjx_nero.config.bounds import Share
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.learn import device_memory, header, machines, policy
from mjx_nero.learn.learner import Learner
from mjx_nero.learn.play import rollout
from mjx_nero.runs import compiled, console, resume, signals, starts, track, trust, videos
from mjx_nero.runs import folder as run_folder
from mjx_nero.runs.cfg import RunCfg, fit_machine, learner_cfg, resolve
from mjx_nero.runs.checkpoints import Checkpoints, NotWritten, saved
from mjx_nero.runs.compiled import Compiled
from mjx_nero.runs.helpers import ALONE, Helpers
from mjx_nero.runs.logs import Logs
from mjx_nero.runs.loop import Loop, Tally
from mjx_nero.runs.programs import Programs

__all__ = ["RunCfg", "carry_out", "describe", "film", "fit_machine", "learner_cfg", "prepare", "resolve", "speaker", "train"]


@dataclasses.dataclass(frozen=True)
class Ended:
    """The end of a run's loop: why (``finished``, ``time limit``, ``interrupted``), the exit status, and what the logs lost."""

    why: str
    code: int
    lost: dict[str, int]


def train(run: RunCfg, command: str = "train.py", helpers: Helpers = ALONE) -> dict[str, Any]:
    """Trains a policy and leaves all results in the run folder; returns the summary, the folder and an exit status.

    Args:
        command: the user's command, for the hint on how to resume.
        helpers: processes that help the start (see ``apart.begin``).

    Raises:
        UserError: something that the user can fix: impl, folder, checkpoint, sizes.
        signals.Signalled: a signal came before training began.
    """
    say = speaker()
    run, note = fit_machine(run)
    learner = compiled.make_learner(run)
    device_memory.check(learner)
    meta = describe(run, learner)
    goes_on = run.restore is not None and run.restore.is_dir() and run.out in (None, run.restore)
    path = run.restore if goes_on else run.out
    with run_folder.claim(path, run.env_name, goes_on or run.auto) as folder:
        source = _source(run, meta, say)
        tally = _tally(source) if source and goes_on else Tally()
        if over := _over(run, tally):
            if not run.auto:
                raise UserError(f"{folder} {over}")
            say(f"{folder} {over}: nothing is left to do")
            if (folder / run_folder.SUMMARY).exists():
                return {**_summary(folder), "folder": str(folder), "code": 0}
            return _finish(run, learner, tally, Ended("finished", 0, {}), folder)
        if note:
            say(note)
        if goes_on and (changes := resume.overridden(folder, run)):
            say(f"{folder} resumes with {changes}")
        programs = Programs(run, learner)
        fresh = compiled.Fresh(learner, starts.Maker(learner, say, source is None, helpers.expert), programs)
        begin = functools.partial(resume.state, source, fresh, run.seed)
        trace = functools.partial(fresh.trace, run.seed) if source is None else None
        made = prepare(run, learner, begin, folder, programs, trace, helpers.kernels)
        return carry_out(run, made, tally, meta, folder, command)


def _summary(folder: pathlib.Path) -> dict[str, Any]:
    """Reads the summary of an ended run.

    Raises:
        UserError: the file is damaged.
    """
    path = files.inside(folder, run_folder.SUMMARY)
    found = files.read_json(path)
    kinds = {"env_steps": int, "train_s": float, "steps_per_s": float, "nan_count": int, "overflow_count": int}
    try:
        for name, kind in kinds.items():
            values.read(kind, found[name], name)
        values.read(Share, found["evaluation"]["success_rate"], "evaluation.success_rate")
        values.read(Mapping[str, int], found["lost"], "lost")
        if "best" in found:  # runs of version 0.5 have none
            values.read(Share, found["best"]["success_rate"], "best.success_rate")
            values.read(int, found["best"]["env_steps"], "best.env_steps")
    except (UserError, KeyError, TypeError) as error:
        raise UserError(f"{path} is damaged ({error}): remove it") from None
    return found


def speaker() -> Callable[[str], None]:
    """Returns a function that prints a line on stderr, in the first process only."""
    return functools.partial(console.line, console.screen(stderr=True, quiet=not machines.first()))


def describe(run: RunCfg, learner: Learner) -> dict[str, Any]:
    """Describes a run for its files."""
    meta = policy.describe(learner.env.unwrapped, run.env_name, run.preset, run.learner, learner.describe())
    return {**meta, "num_envs": run.num_envs}


def prepare(
    run: RunCfg,
    learner: Learner,
    start: Callable[[], Any],
    folder: pathlib.Path,
    programs: Programs,
    trace: compiled.Trace | None,
    kernels: BaseProcess | None = None,
) -> Compiled:
    """Compiles a run's programs and makes its first state. See ``compiled.compile``."""
    iterations = -(-run.num_timesteps // learner.steps_per_iteration)
    chunk = min(iterations, 20 if jax.default_backend() != "cpu" else 2)
    with console.screen(stderr=True).status(console.compiling(learner.env.unwrapped.impl, jax.default_backend() == "cpu")):
        made = compiled.compile(run, learner, chunk, start, programs, trace, kernels)
    spread = f" on {learner.num_devices} devices" if learner.num_devices > 1 else ""
    speaker()(f"{folder}: compiled in {made.seconds:.0f} s; {learner.env.unwrapped.impl}, {run.num_envs} environments{spread}")
    return made


def carry_out(
    run: RunCfg, made: Compiled, tally: Tally, meta: dict[str, Any], folder: pathlib.Path, command: str
) -> dict[str, Any]:
    """Trains from ``made.state``, leaves all results in the folder, and returns what ``train`` returns.

    Args:
        tally: the counts of the run so far.
        meta: result of ``describe``.

    Raises:
        UserError: training diverged, or a checkpoint could not be written.
    """
    say = speaker()
    tally.steps = int(made.state.iteration) * made.learner.steps_per_iteration
    if machines.first():
        run_folder.begin(folder, config.to_dict(run))
        trust.mark(folder)
    go_on = f"resume with: {command} --restore {folder}"
    try:
        ended = _loop(run, made, tally, meta, folder)
    except NotWritten as error:
        last = next(iter(saved(folder)), None)
        there = f"; the last good checkpoint is {last}. Make room and {go_on}"
        none = f" without a checkpoint. Make room, remove {folder} and start again"
        raise UserError(f"{error}: stopped at {tally.steps:,} steps{there if last else none}") from None
    if ended.why == "interrupted":
        say(f"stopped at {tally.steps:,} steps, all saved; {go_on}")
    return _finish(run, made.learner, tally, ended, folder, made.seconds)


def film(run: RunCfg, folder: pathlib.Path, video: videos.VideoCfg) -> None:
    """Plays a run's policy in MuJoCo's C library and draws its episodes to ``video.mp4``. If it cannot, it says so.

    Args:
        run: the run's config.
    """
    screen = console.screen(stderr=True)
    env = ManipulationEnv(run.env.uncorrupted(), impl="native")
    trained = policy.load(folder / "policy.safetensors")
    act = rollout.runner(env, lambda params, obs, _: trained.act(obs), video.episodes, record=video.episodes)
    try:
        with console.drawing(screen, "video.mp4") as update:
            played = act(None, run.seed)
            path, what = folder / "video.mp4", (played.qpos, played.scenery)
            videos.write_episodes(path, env.mj_model, *what, env.dt, video, update, played.pictures)
    except UserError as error:
        console.line(screen, str(error))


def _source(run: RunCfg, meta: dict[str, Any], say: Callable[[str], None]) -> resume.Source | None:
    """Finds and checks what a run resumes from; None if nothing."""
    if run.restore is None:
        return None
    try:
        source = resume.find(run.restore, say)
    except UserError:
        if not run.auto:
            raise
        say(f"warning: no checkpoint of {run.restore} is intact: starting again")
        return None
    resume.check(source, meta)
    return source


def _tally(source: resume.Source) -> Tally:
    """Reads the counts in a checkpoint."""
    try:
        return Tally(**source.meta.get("tally", {}))
    except TypeError:  # fields of another version
        raise header.damaged(source.path) from None


def _over(run: RunCfg, tally: Tally) -> str:
    """Says why nothing of a run is left to do; empty if something is."""
    if tally.steps >= run.num_timesteps:
        return f"has already made its {tally.steps:,} steps: pass a larger --num-timesteps"
    if 0 < 60 * run.max_minutes <= tally.wall_s:
        return f"has already used its {run.max_minutes:g} minutes: pass a larger --max-minutes"
    return ""


def _loop(run: RunCfg, made: Compiled, tally: Tally, meta: dict[str, Any], folder: pathlib.Path) -> Ended:
    """Runs the loop, with checkpoints and logs."""
    screen, say = console.screen(stderr=True, quiet=not machines.first()), speaker()
    checkpoints = Checkpoints(folder, run.keep, machines.first())
    logs = Logs(folder, say, machines.first(), track.tracker(run, folder) if machines.first() else None)

    def back() -> tuple[Any, Tally]:
        source = resume.find(folder, say)
        return resume.state(source, compiled.Fresh(made.learner), run.seed), _tally(source)

    try:
        with (
            device_memory.out_of_memory_as_user_error(made.learner),
            signals.after_this(say) as stop,
            console.Show(screen, run.num_timesteps, run.max_minutes) as show,
        ):
            why = Loop(run, made, tally, meta, checkpoints, logs, back, say, show, stop)(made.state)
    finally:
        checkpoints.close()
        logs.close()
    return Ended(why, stop.code if why == "interrupted" else 0, logs.lost)


def _finish(
    run: RunCfg, learner: Learner, tally: Tally, ended: Ended, folder: pathlib.Path, compile_s: float = 0.0
) -> dict[str, Any]:
    """Writes the summary. Policy and checkpoints are already there."""
    summary = {
        "env": run.env_name,
        "preset": run.preset,
        "learner": run.learner,
        "seed": run.seed,
        "impl": learner.env.unwrapped.impl,
        "num_envs": run.num_envs,
        "num_devices": learner.num_devices,
        "env_steps": tally.steps,
        "compile_s": round(compile_s, 1),
        "train_s": round(tally.wall_s, 1),
        "steps_per_s": round(tally.steps_per_s),
        "seconds_to_95": tally.seconds_to_95,
        "steps_to_95": tally.steps_to_95,
        "nan_count": tally.nan_count,
        "overflow_count": tally.overflow_count,
        "rewound_at": tally.rewound_at,
        "stopped": ended.why,
        "lost": ended.lost,
        "evaluation": tally.evaluation,
        "best": {"success_rate": tally.best_success, "env_steps": tally.best_steps},
        "device": jax.devices()[0].device_kind,
    }
    if machines.first():
        files.write_json(folder / run_folder.SUMMARY, summary)
    return {**summary, "folder": str(folder), "code": ended.code}
