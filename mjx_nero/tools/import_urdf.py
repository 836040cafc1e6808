"""The command ``import-urdf``."""

import argparse
import pathlib
import shlex
from collections.abc import Mapping, Sequence

from mjx_nero.config import values
from mjx_nero.errors import UserError
from mjx_nero.runs import console
from mjx_nero.runs.console import Table
from mjx_nero.sim import robot_file
from mjx_nero.tools import cli
from mjx_nero.urdf import files, folder
from mjx_nero.urdf.fixture import import_fixture
from mjx_nero.urdf.importer import import_urdf
from mjx_nero.urdf.report import Report
from mjx_nero.urdf.units import Units

MOST_LINES = 12  # warnings to print; report.json has all

_EPILOG = """\
Files are read from the URDF's folder, from its package (the folder of a package.xml up to five levels above, or else the folder
above urdf/, robots/ or xacro/), from packages beside that one, and from the packages given with --package.

  python -m mjx_nero import-urdf my_arm.urdf --out my_arm
  python -m mjx_nero import-urdf urdf/arm.urdf --out arm --package arm_description=. --gripper finger_joint --ee tcp
  python -m mjx_nero import-urdf urdf/arm.urdf.xacro --out arm --arg hand:=true --package ../gripper_description
"""


def main(argv: Sequence[str]) -> None:
    """Imports a URDF and prints the result.

    Raises:
        UserError: see ``import_urdf``; or an argument is wrong.
    """
    parser = _parser()
    args, rest = parser.parse_known_args(argv)
    if rest:
        parser.error(f"unknown argument {rest[0]!r}")
    if args.fixture:
        return _fixture(args)
    gripper = None if args.gripper is None else [] if args.gripper == "none" else args.gripper.split(",")
    report = import_urdf(
        args.file,
        args.out,
        _packages(args.package),
        args.gains,
        args=_pairs(args.arg, "--arg takes NAME:=VALUE", ":="),
        chain=args.chain,
        fix=_fixed(args.fix),
        gripper=gripper,
        ee=args.ee,
        open=_positions(args.open, "--open"),
        closed=_positions(args.closed, "--closed"),
        home=_positions(args.home, "--home"),
        units=Units(args.degrees, args.scale, args.mesh_scale),
        strict=args.strict,
        force=args.force,
    )
    _print(report)
    if args.self_test:
        _test(report, args.tries)
    # A bare name could be mistaken for one of the package's robots.
    out = shlex.quote(str(report.folder) if len(report.folder.parts) > 1 else f"./{report.folder}")
    console.line(console.screen(), f"next: {cli.called_as('inspect')} {out}; {cli.called_as('train')} --env reach --robot {out}")


def _parser() -> cli.Parser:
    parser = cli.Parser(
        "import-urdf",
        "Makes a model folder from a URDF: model.xml, meshes/, robot.yaml (which you may edit) and report.json.",
        ends=_EPILOG,
    )
    parser.add_argument("file", type=cli.path(), help="URDF or xacro file")
    parser.add_argument("--out", type=cli.path(), required=True, metavar="DIR", help="folder to create")
    parser.add_argument(
        "--package", action="append", default=[], metavar="[NAME=]DIR", help="folder for package://NAME/; repeatable"
    )
    parser.add_argument("--arg", action="append", default=[], metavar="NAME:=VALUE", help="argument of a xacro file; repeatable")
    parser.add_argument("--gains", type=cli.path(), metavar="FILE", help="YAML: joint -> stiffness, damping, effort, speed")
    parser.add_argument("--chain", metavar="BASE:TIP", help="import one arm of a larger robot and hold the rest still")
    parser.add_argument("--fix", action="append", default=[], metavar="JOINT[=VALUE]", help="hold a joint still; repeatable")
    parser.add_argument("--gripper", metavar="J1,J2", help="joints that drive the gripper, or none (default: guessed)")
    parser.add_argument("--ee", metavar="LINK[:X,Y,Z]", help="grasp point [m] (default: between the fingertips)")
    parser.add_argument("--open", metavar="J=VALUE,...", help="gripper positions when open [rad, m] (default: measured)")
    parser.add_argument(
        "--closed", metavar="J=VALUE,...", help="gripper positions when closed [rad, m] (default: where its shapes meet)"
    )
    parser.add_argument("--home", metavar="J=VALUE,...", help="home positions of some joints [rad, m] (default: guessed)")
    parser.add_argument("--degrees", action="store_true", help="read limits and velocities of hinges as degrees")
    parser.add_argument(
        "--scale",
        type=cli.positive_float,
        metavar="FACTOR",
        help="scale of all lengths except those of meshes: 0.001 for millimetres",
    )
    parser.add_argument("--mesh-scale", type=cli.positive_float, metavar="FACTOR", help="scale of meshes, on top of their own")
    parser.add_argument("--tries", type=cli.at_most(1000), metavar="N", help="number of tries in the self-test (default: 8)")
    parser.add_argument("--no-self-test", dest="self_test", action="store_false", help="skip the self-test in simulation")
    parser.add_argument("--fixture", action="store_true", help="import a fixture with joints for scene.fixtures, not a robot")
    parser.add_argument("--strict", action="store_true", help="treat warnings as errors")
    parser.add_argument("--force", action="store_true", help="replace an earlier import")
    return parser


