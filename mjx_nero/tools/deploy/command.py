"""The command line of ``deploy``."""

import argparse
import contextlib
import json
from collections.abc import Sequence
from typing import Annotated, Any

from mjx_nero.config.bounds import Bounds
from mjx_nero.deploy import check, drivers
from mjx_nero.deploy.pictures import summary
from mjx_nero.tools import cli
from mjx_nero.tools.deploy import arms

NOTE = ", policy "  # of the note in a log's head
FAULT = 3  # exit status of a run that ended in a fault


def main(argv: Sequence[str]) -> None:
    """The command line.

    Raises:
        UserError: an argument, file or port is wrong, or the arm cannot start.
        SystemExit: with ``FAULT``, if the arm holds because something failed.
    """
    parser = _parser()
    args, _ = parser.parse(argv)
    arms.check(parser, args)
    if args.check and args.dry_run:
        parser.error("--check moves the arm, and --dry-run does not: pass one of them")
    with arms.in_reach():
        ended = _run(args)
    if ended:
        raise SystemExit(FAULT)


def _parser() -> cli.Parser:
    parser = cli.Parser(
        "deploy",
        "Runs an exported policy on an arm, behind a safety layer. After any fault the arm holds its position; torque is "
        "never cut. Stop it with Ctrl-C, space, q or escape.",
    )
    add = parser.add_argument
    add("policy", type=cli.path(".onnx"), help="policy file written by export")
    add("--arm", choices=drivers.KINDS, required=True, help="arm to drive")
    arms.add_arm(parser)
    add("--robot", help="folder of the imported robot that the policy was trained with, for --arm sim and --emulate")
    text = "where the object is: X,Y,Z, a JSON file of its place or of a camera, udp://HOST:PORT to listen on, or tcp://HOST:PORT"
    add("--object", metavar="PLACE", help=f"{text} (default: the simulator's)")
    text = "for a policy with cameras: JSON file that names the camera, video or folder for each of them"
    add("--cameras", type=cli.path(".json"), metavar="FILE", help=f"{text} (default: the simulator's)")
    add(
        "--goal",
        metavar="X,Y,Z",
        help="goal position [m], optionally followed by its orientation W,X,Y,Z (default: the middle of the task's region)",
    )
    add("--seconds", type=cli.non_negative, default=10.0, help="how long the policy acts [s]")
    text = "time until a target takes effect [s], as identify measures it; the policy then sees its own targets equally late"
    add(
        "--delay",
        type=cli.number(Annotated[float, Bounds(0.0, 1.0)]),
        help=f"{text} (default: from --identified, or measured while the arm moves)",
    )
    add("--go-home", action="store_true", help="first move the arm home, slowly, in a straight line in joint space")
    add("--dry-run", action="store_true", help="read the arm and show what would be sent, but send nothing")
    text = "instead of running the policy, move each joint a little, ask what you saw, and write offsets and delay"
    add("--check", type=cli.output(".yaml", ".yml", marks=(check.MARK,)), metavar="FILE", help=text)
    add("--log", type=cli.output(".csv", marks=(NOTE,)), help="write a table of everything read and sent, which identify reads")
    add("--alive", type=cli.path(), metavar="FILE", help="hold unless this file is touched at least every half second")
    arms.add_limits(parser)
    return parser


def _brain(args: argparse.Namespace) -> Any:
    """Loads the policy.

    Raises:
        UserError: the file is not a policy, or is for another arm.
    """
    from mjx_nero.deploy import setup
    from mjx_nero.deploy.loop import Brain

    brain = Brain(args.policy)
    setup.check(brain.metadata)
    drivers.check(args.arm, brain.metadata)
    brain.warm()
    return brain


def _position(text: str | None) -> list[float] | None:
    """Returns the position that ``--object`` gives in numbers; None: it names a source of positions, or nothing."""
    with contextlib.suppress(ValueError):
        x, y, z = (float(part) for part in (text or "").split(",")[:3])
        return [x, y, z]
    return None


def _run(args: argparse.Namespace) -> bool:
    """Runs the policy or the check; returns whether it ended in a fault."""
    from mjx_nero.deploy import setup
    from mjx_nero.deploy.guard import WallClock, urgent
    from mjx_nero.deploy.loop import go_home, run
    from mjx_nero.deploy.observe import Observer
    from mjx_nero.deploy.remote import Remote
    from mjx_nero.deploy.safety import Limits
    from mjx_nero.deploy.stop import operator
    from mjx_nero.tools.deploy.judge import Witness
    from mjx_nero.tools.deploy.world import pictures_of, places_and_options, scene_of

    brain = _brain(args)
    metadata = brain.metadata
    goal, clock, safety = arms.numbers(args.goal, (3, 7), "--goal"), WallClock(), arms.safety_of(args)
    limits = Limits.of(metadata, safety)
    with contextlib.ExitStack() as stack:
        places, options = stack.enter_context(places_and_options(args, metadata))
        pictures = stack.enter_context(pictures_of(args, metadata, places))
        body = setup.body_of(metadata)
        observer: Any = Observer(metadata, body, goal, places, pictures)
        for flag, point in (("--goal", goal), ("--object", _position(args.object))):
            if point is not None:
                setup.check_reach(metadata, body, flag, point[:3], args.table)
        if simulated := args.arm == "sim" or args.emulate:
            observer = Witness(observer, places, scene_of(args, metadata), metadata["joints"]["names"])
        arms.warn(args)
        note = f"{metadata['env']} on {args.arm}{' (emulated)' if args.emulate else ''}{NOTE}{args.policy.name}"
        spec, delay = arms.spec(args, metadata, options, args.log, note)
        remote = Remote(spec)
        stack.callback(remote.close)
        remote.ready()
        stop = stack.enter_context(operator(args.alive))
        stack.enter_context(urgent())
        remote.start(anywhere=args.go_home, actions=brain.actions)
        if args.go_home:
            if fault := go_home(remote, limits, clock, stop):
                print(f"the arm holds: {fault.text}")
                return fault.kind != "stop"
            print("the arm is at home")
        if args.check:
            from mjx_nero.tools.deploy.checking import checked

            return checked(remote, limits, metadata, clock, stop, args.check)
        report = run(
            remote, brain, observer, clock, args.seconds, stop, safety.misses, delay if args.delay is None else args.delay
        )
    _tell(args, report, brain.lateness.steps * limits.dt, getattr(pictures, "ages", ()))
    if simulated and not args.dry_run and (verdict := observer.verdict()):
        print(verdict)
    return report.fault.kind != "stop"


def _tell(args: argparse.Namespace, report: Any, late: float, ages: Sequence[float]) -> None:
    """Prints how a run ended."""
    print(f"the arm holds: {report.fault.text}")
    print("limits reached: " + (", ".join(f"{name} {n} times" for name, n in report.limited.items()) or "never"))
    print("timing: " + json.dumps(report.timing.summary()))
    if report.timing.missed:
        print("missed: " + ", ".join(f"cycle {cycle} by {1e3 * over:.1f} ms" for cycle, over in report.timing.missed))
    print(f"delay: the joints followed their targets {1e3 * late:.0f} ms later")
    if len(ages):
        print(f"pictures: {summary(ages)}")
    if args.log:
        print(f"log: {args.log}")
