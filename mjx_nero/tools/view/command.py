"""The command line of ``view``."""

import pathlib
from collections.abc import Sequence

from mjx_nero.errors import UserError
from mjx_nero.tools import cli, config_help


def main(argv: Sequence[str]) -> None:
    """The command line.

    Raises:
        UserError: a name is unknown, a policy does not fit, the extra ``view`` is missing, or the port is taken.
    """
    parser = cli.Parser("view", "Shows environments in a browser, where you can watch them and take part.")
    parser.add_environment()
    parser.add_argument(
        "--policy", type=cli.path(), action="append", default=[], help="policy or checkpoint to choose from; repeatable"
    )
    parser.add_argument(
        "--agent", help="agent that acts first: expert, a controller, zero, random or 'joint sliders' (default: a policy)"
    )
    parser.add_argument("--run", type=pathlib.Path, metavar="FOLDER", help="run folder to follow: play its newest checkpoint")
    parser.add_argument(
        "--demos",
        type=cli.path(),
        metavar="DIR",
        help="new or existing data set to record your own demonstrations into",
    )
    parser.add_argument(
        "--episode",
        type=cli.number(int),
        metavar="K",
        help="with --demos: replay episode K (from 0) in its environment",
    )
    parser.add_argument("--leader", metavar="PORT", help="serial port of a LeRobot SO-101 leader arm for the robot to follow")
    parser.add_argument(
        "--calibration", type=cli.path(".json"), help="with --leader: LeRobot's calibration file of the leader arm"
    )
    parser.add_argument("--num-envs", type=cli.at_most(100), default=1, help="number of environments side by side")
    parser.add_seed(1)
    parser.add_address()
    args, dotted = parser.parse(argv, ("env",), config_help.of_environment)
    if args.episode is not None and not args.demos:
        raise UserError("--episode selects an episode of a data set: pass --demos DIR, too")
    given = parser.given(argv)  # flags that are not given follow the run
    from mjx_nero.tools.view import leader, opening  # with Brax and MJX, which help does without

    opening.serve(
        env_name=args.env if "env" in given else None,
        preset=args.preset if "preset" in given else None,
        policies=args.policy,
        overrides=dotted["env"],
        leader=leader.at(args.leader, args.calibration) if args.leader else None,
        **{name: getattr(args, name) for name in "robot agent run num_envs seed host port demos episode".split()},
    )