def _fixture(args: argparse.Namespace) -> None:
    """Imports a fixture and prints the joints and sites that terms can use."""
    units = Units(args.degrees, args.scale, args.mesh_scale)
    pairs = _pairs(args.arg, "--arg takes NAME:=VALUE", ":=")
    made = import_fixture(args.file, args.out, _packages(args.package), args=pairs, units=units, force=args.force)
    screen = console.screen()
    console.line(screen, f"{args.file.name} -> {made.folder}", style="bold")
    console.line(screen, f"joints: {', '.join(made.joints)}; sites: {', '.join(made.sites)}")
    for warning in made.warnings[:MOST_LINES]:
        console.line(screen, f"warning {warning}", "yellow")


def _test(report: Report, tries: int | None) -> None:
    """Tests the robot in simulation and adds the result to its report. A failure does not undo the import."""
    from mjx_nero.tools import self_test  # with JAX, which reading a URDF does without

    cli.setup_jax()
    found = self_test.run(robot_file.read(report.folder), tries or self_test.TRIES)
    folder.record(report.folder, "self_test", found.json())
    console.line(console.screen(), found.line, "green" if found.passed else "yellow")


def _packages(items: Sequence[str]) -> Mapping[str, pathlib.Path]:
    """Returns package folders by name. If no name is given, the folder's package.xml has it."""
    named = [item if "=" in item else f"{files.package_name(pathlib.Path(item).resolve())}={item}" for item in items]
    return {name: pathlib.Path(folder) for name, folder in _pairs(named, "--package takes NAME=DIR or DIR").items()}


def _pairs(items: Sequence[str], usage: str, sign: str = "=") -> dict[str, str]:
    out = {}
    for item in items:
        name, equals, value = item.partition(sign)
        if not (name and equals and (value or sign == ":=")):
            raise UserError(f"{usage}, got {values.short(item)}")
        out[name] = value
    return out


def _positions(text: str | None, flag: str) -> Mapping[str, float]:
    pairs = _pairs(text.split(",") if text else [], f"{flag} takes JOINT=VALUE,...")
    return {name: values.read(float, value, f"{flag} {name}") for name, value in pairs.items()}


def _fixed(items: Sequence[str]) -> Mapping[str, float | None]:
    out: dict[str, float | None] = {}
    for item in items:
        name, equals, value = item.partition("=")
        try:
            out[name] = float(value) if equals else None
        except ValueError:
            raise UserError(f"--fix takes JOINT or JOINT=VALUE with a number, got {item!r}") from None
    return out


def _print(report: Report) -> None:
    screen, robot = console.screen(), report.robot
    console.line(screen, f"{robot.name} -> {report.folder}", style="bold")
    screen.print(_facts(report))
    screen.print(_shapes(report))
    for kind, style in (("warning", "yellow"), ("repaired", "cyan"), ("guessed", "dim")):
        found = [n for n in report.notes if n.kind == kind]
        shown = [n for n in found if kind != "guessed" or n.where == "robot"][:MOST_LINES]
        for note in shown:
            console.line(screen, f"{kind} {note.where} {note.name}: {note.text}", style)
        if len(found) > len(shown):
            console.line(screen, f"{kind} and {len(found) - len(shown)} more in report.json", style)


def _facts(report: Report) -> Table:
    facts, robot = Table("", ("", ""), left=("",)), report.robot
    moving = [row for row in report.joints.values() if not row.get("merged")]
    mimics = sum("mimic" in row for row in moving)
    bodies = len({row["body"] for row in report.links.values()})
    facts.add("links", f"{len(report.links)} in {bodies} bodies, {report.mass:.3f} kg (URDF {report.mass_read:.3f} kg)")
    facts.add("joints", f"{len(moving)} moving{f', {mimics} of them by mimic' if mimics else ''}; arm {len(robot.arm.joints)}")
    gaps = f"; {1000 * robot.closed:.0f} mm between its pads when closed, {1000 * robot.opening:.0f} mm when open"
    facts.add("gripper", ", ".join(robot.gripper.joints) + gaps if robot.gripper.joints else "none")
    table, cube = report.contacts["table"], report.contacts["table_and_cube"]
    facts.add("contacts", f"at most {table} with the table, {cube} with a cube on it")
    for name in ("workspace", "pick", "hold"):
        if box := getattr(robot, name):
            facts.add(name, ", ".join(f"{k} {a:g} .. {b:g} m" for k, (a, b) in zip("xyz", box, strict=True)))
    return facts


def _shapes(report: Report) -> Table:
    columns = ("collision shape", "kind", "covers", "filled", "meets")
    about = "covers: share of the part's surface inside the shape; filled: volume of the part's convex hull over the shape's"
    shapes = Table("", columns, left=("kind", "meets"), caption=about)
    for row in report.links.values():
        for shape in row["shapes"]:
            covers, filled = (f"{100 * shape[name]:.0f}%" if shape[name] else "-" for name in ("covered", "fill"))
            shapes.add(shape["name"], shape["kind"], covers, filled, ", ".join(shape["meets"]) or "nothing")
    return shapes
