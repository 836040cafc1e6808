"""The command ``inspect``; the package ``inspection`` is its library."""

import dataclasses
import json
import pathlib
from collections.abc import Sequence
from typing import Any

from mjx_nero import config, files
from mjx_nero.envs.task import EnvCfg
from mjx_nero.runs import console
from mjx_nero.sim.scene import SimCfg
from mjx_nero.tools import cli


def main(argv: Sequence[str]) -> None:
    """The command line of ``inspect``."""
    parser = _parser()
    args, dotted = parser.parse(argv, ("env",))
    if args.object is not None:
        if args.name is not None:
            parser.error(f"--object shows an object alone: leave out {args.name}")
        return _thing(args)
    if "scale" in parser.given(argv):
        parser.error("--scale is for --object: pass it, too")
    if dotted["env"] and not args.cameras:
        parser.error("fields of the environment only affect its cameras: pass --cameras FILE, too")
    if args.name is None and args.robot is None:
        parser.error("name a robot, an environment or the folder of an imported robot")
    from mjx_nero.tools import self_test  # with Brax and MJX, which help does without
    from mjx_nero.tools.inspection import find, inspect, move_table, moves, picture, tables

    what = (args.name, args.preset, args.robot) if args.name else (args.robot, args.preset, None)
    robot, cfg = find(*what)
    report, screen = inspect(*what), console.screen()
    for view in tables(report):
        screen.print(view)
    moved = moves(robot, cfg.sim if cfg else SimCfg()) if args.move else ()
    if moved:
        screen.print(move_table(moved))
    tested = None
    if args.self_test and robot.folder and not cfg:
        cli.setup_jax()
        tested = self_test.run(robot)
        console.line(screen, tested.line, "green" if tested.passed else "yellow")
    if args.render:
        _draw(screen, "picture", args.render, picture(robot, cfg))
    if args.cameras:
        if cfg is None:
            parser.error("--cameras needs an environment whose states it can show: name one")
        _see(config.override(cfg, dotted["env"]), args.cameras)
    if args.json:
        content: dict[str, Any] = {**dataclasses.asdict(report), "moves": [dataclasses.asdict(m) for m in moved]}
        content |= {"self_test": tested.json()} if tested else {}
        with files.whole(args.json) as part:
            part.write_text(json.dumps(content, indent=2) + "\n")
        console.wrote(screen, "json", args.json)


def _parser() -> cli.Parser:
    parser = cli.Parser("inspect", "Shows what a robot or an environment is made of.")
    parser.add_load()
    parser.add_argument("name", nargs="?", help="robot, environment, or folder of an imported robot")
    parser.add_argument("--preset", help="preset of the environment (default: the first)")
    parser.add_argument("--robot", help="robot in the environment, or to inspect alone: a name, or the folder of an imported one")
    parser.add_argument("--object", metavar="FILE", help="show a mesh object instead: a file, a folder or a name")
    parser.add_argument("--scale", type=cli.positive_float, default=1.0, help="scale of --object's lengths")
    parser.add_argument("--no-self-test", dest="self_test", action="store_false", help="skip the self-test of an imported robot")
    parser.add_argument("--move", action="store_true", help="move every joint to its limits, and open and close the gripper")
    parser.add_argument("--render", type=cli.output(".png"), metavar="FILE", help="write a PNG of the robot at home")
    parser.add_argument(
        "--cameras", type=cli.output(".png"), metavar="FILE", help="write a PNG of the cameras' views (takes --env.*)"
    )
    parser.add_argument(
        "--json",
        type=cli.output(".json", marks=('"masses"', '"rests"')),
        metavar="FILE",
        help="write everything as JSON, for programs",
    )
    return parser


def _thing(args) -> None:
    from mjx_nero.tools.inspection import things

    found, screen = things.of(args.object, args.scale), console.screen()
    for view in things.tables(found):
        screen.print(view)
    if args.render:
        _draw(screen, "picture", args.render, things.picture(found))
    if args.json:
        files.write_json(args.json, dataclasses.asdict(found))
        console.wrote(screen, "json", args.json)


def _see(cfg: EnvCfg, path: pathlib.Path) -> None:
    from mjx_nero.tools.inspection import cameras

    cli.setup_jax()
    seen, screen = cameras.see(cfg), console.screen()
    screen.print(cameras.table(seen))
    _draw(screen, "cameras", path, cameras.sheet(seen))


def _draw(screen: console.Console, what: str, path: pathlib.Path, image: Any) -> None:
    """Writes a picture and says where it is."""
    import imageio.v3 as imageio

    with files.whole(path) as part:
        imageio.imwrite(part, image)
    console.wrote(screen, what, path)
