"""The command ``deploy``: an exported policy on an arm, real, emulated or simulated, behind the safety layer."""

import argparse
import contextlib
import dataclasses
import json
import pathlib
import tempfile
from collections.abc import Iterator, Sequence
from typing import Annotated, Any

from mjx_nero import files
from mjx_nero.config.bounds import Bounds
from mjx_nero.deploy import drivers
from mjx_nero.deploy.arm import ArmError
from mjx_nero.errors import UserError
from mjx_nero.tools import cli

_WARNING = (
    "nobody has tried this on hardware: all that is known comes from the makers' and LeRobot's sources and from emulators. "
    "Keep a hand on the power switch and people out of reach."
)
FAULT = 3  # exit status of a run that ended in one


def main(argv: Sequence[str]) -> None:
    """The command line.

    Raises:
        UserError: a wrong argument, file or port; the arm cannot start.
        SystemExit: with ``FAULT``, where the arm holds because something failed.
    """
    parser = _parser()
    args, _ = parser.parse(argv)
    if args.arm == "sim" and args.emulate:
        parser.error("--emulate is for real arms' protocols: --arm sim is simulated already")
    if args.arm == "lerobot" and args.emulate:
        parser.error("--emulate is for the protocols that are spoken here: --arm lerobot is LeRobot's")
    if args.arm != "sim" and not (args.port or args.emulate):
        parser.error(f"--arm {args.arm} needs --port, or --emulate")
    for path in filter(None, (args.log,)):
        files.check_writable(path)
    try:
        ended = _run(args)
    except ArmError as error:
        raise UserError(f"the arm is lost: {error}") from None
    except ModuleNotFoundError as error:
        extra = {"onnxruntime": "deploy", "serial": "deploy", "can": "deploy"}.get((error.name or "").partition(".")[0])
        if extra is None:
            raise
        raise UserError(f"the package {error.name} is missing: pip install 'mjx-nero[{extra}]'") from None
    if ended:
        raise SystemExit(FAULT)


def _parser() -> cli.Parser:
    parser = cli.Parser(
        prog=cli.called_as("deploy"),
        description="Runs an exported policy on an arm, behind a safety layer. Every fault ends in holding, never in cutting "
        "torque. Stop it with Ctrl-C, or with space, q or escape.",
    )
    add = parser.add_argument
    add("policy", type=cli.path(".onnx"), help="file that export wrote")
    add("--arm", choices=drivers.KINDS, required=True, help="which arm")
    add("--port", help="of an SO-ARM a serial port, of a Piper or Nero INTERFACE:CHANNEL of python-can, as in socketcan:can0")
    add("--calibration", type=cli.path(".json"), help="SO-ARM: LeRobot's file; lerobot: which joint is which motor")
    add("--emulate", action="store_true", help="in place of the arm, a program that speaks its protocol, with MuJoCo behind it")
    add("--robot", help="imported robot's folder, for --arm sim and --emulate, where the policy was trained with one")
    text = "where the object is: X,Y,Z, a JSON file, udp://HOST:PORT to listen at, or tcp://HOST:PORT to listen to"
    add("--object", metavar="PLACE", help=f"{text} (default: where the simulator has it)")
    add(
        "--goal",
        metavar="X,Y,Z",
        help="commanded point, and perhaps orientation W,X,Y,Z (default: the middle of the task's region)",
    )
    add("--seconds", type=cli.non_negative, default=10.0, help="how long the policy acts (default: %(default)s)")
    text = "until a target is in force, s, as identify finds it: what the policy sees of its targets is then as late"
    add("--delay", type=cli.number(Annotated[float, Bounds(0.0, 1.0)]), default=0.0, help=f"{text} (default: %(default)s)")
    add("--go-home", action="store_true", help="first move the arm home, slowly, in a straight line of its joints")
    add("--dry-run", action="store_true", help="read the arm, and show what would be sent; nothing is")
    add("--log", type=cli.path(".csv"), help="table of what was read and sent, as identify reads it")
    add("--alive", type=cli.path(), metavar="FILE", help="hold unless somebody touches this file every half second")
    _add_limits(parser)
    return parser


def _add_limits(parser: cli.Parser) -> None:
    """Flags of the safety layer: they move limits, and switch nothing off."""
    add = parser.add_argument
    add("--speed", type=cli.share, default=1.0, metavar="SHARE", help="of the joints' speeds, at most (default: %(default)s)")
    add("--table", type=cli.number(float), default=0.0, metavar="Z", help="height of the table's top, m (default: %(default)s)")
    text = "box that no link may leave, m (default: about home and the task's regions, and 0.3 m on all sides)"
    add("--workspace", metavar="X0,X1,Y0,Y1,Z0,Z1", help=text)
    add("--apart", type=cli.non_negative, default=0.0, help="least distance between links, m (default: %(default)s)")
    add("--hottest", type=cli.positive_float, default=60.0, metavar="CELSIUS", help="of a drive (default: %(default)s)")


def _numbers(text: str | None, counts: Sequence[int], flag: str) -> list[float] | None:
    if text is None:
        return None
    try:
        found = [cli.number(float)(part) for part in text.split(",")]
    except argparse.ArgumentTypeError:
        found = []
    if len(found) not in counts:
        raise UserError(f"{flag} takes {' or '.join(map(str, counts))} numbers with commas between them, got {text[:60]!r}")
    return found


