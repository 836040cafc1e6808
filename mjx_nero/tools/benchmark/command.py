"""The command line of ``benchmark``: what to measure, and where the rows go."""

import argparse
import dataclasses
import pathlib
import re
import shlex
import sys
import time
from collections.abc import Sequence
from typing import Any

from mjx_nero import config, files
from mjx_nero.errors import UserError
from mjx_nero.learn import learner as learners
from mjx_nero.runs import cfg as run_cfg
from mjx_nero.runs import console
from mjx_nero.sim.physics import impls
from mjx_nero.tasks import registry
from mjx_nero.tools import cli, config_help
from mjx_nero.tools.benchmark import SIZES, machine, plot
from mjx_nero.tools.benchmark.machine import Row

WHATS = {
    "physics": "random actions into the bare physics",
    "step": "random actions in the auto-resetting training environment",
    "ppo": "training, end to end",
    "control": "the task's controller",
    "reset": "batched resets",
    "render": "frames of the offscreen renderer",
    "learning": "seeds trained until they succeed",
    "start": "everything before the first training step, in a separate process",
    "ik": "inverse kinematics",
}
_ENDS = ("_min", "_max")
_ON_DEVICES = ("ppo", "learning")  # what --num-devices spreads
_COUNTS = ("nan_count", "overflow_count")
_MEMORY = ("compile_s", "memory_mb", "device_peak_mb", "warp_mb")
_TABLES: dict[tuple[str, ...], tuple[str, ...]] = {  # what -> columns of the table that shows it
    ("physics", "step", "ppo", "control"): (
        *("what", "controller", "impl", "num_envs", "env_steps_per_s", "physics_steps_per_s"),
        *(*_MEMORY, "success_rate", *_COUNTS),
    ),
    ("reset",): ("what", "impl", "num_envs", "resets_per_s", *_MEMORY),
    ("render",): ("what", "gl", "width", "height", "frames_per_s"),
    ("learning",): (*("impl", "num_envs", "seed", "reached", "seconds", "evaluation_s", "env_steps", "success_rate", *_COUNTS),),
    ("start",): ("impl", "num_envs", "caches", "stage", "begins_s", "seconds", "compiled"),
    ("ik",): (*("solver", "batch", "ms_per_batch", "solves_per_s", "success", "error_mm", "error_mrad", "compile_s"),),
}


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = _parser()
    args, dotted = parser.parse(argv, lambda: ("env", *learners.names()), _fields)
    from mjx_nero.tools.benchmark import jobs  # with Brax and MJX, which help does without

    args.learner = args.learner or registry.env_cfg(args.env, args.preset, args.robot).learner
    parser.only(dotted, learners.names(), args.learner)
    whats = cli.choices(args.what, "what", tuple(WHATS))
    if args.plot and not set(whats) & set(plot.PLOTTED):
        raise UserError(f"--plot draws only {', '.join(plot.PLOTTED)}: name one of them in --what")
    cli.setup_jax()
    cfg = config.override(registry.env_cfg(args.env, args.preset, args.robot), dotted["env"])
    head = {"env": args.env, "preset": args.preset, **({"robot": _without_folders(args.robot)} if args.robot else {})}
    here = machine.machine()
    report = {"machine": here, "versions": machine.versions(), "command": command(argv), "complete": False}
    title = f"{', '.join(head.values())} on {machine.name(here)}"
    kept = _kept(args.json, report)
    todo = jobs.jobs(args, cfg, dotted.get(args.learner, {}), whats, argv, kept)
    rows: list[Row] = []
    try:
        for row in jobs.measured(todo):
            spread = {"num_devices": args.num_devices} if row["what"] in _ON_DEVICES else {}
            rows.append({**head, **row, **spread})
            print(_line(row), file=sys.stderr)
            left = [row for row in kept if row not in rows]
            _save(args.json, {**report, "rows": [*rows, *left]})  # each time: a killed process leaves what it has measured
        _save(args.json, {**report, "complete": True, "rows": rows})
    except BaseException:
        print(f"stopped after {len(rows)} rows{', which are kept' if rows else ''}", file=sys.stderr)
        raise
    finally:
        _show(title, rows)
        if args.plot and rows:
            with files.whole(args.plot) as part:
                plot.plot(rows, title, part)


def _kept(path: pathlib.Path | None, report: Row) -> list[Row]:
    """Returns the seeds that the same command measured on this machine before it was interrupted."""
    if path is None or not path.exists():
        return []
    try:
        before = files.read_json(path)
        if {**before, "rows": None} != {**report, "rows": None}:
            return []
        return [row for row in before["rows"] if row["what"] == "learning" and isinstance(row["seed"], int)]
    except (UserError, KeyError, TypeError):
        return []


def command(argv: Sequence[str]) -> str:
    """Returns this benchmark's command line, with the folders of files removed."""
    return shlex.join(["python", "-m", "mjx_nero", "benchmark", *map(_without_folders, argv)])


