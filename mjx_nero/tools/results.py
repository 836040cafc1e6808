"""Makes the tables of results for all environments: python -m mjx_nero results --json results.json. See --help."""

import argparse
import dataclasses
import gc
import pathlib
import sys
from collections.abc import Iterator, Sequence
from typing import Any

from mjx_nero import files
from mjx_nero.envs.task import takes_targets
from mjx_nero.errors import UserError
from mjx_nero.learn import bundled
from mjx_nero.runs import console
from mjx_nero.tasks import registry
from mjx_nero.tools import cli

Row = dict[str, Any]
WHATS = {"learning": "seeds trained by the default command until they succeed", "policies": "the bundled policies"}
SEEDS = "seeds"  # key of the seeds of an environment whose training is not complete
KINDS = ("learning", SEEDS, "native", "warp")  # keys of an environment's results
MARKS = tuple(f'"{kind}": {{' for kind in KINDS)
EVALUATIONS = 48  # evaluations of a seed that needs all of its env steps
_COLUMNS = ("environment", "target", "seeds", "seconds", "env steps", "policy in MuJoCo C", "policy on Warp", "measured with")
_PAGE = """# Benchmarks

Success rates of the bundled policies and training times, one table per task. One command writes this page from the figures in
[{json}]({json}):
```
python -m mjx_nero results --json docs/{json} --markdown docs/{page} --what none
```
Without `--what none`, the command first measures everything that the machine can, which takes hours on a GPU.
`--what policies --envs nero_lift` measures the policy of one environment, and `--preset sim2real` that of a preset. Times
count only if nothing else runs on the GPU.

- **policy**: success rate of the bundled policy, with its 95% Wilson interval.
- **seeds**: how many seeds of the default training reached the target.
- **seconds**, **env steps**: how long these seeds took, with evaluations but without compilation.

A table has no column for what nobody has measured yet.
"""


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = cli.Parser(
        "results",
        "Measures how every environment learns and what the bundled policies achieve, and writes the tables of results.",
        ends=cli.listed("what can be measured", WHATS),
    )
    parser.add_load()
    parser.add_argument(
        "--json", type=cli.output(".json", marks=MARKS), required=True, help="file of results; new ones are added to it"
    )
    parser.add_argument(
        "--markdown",
        type=cli.output(".md", marks=("mjx_nero results",)),
        help="write all results in the JSON file as a page, one table per task",
    )
    parser.add_argument(
        "--what", help=f"list of {', '.join(WHATS)}, or none to only show the table (default: all)", default=",".join(WHATS)
    )
    parser.add_argument("--envs", help="list of environments (default: all that can be trained)")
    parser.add_argument("--preset", default="default", help="preset to train, or whose policies to measure")
    parser.add_argument("--seeds", type=cli.positive, default=8, help="seeds per environment")
    parser.add_argument("--episodes", type=cli.at_most(1_000_000), default=1000, help="episodes per policy")
    args, _ = parser.parse(argv)
    whats = [] if args.what == "none" else cli.choices(args.what, "what", WHATS)
    held = read(args.json)
    envs = cli.choices(args.envs, "env", registry.list_envs()) if args.envs else learnable()
    envs = [env for env in envs if args.preset in registry.list_presets(env)]
    if not envs:
        raise UserError(f"none of these environments has the preset {args.preset!r}: pass another --preset or other --envs")
    cli.setup_jax()
    from mjx_nero.tools.benchmark import machine

    measured_with = {"version": machine.versions()["mjx-nero"], "machine": machine.name(machine.machine())}
    for what in whats:
        for env in envs:
            shown = named(env, args.preset)
            kinds = held.setdefault(shown, {})
            found = _learning(env, args, kinds.get(SEEDS), measured_with) if what == "learning" else _policies(env, args)
            for name, row in found:
                kinds[name] = row | measured_with
                if name == "learning":
                    del kinds[SEEDS]
                files.write_json(args.json, held)  # each time: a killed process leaves what it has measured
                print(f"{shown}  {name}  {_said(name, row)}", file=sys.stderr)
            gc.collect()
    cells = list(rows(held))
    table = console.Table("results", _COLUMNS, left=("measured with",))
    for line in cells:
        table.add(*line)
    console.screen().print(table)
    if args.markdown:
        files.write(args.markdown, page(cells, args.json.name, args.markdown.name).encode())


def learnable() -> list[str]:
    """Lists the environments that have a robot of their own and actions for policies."""
    cfgs = {name: registry.env_cfg(name) for name in registry.list_envs() if registry.robot_of(name) is not None}
    return [name for name, cfg in cfgs.items() if not takes_targets(cfg)]


def named(env: str, preset: str) -> str:
    """Returns the key of a preset's results: ``nero_lift`` for the default preset, ``nero_lift sim2real`` for another."""
    return env if preset == "default" else f"{env} {preset}"


def read(path: pathlib.Path) -> dict[str, dict[str, Row]]:
    """Reads the results by environment and kind; empty if there is no file yet.

    Raises:
        UserError: the file was not written by this command.
    """
    if not path.exists():
        return {}
    try:
        held = files.read_json(path)
        list(rows(held))
    except (UserError, ValueError, TypeError, KeyError, AttributeError):
        raise UserError(f"{path} holds no results: name another file") from None
    return held