def _run(args: argparse.Namespace) -> bool:
    """Runs the loop; returns True if it ended in a fault."""
    from mjx_nero.deploy import setup
    from mjx_nero.deploy.guard import WallClock, urgent
    from mjx_nero.deploy.loop import Brain, go_home, run
    from mjx_nero.deploy.observe import Observer
    from mjx_nero.deploy.remote import Remote
    from mjx_nero.deploy.safety import Limits, SafetyCfg
    from mjx_nero.deploy.stop import operator

    files.read_bytes(args.policy, 100_000_000)
    try:
        brain = Brain(args.policy)
    except ModuleNotFoundError:
        raise
    except Exception as error:  # ONNX Runtime has kinds of its own
        raise UserError(f"{args.policy} is no policy that export wrote: {error}") from None
    metadata = brain.metadata
    setup.check(metadata)
    drivers.check(args.arm, metadata)
    goal, clock = _numbers(args.goal, (3, 7), "--goal"), WallClock()
    with contextlib.ExitStack() as stack:
        places, options = stack.enter_context(_world(args, metadata))
        observer = Observer(metadata, setup.body_of(metadata), goal, places)
        safety = SafetyCfg(share=args.speed, temperature=args.hottest)
        if args.arm != "sim" and not args.emulate:
            print(f"warning: {_WARNING}", flush=True)
        remote = Remote(_spec(args, metadata, options, safety))
        stack.callback(remote.close)
        brain.warm()
        remote.ready()
        stop = stack.enter_context(operator(args.alive))
        remote.start(anywhere=args.go_home, actions=brain.actions)
        if args.go_home:
            if fault := go_home(remote, Limits.of(metadata, safety), clock, stop):
                print(f"the arm holds: {fault.text}")
                return fault.kind != "stop"
            print("the arm is at home")
        urgent()
        report = run(remote, brain, observer, clock, args.seconds, stop, safety.misses, args.delay)
    print(f"the arm holds: {report.fault.text}")
    print("limits acted: " + (", ".join(f"{name} {n} times" for name, n in report.limited.items()) or "never"))
    print("timing: " + json.dumps(report.timing.summary()))
    for cycle, late in report.timing.missed[:20]:
        print(f"  cycle {cycle} was {1e3 * late:.1f} ms late")
    if args.log:
        print(f"log: {args.log}")
    return report.fault.kind != "stop"


def _spec(args: argparse.Namespace, metadata: dict[str, Any], options: dict[str, Any], safety: Any) -> Any:
    from mjx_nero.deploy.server import Spec

    box = _numbers(args.workspace, (6,), "--workspace")
    pairs = [(box[k], box[k + 1]) for k in (0, 2, 4)] if box else None
    for low, high in pairs or ():
        if not low < high:
            raise UserError(f"--workspace takes ranges from low to high, got {low:g} to {high:g}")
    fence = {"table": args.table, "box": pairs, "apart": args.apart}
    notes = (f"{metadata['env']} on {args.arm}{' (emulated)' if args.emulate else ''}, policy {args.policy.name}",)
    log = str(args.log.absolute()) if args.log else ""
    kept = {name: metadata[name] for name in ("joints", "gripper", "body", "base", "regions", "command", "control_dt", "robot")}
    return Spec(args.arm, options, kept, dataclasses.asdict(safety), fence, log, args.dry_run, notes)


@contextlib.contextmanager
def _world(args: argparse.Namespace, metadata: dict[str, Any]) -> Iterator[tuple[Any, dict[str, Any]]]:
    """Returns where objects are, and the driver's options."""
    from mjx_nero.deploy import places

    simulated = args.arm == "sim" or args.emulate
    constant, told = args.object is not None and _is_point(args.object), None
    if args.object is None and not simulated:
        source: Any = places.Known()
    elif simulated and (args.object is None or constant):  # the simulated object starts there, and is seen
        source = places.FromSocket("udp", "127.0.0.1", 0)
        told = source.port
    else:
        source = places.of(args.object)
    options: dict[str, Any] = {"port": args.port, "calibration": args.calibration and str(args.calibration)}
    with contextlib.ExitStack() as stack:
        stack.callback(source.close)
        if simulated:
            folder = pathlib.Path(stack.enter_context(tempfile.TemporaryDirectory()))
            options = _simulated(args, metadata, folder, told, constant)
            if args.emulate:
                from mjx_nero.deploy.emulators import started

                options = stack.enter_context(started(args.arm, options, metadata))
        yield source, options


def _is_point(text: str) -> bool:
    return "://" not in text and text[:1] in "+-.0123456789" and "," in text


def _simulated(args: argparse.Namespace, metadata: dict[str, Any], folder: pathlib.Path, tracker: int | None, constant: bool):
    """Options of the simulated arm: its scene as a file, and where its objects start."""
    import mujoco

    from mjx_nero.envs import registry
    from mjx_nero.sim import scene

    cfg = registry.env_cfg(metadata["env"], metadata["preset"], args.robot)
    model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False)
    path = folder / "scene.mjb"
    mujoco.mj_saveModel(model, str(path), None)
    objects: dict[str, Any] = {}
    for name, item in cfg.scene.objects.items():
        x, y, above = item.pos
        event = next((t for t in cfg.events.values() if t.params.get("object", "cube") == name and "x" in t.params), None)
        if event is not None:
            x, y = (sum(event.params[axis]) / 2 for axis in "xy")
        objects[name] = [x, y, item.rest_height + above]
    if constant and objects:
        objects[next(iter(objects))] = _numbers(args.object, (3,), "--object")
    return {"model": str(path), "tracker": tracker, "objects": objects}
