"""Plays and measures a policy or a controller: python eval.py --env nero_lift. See --help."""

import argparse
import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_nero import control, files
from mjx_nero.errors import UserError
from mjx_nero.runs import console, videos
from mjx_nero.runs.evaluation_cfg import EvalCfg, controller_of
from mjx_nero.tasks import registry
from mjx_nero.tools import cli, config_help

if TYPE_CHECKING:
    from mjx_nero.runs.evaluation import Played

RECORDED = 1000  # maximum number of episodes that --failures searches


def main(argv: Sequence[str]) -> None:
    """The command line."""
    args, dotted = _parser().parse(argv, ("env", "control"), _fields)
    if args.view and (args.video or args.failures or args.json):
        raise UserError("--view only shows: leave out --video, --failures and --json")
    if args.view:
        from mjx_nero.tools.view import opening

        agent = args.controller or (args.agent if args.agent != "policy" else None)
        policies = [args.policy] if args.policy else []
        return opening.serve(
            env_name=args.env,
            preset=args.preset,
            robot=args.robot,
            policies=policies,
            agent=agent,
            seed=args.seed,
            overrides=dotted["env"],
        )
    if args.failures and not args.video:
        raise UserError("--failures selects the episodes of a video: pass --video FILE.mp4, too")
    video = videos.VideoCfg(args.video_size, fps=args.video_fps, envs=args.video_envs)
    from mjx_nero.runs import evaluation  # with Brax and MJX, which help does without

    cfg = EvalCfg(
        args.env,
        **cli.fields(args, EvalCfg),
        record=RECORDED if args.failures else video.episodes if args.video else 0,
        env_fields=dotted["env"],
        control_fields=dotted["control"],
    )
    cli.setup_jax()
    played = evaluation.play(cfg)
    report(played.result)
    if args.json:
        files.write_json(args.json, played.result)
    if args.failures:
        failed = np.flatnonzero(~played.episodes.success[:RECORDED])[: video.episodes]
        if not failed.size:
            return console.line(console.screen(), "no video: no episode failed")
        played = dataclasses.replace(played, episodes=played.episodes.recorded(failed))
    if args.video:
        draw(played, args.video, video)


def _fields(args: argparse.Namespace) -> str:
    """Lists the config fields for ``--help``."""
    env = registry.env_cfg(args.env, args.preset, args.robot)
    name = controller_of(args.controller or args.agent or "policy", env.controllers) or ""
    return config_help.listed({"env": env, **({"control": control.CONTROLLERS[name][1]} if name in control.CONTROLLERS else {})})


def _parser() -> cli.Parser:
    parser = cli.Parser("eval", "Plays episodes with a policy or a controller and reports success.")
    parser.add_environment()
    parser.add_seed(1)
    parser.add_impl()
    parser.add_fields(EvalCfg)
    parser.add_argument("--video", type=cli.output(".mp4"), help="write an MP4 of up to three episodes")
    parser.add_argument("--failures", action="store_true", help="show only failed episodes in the video")
    parser.add_video()
    parser.add_argument("--json", type=cli.output(".json", marks=('"return_by_term"',)), help="write the result as JSON")
    parser.add_argument("--view", action="store_true", help="play in a browser instead, until Ctrl-C (the extra view)")
    return parser


def report(result: dict[str, Any]) -> None:
    """Prints a result as a table."""
    console.screen().print(table(result))
    if result.get("warning"):
        print(f"warning: {result['warning']}", file=sys.stderr)


def draw(played: "Played", path: pathlib.Path, cfg: videos.VideoCfg) -> None:
    """Writes the video.

    Raises:
        UserError: it cannot be drawn or written.
    """
    episodes = played.episodes
    with console.drawing(console.screen(stderr=True), path.name) as update:
        model, what = played.env.mj_model, (episodes.qpos, episodes.scenery)
        videos.write_episodes(path, model, *what, played.env.dt, cfg, update, episodes.pictures)
    console.wrote(console.screen(), "video", path)


def table(result: dict[str, Any]) -> console.Table:
    """Makes the table of a result."""
    low, high = result["success_rate_95"]
    who = result.get("controller") or result["agent"]
    title = f"{result['env']} · {who} · {result['backend']} · {result['episodes']} episodes"
    view = console.Table(title, ("", ""), left=("",))

    def figure(name: str, unit: float = 1.0, digits: int = 2) -> str:
        return "-" if result[name] is None else f"{unit * result[name]:.{digits}f}"

    view.add("success rate", f"{result['success_rate']:.1%}  (95% interval {low:.1%} to {high:.1%})")
    distances = f"{figure('final_distance_mean', 100)} cm mean, {figure('final_distance_median', 100)} cm median"
    view.add("final distance", distances)
    if "settled_error_max" in result:
        view.add(
            "error, second half", f"{figure('settled_error_mean', 100)} cm mean, {figure('settled_error_max', 100)} cm at most"
        )
    if "grasp_rate" in result:
        grasp = result["time_to_grasp_mean"]
        view.add("grasped", f"{result['grasp_rate']:.1%}" + (f", first after {grasp:.2f} s" if grasp is not None else ""))
        view.add("dropped", f"{result['dropped_rate']:.1%}")
    for file, (rate, count) in result.get("success_by_shape", {}).items():
        view.add(f"  {file}", "no episode" if rate is None else f"{rate:.1%} of {count}")
    if "touched_mean" in result:
        view.add("touched", f"{result['touched_mean']:.1%}")
    calm = figure("target_change_mean", 1000, 1), figure("joint_acc_mean", 1, 1)
    view.add("motion", f"targets move {calm[0]} mrad per control step, joints accelerate by {calm[1]} rad/s²")
    view.add("return", figure("return_mean"))
    for name, value in result["return_by_term"].items():
        view.add(f"  {name}", "-" if value is None else f"{value:.3f}")
    view.add("NaN, overflows", f"{result['nan_count']}, {result['overflow_count']}")
    if result["diverged"]:
        view.add("diverged", f"{result['diverged']} episodes: counted as failures, excluded from means")
    view.add("time", f"{result['seconds']:.1f} s, compilation included")
    return view
