"""The commands ``record`` and ``identify``."""

import argparse
from collections.abc import Sequence

from mjx_nero.deploy import drivers
from mjx_nero.identify import log as logs
from mjx_nero.identify.fit import identify
from mjx_nero.identify.plant import Plant, usual_step
from mjx_nero.identify.simulate import RecordCfg, record
from mjx_nero.runs import console
from mjx_nero.tasks import registry
from mjx_nero.tools import cli
from mjx_nero.tools.deploy import FAULT, arms
from mjx_nero.tools.identification.report import MARK, MOVEMENT, SIMULATED, save, save_plot, table

_ARM = {"port", "gripper", "calibration", "emulate", "identified", "speed", "table", "workspace", "apart", "hottest"}
_SIMULATED = {"noise", "resolution", "scatter", "offset", "delay", "seed", "rate", "dt"}


def record_main(argv: Sequence[str]) -> None:
    """The command line of ``record``."""
    parser = cli.Parser(
        "record",
        "Moves an arm by sine sweeps within its limits, and logs the targets and readings of its drives. Without --arm the "
        "arm is simulated, faster than real time; with it, the movement goes through deploy's safety layer, in real time.",
    )
    _add_robot(parser)
    parser.add_argument("--arm", choices=drivers.KINDS, help="real, emulated or simulated arm (default: none)")
    arms.add_arm(parser)
    arms.add_limits(parser)
    parser.add_argument(
        "--out",
        type=cli.output(".csv", marks=(SIMULATED, MOVEMENT)),
        required=True,
        help="log to write: a comma-separated table (docs/guides/identification.md)",
    )
    parser.add_fields(RecordCfg)
    args, _ = parser.parse(argv)
    if wrong := parser.given(argv) & (_SIMULATED if args.arm else _ARM):
        flags = ", ".join(f"--{name}" for name in sorted(wrong))
        parser.error(f"{flags}: only for {'a simulated arm, leave out --arm' if args.arm else '--arm, pass it, too'}")
    if args.arm:
        _record_arm(parser, args)
        return
    plant = _plant(args)
    log, truth = record(plant, RecordCfg(**cli.fields(args, RecordCfg)))
    notes = [
        f"{logs.ROBOT}{plant.robot.name}",
        SIMULATED,
        *(f"{name}: {value}" for name, value in _plain(truth).items()),
    ]
    logs.write(args.out, log, plant.robot.arm.joints, notes)
    console.wrote(console.screen(), "log", args.out)


def _record_arm(parser: cli.Parser, args: argparse.Namespace) -> None:
    """Records an arm.

    Raises:
        UserError: the arm cannot be reached.
        SystemExit: the arm holds because something failed.
    """
    arms.check(parser, args)
    from mjx_nero.tools.identification.arm import record_arm

    with arms.in_reach():
        failed = record_arm(args, registry.robot(args.robot))
    console.wrote(console.screen(), "log", args.out)
    if failed:
        raise SystemExit(FAULT)


def identify_main(argv: Sequence[str]) -> None:
    """The command line of ``identify``."""
    parser = cli.Parser("identify", "Fits gains, armature, friction, delay and encoder offsets of an arm's drives to a log.")
    parser.add_argument(
        "log", type=cli.path(), metavar="LOG", help="log to read: a comma-separated table (docs/guides/identification.md)"
    )
    _add_robot(parser)
    parser.add_argument(
        "--out",
        type=cli.output(".yaml", ".yml", marks=(MARK,)),
        help="write the drives as YAML, for make(identified=...) and --env.identified",
    )
    parser.add_argument("--plot", type=cli.output(".png", ".pdf", ".svg"), help="write a picture of the remaining error")
    args, _ = parser.parse(argv)
    plant = _plant(args)
    joints = plant.robot.arm.joints
    log = logs.read(args.log, joints, robot=plant.robot)
    fit = identify(plant, log)
    screen = console.screen()
    screen.print(table(joints, fit, plant.nominal))
    if args.plot:
        save_plot(args.plot, joints, log, fit)
        console.wrote(screen, "plot", args.plot)
    if args.out:
        save(args.out, plant.robot.name, args.log.name, joints, fit)
        console.wrote(screen, "drives", args.out)


def _add_robot(parser: cli.Parser) -> None:
    parser.add_argument("--robot", required=True, help="name of a robot, or folder of an imported one")
    text = "physics step [s] (default: 0.005, or less for drives that oscillate fast)"
    parser.add_argument("--dt", type=cli.positive_float, help=text)


def _plant(args: argparse.Namespace) -> Plant:
    robot = registry.robot(args.robot)
    return Plant(robot, args.dt or usual_step(robot))


def _plain(truth) -> dict[str, object]:
    return {
        name: value if isinstance(value, float) else [round(float(x), 7) for x in value] for name, value in vars(truth).items()
    }