def _learning(env: str, args: argparse.Namespace, before: Row | None, here: Row) -> Iterator[tuple[str, Row]]:
    """Trains all seeds of an environment with the settings of ``train.py --env``. Yields the seeds so far after each of them,
    then their summary.

    Args:
        before: seeds that an interrupted command kept. They count if settings, version and machine are the same.
        here: this version and machine.
    """
    from mjx_nero.runs import cfg as run_cfg  # with Brax and MJX, which help does without
    from mjx_nero.tools.benchmark import learning

    run, _ = run_cfg.fit_machine(run_cfg.resolve(env, args.preset, None, {}, {}))
    run = dataclasses.replace(run, eval_every=run.num_timesteps // EVALUATIONS)
    asked = {
        "preset": args.preset,
        "num_envs": run.num_envs,
        "num_timesteps": run.num_timesteps,
        "target": run.env.budget.success,
    }
    same = before is not None and {**before, "rows": None} == {**asked, **here, "rows": None}
    rows: list[Row] = []
    for row in learning.measure_learning(run, args.seeds, run.env.budget.success, before["rows"] if before and same else ()):
        if row["seed"] == "all":
            yield "learning", row
        else:
            rows.append(row)
            yield SEEDS, {**asked, "rows": rows}


def _policies(env: str, args: argparse.Namespace) -> Iterator[tuple[str, Row]]:
    """Measures the preset's bundled policy in MuJoCo's C library and, if there is a GPU, on Warp."""
    from mjx_nero.runs import evaluation, signals
    from mjx_nero.sim.physics import warp_available

    path = bundled.shipped(env, args.preset)
    if not path.exists() or args.preset != "default" and path == bundled.shipped(env):
        return
    backends = {"native": "mujoco"} | ({"warp": "mjx"} if warp_available() else {})
    for name, backend in backends.items():
        cfg = evaluation.EvalCfg(env, args.preset, agent="policy", episodes=args.episodes, backend=backend)
        with signals.ended():
            result = evaluation.play(cfg).result
        yield name, {n: result[n] for n in ("success_rate", "success_rate_95", "episodes", "nan_count", "overflow_count")}


def rows(held: dict[str, dict[str, Row]]) -> Iterator[tuple[str, ...]]:
    """Returns the table's cells, one row for each environment."""
    for env, kinds in held.items():
        learnt, native, warp = (kinds.get(name) for name in ("learning", "native", "warp"))
        if not (learnt or native or warp):
            continue  # training is not complete
        of = dict.fromkeys(f"{row['version']}, {row['machine']}" for row in (learnt, native, warp) if row)
        spread = [""] * 4
        if learnt:
            spread = [
                f"{learnt['target']:.0%}",
                _seeds(learnt),
                _spread(learnt, "seconds"),
                _spread(learnt, "env_steps", 1e-6, " M"),
            ]
        yield (env, *spread, _success(native), _success(warp), "; ".join(of))


def page(cells: Sequence[tuple[str, ...]], json_name: str, page_name: str) -> str:
    """Returns a page of Markdown: the meaning of the columns, then one table for each task."""
    tasks: dict[str, list[tuple[str, ...]]] = {}
    for line in cells:
        tasks.setdefault(task_of(line[0]), []).append(line)
    parts = [f"\n## {task}\n{_table(lines)}" for task, lines in tasks.items()]
    return _PAGE.format(json=json_name, page=page_name) + "".join(parts)


def task_of(env: str) -> str:
    """Returns the task's name, which is the environment's without the arm's: ``lift_obstacles`` for ``nero_lift_obstacles``."""
    env, *preset = env.split(" ")
    names = [name for name in registry.list_envs() if registry.robot_of(name) is None and env.endswith(f"_{name}")]
    return " ".join([max(names, key=len, default=env), *preset])


def _table(lines: Sequence[tuple[str, ...]]) -> str:
    """Writes a table without its empty columns."""
    shown = [i for i in range(len(_COLUMNS)) if any(line[i] for line in lines)]
    rows = [_COLUMNS, ("---",) * len(_COLUMNS), *lines]
    return "".join(f"| {' | '.join(row[i] for i in shown)} |\n" for row in rows)


def _said(name: str, row: Row) -> str:
    """Formats a measurement for the end of a log line."""
    if name == SEEDS:
        last = row["rows"][-1]
        return f"{last['seed']}: success {last['success_rate']:.3f} after {last['env_steps'] / 1e6:.1f} M steps"
    return _seeds(row) if name == "learning" else _success(row)


def _seeds(row: Row) -> str:
    return f"{row['reached']} of {row['seeds']}"


def _spread(row: Row, name: str, unit: float = 1.0, word: str = "") -> str:
    """Formats the median and the worst of the seeds."""

    def text(which: str) -> str:
        value = row[f"{name}_{which}"]
        return "never" if value is None else f"{unit * value:.1f}{word}"

    return f"median {text('median')}, worst {text('worst')}"


def _success(row: Row | None) -> str:
    if not row:
        return ""
    low, high = row["success_rate_95"]
    return f"{row['success_rate']:.1%} ({100 * low:.1f} to {100 * high:.1f}), {row['episodes']:,} episodes"