def _parser() -> cli.Parser:
    parser = cli.Parser(
        "benchmark",
        "Measures the speed of this machine and how long training takes to succeed.",
        ends=cli.listed("what can be measured", WHATS),
    )
    parser.add_environment()
    parser.add_argument(
        "--num-envs",
        type=_sizes,
        help=f"list of numbers of environments (default: {','.join(map(str, SIZES))}; for learning: train.py's default)",
    )
    parser.add_argument("--learner", help="learner for ppo and learning (default: the task's own)")
    parser.add_argument("--num-devices", type=cli.positive, default=1, help="number of GPUs for ppo and learning")
    parser.add_argument("--impl", default="auto", help=f"list of physics: {', '.join(impls())}")
    parser.add_argument("--what", default="step", help="list of what to measure, see below")
    parser.add_argument("--steps", type=cli.positive, default=100, help="control steps per measurement")
    parser.add_argument("--repeats", type=cli.positive, default=5, help="number of measurements; the median is reported")
    parser.add_argument("--batch", type=_sizes, default="1,100,1000,2000,10000", help="list of ik batch sizes, in poses")
    parser.add_argument("--seeds", type=cli.positive, default=8, help="number of seeds for learning")
    parser.add_argument("--target", type=cli.share, default=0.95, help="success rate that ends learning")
    parser.add_argument("--num-timesteps", type=cli.positive, help="maximum env steps per seed (default: train.py's)")
    parser.add_argument("--eval-every", type=cli.positive, default=0, help="env steps between evaluations (default: 24 per run)")
    parser.add_argument(
        "--json",
        type=cli.output(".json", marks=('"complete"',)),
        help="write the rows, the machine and all versions as JSON; repeating the command measures only the missing seeds",
    )
    parser.add_argument("--plot", type=cli.output(".png"), help="picture of rates and memory over the number of environments")
    return parser


def _fields(args: argparse.Namespace) -> str:
    """Lists the config fields for ``--help``."""
    cfg = registry.env_cfg(args.env, args.preset, args.robot)
    name = args.learner or cfg.learner
    return config_help.listed({"env": cfg, name: run_cfg.learner_cfg(cfg, args.preset, name)})


def begin() -> None:
    """Runs the process of ``--what start``. Its first argument is the time at which it was started; the benchmark's follow."""
    from mjx_nero.runs import apart
    from mjx_nero.sim.physics import resolve_impl
    from mjx_nero.tools.benchmark import jobs, start

    imported, spawned, argv = time.time(), float(sys.argv[1]), sys.argv[2:]
    args, dotted = _parser().parse(argv, lambda: ("env", *learners.names()), _fields)
    cli.setup_jax()
    cfg = config.override(registry.env_cfg(args.env, args.preset, args.robot), dotted["env"])
    args.learner = args.learner or cfg.learner
    run = jobs.run_of(args, dotted.get(args.learner, {}), cfg, args.impl, (args.num_envs or [0])[0])
    helpers = apart.begin(run)
    run, _ = run_cfg.fit_machine(dataclasses.replace(run, impl=resolve_impl(run.impl)))
    start.begin(spawned, imported, run, helpers)


def _sizes(values: str) -> list[int]:
    return list(dict.fromkeys(cli.positive(n) for n in values.split(",")))


def _without_folders(word: str) -> str:
    return re.sub(r"[^=]*/(?=[^/=])", "", word).rstrip("/")


def _line(row: Row) -> str:
    """Formats a row as one line."""
    return "  ".join(f"{name} {_cell(row, name)}" for name in row if row[name] is not None and not name.endswith(_ENDS))


def _cell(row: Row, name: str) -> str:
    """Formats a value, with its range if the row has one; for a row about several seeds, median and worst."""
    if f"{name}_median" in row:
        return ", ".join(f"{which} {_text(row[f'{name}_{which}'])}" for which in ("median", "worst"))
    if name == "reached" and "seeds" in row:
        return f"{row['reached']} of {row['seeds']}"
    if row.get(name) is None:
        return ""
    low, high = (row.get(name + end) for end in _ENDS)
    text = _text(row[name])
    return text if low is None else f"{text} ({_text(low)} to {_text(high)})"


def _text(value: Any) -> str:
    if value is None:
        return "never"
    return f"{value:,}" if isinstance(value, int) and not isinstance(value, bool) else str(value)


def _save(path: pathlib.Path | None, report: dict[str, Any]) -> None:
    if path:
        files.write_json(path, report)


def _show(title: str, rows: list[Row]) -> None:
    """Prints one table per kind of row, with the columns that at least one row fills."""
    for whats, columns in _TABLES.items():
        part = [row for row in rows if row["what"] in whats]
        if not part:
            continue
        filled = [name for name in (*columns, "note") if any(_cell(row, name) for row in part)]
        view = console.Table(title, filled, left=("note",))
        for row in part:
            view.add(*(_cell(row, name) for name in filled))
        console.screen().print(view)
