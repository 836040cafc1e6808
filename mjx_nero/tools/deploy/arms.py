"""Flags that choose an arm, its port and its limits, and the scene of an emulated or simulated arm."""

import argparse
import contextlib
import dataclasses
import pathlib
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any

from mjx_nero.config.bounds import Bounds
from mjx_nero.deploy.arm import ArmError
from mjx_nero.errors import UserError
from mjx_nero.tools import cli

WARNING = (
    "nobody has tried this on hardware: the drivers are written from the makers' and LeRobot's sources and tested on emulators. "
    "Keep a hand on the power switch and people out of reach."
)
KEPT = ("joints", "gripper", "body", "base", "regions", "command", "control_dt", "robot")


def add_arm(parser: cli.Parser) -> None:
    """Adds the flags of the arm and its bus."""
    add = parser.add_argument
    add("--port", help="serial port, INTERFACE:CHANNEL, HOST, or TYPE:field=value,...: see docs/guides/deploy.md")
    add("--gripper", metavar="HOST", help="address of the compute box of the Cobotta's RG6 (default: do not command the gripper)")
    add("--calibration", type=cli.path(".json"), help="SO-ARM: LeRobot's calibration file; lerobot: which motor is which joint")
    add("--emulate", action="store_true", help="use an emulator that speaks the arm's protocol, with MuJoCo behind it")
    text = "file from identify or deploy --check: subtract its offsets, and use its delay as --delay"
    add("--identified", type=cli.path(".yaml", ".yml"), help=text)


def add_limits(parser: cli.Parser) -> None:
    """Adds the flags of the safety layer. They move limits but switch none off."""
    add = parser.add_argument
    add("--speed", type=cli.share, default=1.0, metavar="SHARE", help="maximum share of the joints' speed limits")
    add("--table", type=cli.number(float), default=0.0, metavar="Z", help="height of the table top [m]")
    text = "box that no link may leave [m] (default: around home and the task's regions, with a margin of 0.3 m)"
    add("--workspace", metavar="X0,X1,Y0,Y1,Z0,Z1", help=text)
    add("--apart", type=cli.non_negative, default=0.0, help="minimum distance between links [m]")
    hottest = cli.number(Annotated[float, Bounds(20.0, 90.0)])
    add("--hottest", type=hottest, default=60.0, metavar="CELSIUS", help="hold if a drive gets hotter than this")


def check(parser: cli.Parser, args: argparse.Namespace) -> None:
    """Refuses flags of an arm that contradict one another."""
    if args.arm == "sim" and args.emulate:
        parser.error("--emulate is for the protocols of real arms: leave it out with --arm sim, which is simulated already")
    if args.arm == "lerobot" and args.emulate:
        parser.error("--emulate cannot emulate --arm lerobot, whose protocols are LeRobot's: name the arm itself or leave it out")
    if args.arm != "sim" and not (args.port or args.emulate):
        parser.error(f"--arm {args.arm} needs --port, or --emulate")


@contextlib.contextmanager
def in_reach() -> Iterator[None]:
    """Reports in one line that an arm is lost.

    Raises:
        UserError: it is.
    """
    try:
        yield
    except ArmError as error:
        raise UserError(f"the arm is lost: {error}") from None


def numbers(text: str | None, counts: Sequence[int], flag: str) -> list[float] | None:
    """Reads comma-separated numbers; None if ``text`` is None.

    Args:
        counts: how many numbers are allowed.

    Raises:
        UserError: the text is something else.
    """
    if text is None:
        return None
    try:
        found = [cli.number(float)(part) for part in text.split(",")]
    except argparse.ArgumentTypeError:
        found = []
    if len(found) not in counts:
        raise UserError(f"{flag} takes {' or '.join(map(str, counts))} comma-separated numbers, got {text[:60]!r}")
    return found


def safety_of(args: argparse.Namespace) -> Any:
    """Returns the ``SafetyCfg`` of the flags."""
    from mjx_nero.deploy.safety import SafetyCfg

    return SafetyCfg(share=args.speed, temperature=args.hottest)


def spec(args: argparse.Namespace, metadata: Mapping[str, Any], options: Mapping[str, Any], log: pathlib.Path | None, note: str):
    """Returns the specification of the arm's process, and the delay of its targets [s]; None: unknown.

    Raises:
        UserError: a flag has an impossible value.
    """
    from mjx_nero.deploy import identified
    from mjx_nero.deploy.server import Spec

    box = numbers(args.workspace, (6,), "--workspace")
    pairs = [(box[k], box[k + 1]) for k in (0, 2, 4)] if box else None
    for low, high in pairs or ():
        if not low < high:
            raise UserError(f"--workspace takes ranges from low to high, got {low:g} to {high:g}")
    delay, offsets = identified.read(args.identified, metadata) if args.identified else (None, [])
    fence = {"table": args.table, "box": pairs, "apart": args.apart}
    kept = {name: metadata[name] for name in KEPT}
    dry, out = getattr(args, "dry_run", False), str(log.absolute()) if log else ""
    safety = dataclasses.asdict(safety_of(args))
    notes = f"robot: {metadata['robot']}", note  # the first as ``identify.log.ROBOT``, which would import JAX here
    return Spec(args.arm, options, kept, safety, fence, out, dry, notes, tuple(offsets)), delay


@contextlib.contextmanager
def options_of(args: argparse.Namespace, metadata: Mapping[str, Any], cfg: Any, tracker: int | None = None) -> Iterator[Any]:
    """Yields the driver's options. An emulator runs until the context ends.

    Args:
        cfg: makes the scene of a simulated or emulated arm: robot, scene, sim, and where its objects start.
        tracker: port to which object positions are sent.
    """
    if args.arm != "sim" and not args.emulate:
        calibration = args.calibration and str(args.calibration)
        yield {"port": args.port, "calibration": calibration, "gripper": args.gripper}
        return
    with tempfile.TemporaryDirectory() as name:
        options = {"model": _saved(cfg(), pathlib.Path(name)), "tracker": tracker, "objects": cfg().objects}
        if not args.emulate:
            yield options
            return
        from mjx_nero.deploy.emulators import started

        with started(args.arm, options, metadata) as found:
            yield found


def _saved(cfg: Any, folder: pathlib.Path) -> str:
    import mujoco

    from mjx_nero.sim import scene

    path = str(folder / "scene.mjb")
    mujoco.mj_saveModel(scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False), path, None)
    return path


def warn(args: argparse.Namespace) -> None:
    """Prints the warning about real arms."""
    if args.arm != "sim" and not args.emulate:
        print(f"warning: {WARNING}", flush=True)
