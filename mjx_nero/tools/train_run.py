"""Runs ``train`` after its flags are read: starts or resumes a run, and reports its result."""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Collection, Mapping, Sequence
from typing import Any

import jax

from mjx_nero.envs.env import MAX_SPEED
from mjx_nero.errors import UserError
from mjx_nero.learn import learner, machines
from mjx_nero.runs import apart, console, resume, track, training, videos
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.runs.checkpoints import saved
from mjx_nero.runs.folder import CONFIG
from mjx_nero.tools import cli, seeds


def start(args: argparse.Namespace, dotted: Mapping[str, Mapping[str, Any]], flags: Collection[str]) -> None:
    """Trains as the flags say.

    Args:
        dotted: fields by prefix.
        flags: names of the flags that the user passed.
    """
    sizes = {k: v for k, v in (("num_envs", args.num_envs), ("num_timesteps", args.num_timesteps)) if v}
    learner.find(args.learner)
    track.check(args.track)
    if args.seeds and (args.restore or args.resume):
        raise UserError("--seeds starts new runs: to resume one, pass only --restore RUN/seed_N")
    run = training.resolve(
        args.env,
        args.preset,
        args.robot,
        dotted["env"],
        {**sizes, **dotted[args.learner]},
        auto=args.resume == "auto",
        **cli.fields(args, RunCfg),
    )
    run = going_on(run, flags, dotted, args.trust)
    helpers = apart.begin(dataclasses.replace(run, seed=args.seeds[0]) if args.seeds else run)
    if "num_devices" not in flags and machines.several():
        run = dataclasses.replace(run, num_devices=jax.local_device_count())
    if args.seeds:
        rows, folder, code = seeds.train(run, args.seeds, cli.called_as("train"), helpers)
        report_seeds(rows, folder)
        sys.exit(code)
    summary = training.train(run, cli.called_as("train"), helpers)
    if not machines.first():
        sys.exit(summary["code"])
    films = args.video and not summary["code"]
    report(summary, films)
    if films:
        video = videos.VideoCfg(args.video_size, fps=args.video_fps, envs=args.video_envs)
        training.film(run, pathlib.Path(summary["folder"]), video)
    if summary["code"]:
        sys.exit(summary["code"])


def going_on(run: RunCfg, flags: Collection[str], dotted: Mapping[str, Mapping[str, Any]], trust: bool = False) -> RunCfg:
    """Returns the run itself, or the run of the folder that it resumes.

    Raises:
        UserError: flags contradict each other or the resumed run.
    """
    folder = run.restore
    if run.auto:
        if not run.out or run.restore:
            raise UserError("--resume auto needs --out, the folder to resume or to start in, and no --restore")
        folder = run.out if saved(run.out) else None
    if folder is None or not (folder / CONFIG).is_file() or run.out not in (None, folder):
        return run
    return dataclasses.replace(resume.same_run(folder, run, flags, dotted, trust), auto=run.auto)


def report(summary: dict[str, Any], films: bool) -> None:
    """Prints a run's result."""
    pace = f"{summary['env_steps']:,} env steps in {summary['train_s']:.0f} s ({summary['steps_per_s']:,} steps/s)"
    success, best = summary["evaluation"]["success_rate"], summary.get("best")
    print(f"{pace}, success {success:.1%}")
    if best and best["success_rate"] > success:
        print(f"best.safetensors did better: {best['success_rate']:.1%}, after {best['env_steps']:,} env steps")
    names = "policy.safetensors, best.safetensors, curve.png, metrics.jsonl, checkpoints/"
    print(f"{summary['folder']}: {names}{', video.mp4 (drawn next)' if films else ''}", flush=True)
    if summary["nan_count"] or summary["overflow_count"]:
        diverged = f"{summary['nan_count']} episodes diverged and ended (NaN, or faster than {MAX_SPEED:,.0f} rad/s or m/s)"
        print(f"physics: {diverged}, {summary['overflow_count']} steps with lost contacts")
    if summary["lost"]:
        print(f"lost because the disk could not be written: {', '.join(f'{n} x {name}' for name, n in summary['lost'].items())}")


def report_seeds(rows: list[dict[str, Any]], folder: pathlib.Path) -> None:
    """Prints one row per seed, and a summary."""
    table = console.Table(
        f"{folder}", ("seed", "success", "95% interval", "s to 95%", "env steps", "s", "ended"), left=("ended",)
    )
    for row in rows:
        table.add(
            str(row["seed"]),
            f"{row['success_rate']:.1%}",
            _span(row["success_rate_95"], "{:.1%}"),
            "-" if row["seconds_to_95"] is None else f"{row['seconds_to_95']:.1f}",
            f"{row['env_steps']:,}",
            f"{row['train_s']:.0f}",
            row["stopped"],
        )
    about, screen = seeds.summary(rows), console.screen()
    screen.print(table)
    text = f"{about['reached_95']} of {about['seeds']} seeds reached 95% ({_span(about['reached_95_interval'], '{:.0%}')})"
    if about["seconds_to_95_median"] is not None:
        text += f", after {about['seconds_to_95_median']:.1f} s in the median"
    if about["seconds_to_95_interval"] is not None:
        text += f" (mean: {_span(about['seconds_to_95_interval'], '{:.1f}')})"
    text += f"; mean success {about['success_rate_mean']:.1%} ({_span(about['success_rate_interval'], '{:.1%}')})"
    console.line(screen, f"{text}. In brackets: 95% intervals")


def _span(interval: Sequence[float] | None, form: str) -> str:
    return "-" if interval is None else " to ".join(form.format(end) for end in interval)
