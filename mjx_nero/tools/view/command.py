"""The command line of ``view``."""

import pathlib
from collections.abc import Sequence

from mjx_nero.errors import UserError
from mjx_nero.tasks import registry
from mjx_nero.tools import cli


def main(argv: Sequence[str]) -> None:
    """The command line.

    Raises:
        UserError: unknown names, a policy that does not fit, the extra ``view`` is missing, or the port is taken.
    """
    parser = cli.Parser("view", "Shows environments in a browser: watch them, and take part.")
    parser.add_environment()
    parser.add_argument("--policy", type=cli.path(), action="append", default=[], help="policy or checkpoint; repeatable")
    parser.add_argument("--agent", help="first agent: a controller, zero, random, or 'joint sliders' (default: a policy)")
    parser.add_argument(
        "--run",
        type=pathlib.Path,
        metavar="FOLDER",
        help="run folder to follow: its newest checkpoint plays",
    )
    parser.add_argument(
        "--demos",
        type=cli.path(),
        metavar="DIR",
        help="data set to record your own demonstrations into, new or old",
    )
    parser.add_argument(
        "--episode",
        type=cli.number(int),
        metavar="K",
        help="with --demos: replay episode K, counted from 0, in its environment",
    )
    parser.add_argument("--leader", metavar="PORT", help="serial port of LeRobot's SO-101 leader arm, which the robot follows")
    parser.add_argument("--calibration", type=cli.path(".json"), help="with --leader: LeRobot's calibration file of that arm")
    parser.add_argument("--num-envs", type=cli.at_most(100), default=1, help="environments side by side (default: %(default)s)")
    parser.add_seed(1)
    parser.add_address()
    args, dotted = parser.parse(argv, ("env",), lambda args: {"env": registry.env_cfg(args.env, args.preset, args.robot)})
    if args.episode is not None and not args.demos:
        raise UserError("--episode is of a data set: pass --demos DIR, too")
    given = parser.given(argv)  # else what the run says
    from mjx_nero.tools.view import leader, opening  # with Brax and MJX, which help does without

    opening.serve(
        env_name=args.env if "env" in given else None,
        preset=args.preset if "preset" in given else None,
        policies=args.policy,
        overrides=dotted["env"],
        leader=leader.at(args.leader, args.calibration) if args.leader else None,
        **{name: getattr(args, name) for name in "robot agent run num_envs seed host port demos episode".split()},
    )
