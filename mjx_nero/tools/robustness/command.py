"""The command ``robustness``."""

import dataclasses
import math
import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np

import mjx_nero
from mjx_nero import config, files
from mjx_nero.errors import UserError
from mjx_nero.runs import console
from mjx_nero.tasks import registry
from mjx_nero.tools import cli, config_help
from mjx_nero.tools.robustness import sweeps

STEP = "physics step [factor]"
_LARGEST = 1 << 20  # maximum size of a results file [bytes]


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = cli.Parser(
        "robustness", "Measures a policy's success over the range of each world parameter, one at a time and all at once."
    )
    parser.add_environment()
    parser.add_argument("--policy", type=cli.path(), help="policy file (default: the bundled policy)")
    parser.add_argument("--episodes", type=cli.at_most(100_000), default=200, help="episodes per setting")
    parser.add_seed(90210)
    parser.add_impl()
    parser.add_argument(
        "--only", action="append", default=[], metavar="TEXT", help="only parameters whose names contain this text; repeatable"
    )
    parser.add_argument("--json", type=cli.output(".json", marks=('"curves"',)), help="write the results as JSON")
    parser.add_argument("--plot", type=cli.output(".png", ".pdf", ".svg"), help="plot the curves to this file")
    parser.add_argument(
        "--beside", type=cli.path(".json"), help="with --plot: results of another policy (from --json) to plot as well"
    )
    args, dotted = parser.parse(argv, ("env",), config_help.of_environment)
    if args.beside and not args.plot:
        raise UserError("--beside adds curves to the plot: pass --plot, too")
    other = read(args.beside) if args.beside else None
    if other and other["env"] != args.env:
        raise UserError(
            f"{args.beside} holds results of {other['env']}, and this is {args.env}: give results of the same environment"
        )
    cfg = config.override(registry.env_cfg(args.env, args.preset, args.robot), dotted["env"])
    names = [name for name in (*sweeps.sweeps(cfg), STEP) if not args.only or any(text in name for text in args.only)]
    if not names:
        raise UserError(
            f"no parameter has {' or '.join(args.only)} in its name: choose from {', '.join(sweeps.sweeps(cfg))}, {STEP}"
        )
    cli.setup_jax()
    result = measure(args, cfg, names)
    screen = console.screen()
    screen.print(table(result))
    if args.json:
        files.write_json(args.json, result)
        console.wrote(screen, "figures", args.json)
    if args.plot:
        save_plot(args.plot, [result, *filter(None, (other,))])
        console.wrote(screen, "curves", args.plot)


def measure(args: Any, cfg: Any, names: Sequence[str]) -> dict[str, Any]:
    """Measures success over the parameters ``names``; returns plain JSON."""
    from mjx_nero.tools.robustness.measure import Bench

    def bench_of(cfg: Any) -> Bench:
        return Bench(args.env, args.preset, cfg, args.policy, args.episodes, args.impl, args.seed)

    curves: dict[str, list[dict[str, Any]]] = {}
    bench = bench_of(cfg)
    for name, points in sweeps.sweeps(cfg).items():
        if name in names:
            curves[name] = [{"value": value, **bench.success(point)} for value, point in points]
            _progress(name, curves[name])
    if STEP in names:
        curves[STEP] = []
        for factor, decimation in ((0.5, 2 * cfg.sim.decimation), (2.0, cfg.sim.decimation // 2)):
            if decimation:
                other = dataclasses.replace(cfg, sim=dataclasses.replace(cfg.sim, dt=factor * cfg.sim.dt, decimation=decimation))
                curves[STEP].append({"value": factor, **bench_of(other).success(sweeps.Point())})
        _progress(STEP, curves[STEP])
    return {
        "env": args.env,
        "preset": args.preset,
        "policy": args.policy and args.policy.name,
        "backend": bench.env.backend,
        "episodes": args.episodes,
        "seed": args.seed,
        "version": mjx_nero.__version__,
        "curves": curves,
    }


def _progress(name: str, curve: Sequence[dict[str, Any]]) -> None:
    shares = ", ".join(f"{point['value']:g}: {point['success_rate']:.1%}" for point in curve)
    console.line(console.screen(stderr=True), f"{name}: {shares}")


def table(result: dict[str, Any]) -> console.Table:
    """Makes a table with one row per setting."""
    title = f"{result['env']} · {result['backend']} · {result['episodes']} episodes a setting"
    view = console.Table(title, ("parameter", "value", "success", "95% interval"))
    for name, curve in result["curves"].items():
        for point in curve:
            low, high = point["success_rate_95"]
            view.add(name, f"{point['value']:g}", f"{point['success_rate']:.1%}", f"{low:.1%} to {high:.1%}")
    return view


def read(path: pathlib.Path) -> dict[str, Any]:
    """Reads results written by ``--json``. The file is not trusted.

    Raises:
        UserError: it holds no results, or cannot be read.
    """
    found = files.read_json(path, _LARGEST)
    try:
        return {
            **{name: str(found[name]) for name in ("env", "preset", "version")},
            "policy": found.get("policy") and str(found["policy"]),
            "curves": {
                str(name): [
                    {**{k: float(point[k]) for k in ("value", "success_rate")}, "success_rate_95": _interval(point)}
                    for point in curve
                ]
                for name, curve in found["curves"].items()
            },
        }
    except (ValueError, TypeError, KeyError, AttributeError):
        raise UserError(f"{path} holds no results of robustness: give a file written with --json") from None


def _interval(point: Any) -> tuple[float, float]:
    low, high = map(float, point["success_rate_95"])
    return low, high


def save_plot(path: pathlib.Path, results: Sequence[dict[str, Any]]) -> None:
    """Plots success with its intervals, one panel per parameter of the first result, for all results."""
    from matplotlib.figure import Figure

    first, *_ = results
    what = "preset" if len({result["preset"] for result in results}) == len(results) else "policy"
    columns = min(4, len(first["curves"]))
    rows = math.ceil(len(first["curves"]) / columns)
    figure = Figure(figsize=(3.2 * columns, 0.6 + 2.3 * rows), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharey=True).ravel()
    for panel, name in zip(panels, first["curves"], strict=False):
        for color, result in zip(("tab:blue", "tab:orange"), results, strict=False):
            curve = result["curves"].get(name, [])
            values, rates = [p["value"] for p in curve], [p["success_rate"] for p in curve]
            panel.plot(values, rates, marker="o", markersize=3, color=color, label=result[what] or "bundled policy")
            panel.fill_between(values, *np.array([p["success_rate_95"] for p in curve]).reshape(-1, 2).T, color=color, alpha=0.2)
        panel.set_title(name, loc="left", fontsize=9)
        panel.set_ylim(-0.02, 1.02)
        panel.grid(alpha=0.3)
    if len(results) > 1:
        panels[0].legend(fontsize=8, loc="lower left")
    for panel in panels[len(first["curves"]) :]:
        panel.set_axis_off()
    figure.suptitle(f"success of {first['env']}, version {first['version']}", x=0.01, ha="left")
    with files.whole(path) as part:
        figure.savefig(part, dpi=110)
