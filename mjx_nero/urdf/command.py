"""The command ``import-urdf``."""

import pathlib
from collections.abc import Mapping, Sequence

from mjx_nero import cli
from mjx_nero.types import UserError
from mjx_nero.urdf.importer import import_urdf
from mjx_nero.urdf.notes import Report

MOST_LINES = 12  # of warnings shown; report.json has all

_EPILOG = """\
Meshes are read from the URDF's folder, from the folder above if that is a description package's (the URDF in urdf/, robots/ or
xacro/, or a package.xml above), and from the folders given with --package; from nowhere else.

  python -m mjx_nero import-urdf my_arm.urdf --out my_arm
  python -m mjx_nero import-urdf urdf/arm.urdf --out arm --package arm_description=. --gripper finger_joint --ee tcp
"""


def main(argv: Sequence[str]) -> None:
    """Imports a URDF and prints what came of it.

    Raises:
        UserError: as ``import_urdf``, or the arguments are wrong.
    """
    parser = cli.Parser(
        prog="python -m mjx_nero import-urdf",
        description="Makes a model folder of a URDF: model.xml, meshes/, robot.yaml (edit it) and report.json.",
        epilog=_EPILOG,
    )
    parser.add_argument("file", type=pathlib.Path, help="URDF, or xacro file if the package xacro is installed")
    parser.add_argument("--out", type=pathlib.Path, required=True, metavar="DIR", help="folder to make")
    parser.add_argument(
        "--package", action="append", default=[], metavar="NAME=DIR", help="where package://NAME/ lies; again for more"
    )
    parser.add_argument("--gains", type=pathlib.Path, metavar="FILE", help="YAML: joint -> stiffness, damping, effort, speed")
    parser.add_argument(
        "--gripper", metavar="J1,J2", help="joints that drive the gripper; none for an arm without (default: guessed)"
    )
    parser.add_argument("--ee", metavar="LINK[:X,Y,Z]", help="grasp point, in metres (default: amid the fingers' ends)")
    parser.add_argument("--home", metavar="J=VALUE,...", help="home positions of some joints [rad, m] (default: guessed)")
    parser.add_argument("--strict", action="store_true", help="a warning is an error")
    parser.add_argument("--force", action="store_true", help="replace an earlier import")
    args, rest = parser.parse_known_args(argv)
    if rest:
        parser.error(f"unknown argument {rest[0]!r}")
    gripper = None if args.gripper is None else [] if args.gripper == "none" else args.gripper.split(",")
    report = import_urdf(
        args.file,
        args.out,
        {name: pathlib.Path(folder) for name, folder in _pairs(args.package, "--package takes NAME=DIR").items()},
        args.gains,
        gripper=gripper,
        ee=args.ee,
        home=_positions(args.home),
        strict=args.strict,
        force=args.force,
    )
    _print(report)


def _pairs(items: Sequence[str], usage: str) -> dict[str, str]:
    out = {}
    for item in items:
        name, equals, value = item.partition("=")
        if not (name and equals and value):
            raise UserError(f"{usage}, got {item!r}")
        out[name] = value
    return out


def _positions(text: str | None) -> Mapping[str, float]:
    pairs = _pairs(text.split(",") if text else [], "--home takes JOINT=VALUE,...")
    try:
        return {name: float(value) for name, value in pairs.items()}
    except ValueError:
        raise UserError(f"--home takes JOINT=VALUE,... with numbers, got {text!r}") from None


def _print(report: Report) -> None:
    from rich.markup import escape
    from rich.table import Table

    console = cli.console(highlight=False)
    robot = report.robot
    moving = [row for row in report.joints.values() if not row.get("merged")]
    mimics = sum("mimic" in row for row in moving)
    bodies = len({row["body"] for row in report.links.values()})
    console.print(f"[bold]{escape(robot.name)}[/bold] -> {escape(str(report.folder))}")
    facts = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    facts.add_row("links", f"{len(report.links)} in {bodies} bodies, {report.mass:.3f} kg (URDF {report.mass_read:.3f} kg)")
    facts.add_row(
        "joints", f"{len(moving)} moving{f', {mimics} of them by mimic' if mimics else ''}; arm {len(robot.arm.joints)}"
    )
    facts.add_row("gripper", escape(", ".join(robot.gripper.joints)) or "none")
    facts.add_row(
        "contacts", f"at most {report.contacts['table']} with the table, {report.contacts['table_and_cube']} with a cube on it"
    )
    if robot.workspace:
        facts.add_row("workspace", ", ".join(f"{k} {a:g} .. {b:g} m" for k, (a, b) in zip("xyz", robot.workspace, strict=True)))
    console.print(facts)

    shapes = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
    for title in ("collision shape", "kind", "covers", "filled", "meets"):
        shapes.add_column(title)
    for row in report.links.values():
        for shape in row["shapes"]:
            covers = f"{100 * shape['covered']:.0f}%" if shape["covered"] else "-"
            fill = f"{100 * shape['fill']:.0f}%" if shape["fill"] else "-"
            shapes.add_row(escape(shape["name"]), shape["kind"], covers, fill, ", ".join(shape["meets"]) or "nothing")
    console.print(shapes)

    for kind, style in (("warning", "yellow"), ("repaired", "cyan"), ("guessed", "dim")):
        found = [n for n in report.notes if n.kind == kind]
        shown = [n for n in found if kind != "guessed" or n.where == "robot"][:MOST_LINES]
        for note in shown:
            console.print(f"[{style}]{kind}[/{style}] {escape(f'{note.where} {note.name}: {note.text}')}", soft_wrap=True)
        if len(found) > len(shown):
            console.print(f"[{style}]{kind}[/{style}] and {len(found) - len(shown)} more in report.json", soft_wrap=True)
    # A bare name might be one of the package's robots.
    folder = escape(str(report.folder) if len(report.folder.parts) > 1 else f"./{report.folder}")
    console.print(
        "covers: share of the part's surface inside the shape; filled: volume of the part's convex hull over the shape's",
        style="dim",
    )
    console.print(f"next: python -m mjx_nero inspect {folder}; python train.py --env reach --robot {folder}", soft_wrap=True)
