"""The commands ``inspect`` and ``list-envs``."""

import dataclasses
import json
import pathlib
from collections.abc import Sequence
from typing import Any

import imageio.v3 as imageio

from mjx_nero import cli, run_folder
from mjx_nero.inspection.motion import moves
from mjx_nero.inspection.report import draw, environments, find, inspect
from mjx_nero.inspection.tables import environment_table, move_table, tables
from mjx_nero.scene import SimCfg
from mjx_nero.types import UserError


def main(argv: Sequence[str]) -> None:
    """The command line of ``inspect``."""
    parser = cli.Parser(prog="python -m mjx_nero inspect", description="Shows what a robot or an environment is made of.")
    parser.add_argument("name", help="robot, environment, or folder of an imported robot")
    parser.add_argument("--preset", help="of the environment (default: its first)")
    parser.add_argument("--robot", help="for the environment: name, or folder of an imported robot")
    parser.add_argument("--move", action="store_true", help="move every joint to its limits and the gripper open and closed")
    parser.add_argument("--render", type=pathlib.Path, metavar="FILE", help="PNG of the robot at home")
    parser.add_argument("--json", type=pathlib.Path, metavar="FILE", help="everything, for programs")
    args, _ = parser.parse(argv)
    for path in filter(None, (args.render, args.json)):
        run_folder.check_writable(path)
    if args.render and args.render.suffix.lower() != ".png":
        raise UserError(f"{args.render} is no PNG: give a name that ends in .png")
    robot, cfg = find(args.name, args.preset, args.robot)
    report, console = inspect(args.name, args.preset, args.robot), cli.console()
    for view in tables(report):
        console.print(view)
    moved = moves(robot, cfg.sim if cfg else SimCfg()) if args.move else ()
    if moved:
        console.print(move_table(moved))
    if args.render:
        picture = draw(robot, cfg)
        with run_folder.whole(args.render) as part:
            imageio.imwrite(part, picture)
        console.print(f"picture: {args.render}", highlight=False, soft_wrap=True)
    if args.json:
        content: dict[str, Any] = {**dataclasses.asdict(report), "moves": [dataclasses.asdict(m) for m in moved]}
        with run_folder.whole(args.json) as part:
            part.write_text(json.dumps(content, indent=2) + "\n")
        console.print(f"json: {args.json}", highlight=False, soft_wrap=True)


def list_envs_main(argv: Sequence[str]) -> None:
    """The command line of ``list-envs``."""
    cli.Parser(prog="python -m mjx_nero list-envs", description="Lists the environments.").parse(argv)
    cli.console().print(environment_table(environments()))
