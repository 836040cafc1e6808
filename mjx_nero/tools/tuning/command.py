"""The command ``tune-gains``."""

import argparse
import dataclasses
from collections.abc import Sequence

from mjx_nero.runs import console
from mjx_nero.sim.scene import SimCfg
from mjx_nero.tasks import registry
from mjx_nero.tools import cli
from mjx_nero.tools.tuning.proposal import tune
from mjx_nero.tools.tuning.report import MARK, save_gains, save_plot, table


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = cli.Parser(
        "tune-gains", "Proposes stiffness and damping for a robot's drives, and shows step responses before and after."
    )
    parser.add_load()
    parser.add_argument("--robot", required=True, help="name of a robot, or folder of an imported one")
    parser.add_argument(
        "--out", type=cli.output(".yaml", ".yml", marks=(MARK,)), help="write the gains as YAML, for import-urdf --gains"
    )
    parser.add_argument("--plot", type=cli.output(".png", ".pdf", ".svg"), help="write a picture of the step responses")
    parser.add_argument(
        "--step",
        type=cli.positive_float,
        default=0.1,
        help="step of the target that the drives must follow within their effort [rad or m]; at most a tenth of a joint's range",
    )
    parser.add_argument(
        "--frequency", type=cli.positive_float, help="maximum natural frequency [Hz] (default: one radian per control step)"
    )
    parser.add_argument("--dt", type=cli.positive_float, default=SimCfg.dt, help="physics step [s]")
    parser.add_argument(
        "--gravity-compensation", action=argparse.BooleanOptionalAction, help="override the robot's gravity compensation"
    )
    args, _ = parser.parse(argv)
    robot = registry.robot(args.robot)
    if args.gravity_compensation is not None:
        robot = dataclasses.replace(robot, gravity_compensation=args.gravity_compensation)
    tuning = tune(robot, args.step, args.frequency, SimCfg(dt=args.dt))
    screen = console.screen()
    screen.print(*table(tuning))
    if args.plot:
        save_plot(tuning, args.plot)
        console.wrote(screen, "plot", args.plot)
    if args.out:
        save_gains(tuning, args.out)
        console.wrote(screen, "gains", args.out)
