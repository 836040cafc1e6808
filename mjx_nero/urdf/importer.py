"""Imports a URDF to a model folder: ``model.xml``, ``meshes/``, ``robot.yaml`` and ``report.json``."""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim import quats
from mjx_nero.sim.robot import DriveCfg, GripperCfg, RobotCfg
from mjx_nero.types import UserError
from mjx_nero.urdf import chain as chain_of
from mjx_nero.urdf import collide, couplings, drives, files, fingers, folder, inertia, meshes, mjcf, regions, rest, workspace
from mjx_nero.urdf import hand as hands
from mjx_nero.urdf import home as homing
from mjx_nero.urdf import read as reader
from mjx_nero.urdf.cloud import Cloud
from mjx_nero.urdf.drawing import Visual
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.geometry import Looks
from mjx_nero.urdf.report import Notes, Report
from mjx_nero.urdf.tree import Body, Tree, bodies, positions
from mjx_nero.urdf.tree import poses as body_poses
from mjx_nero.urdf.units import METRES, Units, check_lengths


# Long: it lists the stages of an import, in order.
def import_urdf(
    path: pathlib.Path | str,
    out: pathlib.Path | str,
    packages: Mapping[str, pathlib.Path] | None = None,
    gains: pathlib.Path | None = None,
    *,
    args: Mapping[str, str] | None = None,
    chain: str | None = None,
    fix: Mapping[str, float | None] | None = None,
    gripper: Sequence[str] | None = None,
    ee: str | None = None,
    open: Mapping[str, float] | None = None,
    closed: Mapping[str, float] | None = None,
    home: Mapping[str, float] | None = None,
    units: Units = METRES,
    strict: bool = False,
    force: bool = False,
) -> Report:
    """Makes a model folder from a URDF or xacro file, for ``mjx_nero.make(..., robot=out)``.

    The folder appears whole or not at all. Meshes are read only from the URDF's own folders (see ``files.Roots``) and from
    ``packages``. A missing mesh is replaced by the link's other one or by a stand-in, with a warning.

    Args:
        path: URDF of a robot on a fixed base.
        out: folder to make; it must be absent or empty, or, with ``force``, hold an earlier import.
        packages: name -> folder for ``package://name/...``.
        gains: YAML file, joint -> stiffness, damping and optionally effort and speed. Other joints get computed ones
            (``drives.rows``).
        args: values of a xacro file's arguments.
        chain: ``BASE:TIP``, two links of a robot that is more than an arm. Joints outside are held still.
        fix: joint -> position to hold it at [rad, m]; None: the position nearest to 0.
        gripper: joints that drive the gripper, instead of a guess (``fingers.choose``); empty: no gripper.
        ee: ``LINK`` or ``LINK:x,y,z``, the grasp point [m], instead of a guess.
        open, closed: positions of the gripper's joints [rad, m], instead of a guess (``swing.Swing.ends``).
        home: positions of some joints [rad, m], instead of a guess (``home.home``).
        units: units of the URDF, if not metres and radians. Arguments here are always in metres and radians.
        strict: turn warnings into an error.

    Raises:
        UserError: the input cannot be used; the message says why and what to do.
    """
    path, out = pathlib.Path(path), pathlib.Path(out)
    folder.check(out, force)
    notes = Notes()
    roots = files.Roots(path, packages or {})
    tree, mount = reader.read(path, roots, notes, args or {}, units=units)
    read_mass = sum(link.mass.mass for link in tree.links.values())
    tree = chain_of.selected(tree, chain, fix or {}, notes)
    looks = Looks(tree, bodies(tree), meshes.Meshes(roots), notes)
    if roots.elsewhere:
        notes.add("repaired", "robot", tree.name, roots.told())
    check_lengths(tree, looks.spans, units)
    whole = filled(tree, looks, notes)
    if gripper is None:
        whole = fingers.opposed(whole, looks.of, notes)
    tree, grips, fork = fingers.choose(whole, looks.of, gripper, notes)
    couplings.warn_of_frozen(whole, tree, grips, notes)
    parts = bodies(tree)
    hand = hands.find(tree, parts, looks.of, (grips, fork), ee, notes, open, closed)
    stand = rest.stand(parts, looks.of, hand, mount, tree.name, notes)
    start = workspace.first_home(parts, hand, home or {})
    cloud = Cloud(parts, hand, stand.mount, start)
    collisions = collide.collisions(tree, parts, looks, hand, cloud, notes)
    work = workspace.workspace(cloud, tree.name, notes)
    shapes = [(link, shape, bits > 0) for link, items in collisions.items() for _, shape, bits in items]
    search = homing.Search(parts, looks.of, hand, cloud, start, home or {}, shapes)
    homes = search.amid(*work)
    down = workspace.down(cloud, hand, work[0], search.pose(homes[0]) if len(homes) else start)
    place = regions.find(cloud, hand, work[0], down, search.low, tree.name, notes)
    at_home, down = homing.home(search, homes, place, tree.name, notes)
    made = _Model(tree, parts, hand, collisions, at_home, notes)
    rotors, rows = _drives(made, gains, notes)
    robot = _robot(made, stand, rows, down, (work[0], place.pick, place.hold), out)
    robot = dataclasses.replace(robot, lean=place.lean, turns=place.turns)
    text = made.xml({name: look.drawn for name, look in looks.of.items()}, rotors)
    report = Report(
        source=path.name,
        folder=out,
        robot=robot,
        links=_link_rows(tree, parts, looks, collisions),
        joints=_joint_rows(tree, rotors, rows, at_home),
        mass=float(sum(m.mass for m in made.masses.values())),
        mass_read=float(read_mass),
        contacts=collide.contacts(collisions),
        notes=notes,
    )
    if strict and report.warnings:
        more = f" (and {len(report.warnings) - 1} more)" if len(report.warnings) > 1 else ""
        raise UserError(f"--strict: {report.warnings[0]}{more}")
    folder.write(out, text, looks.stl, robot, report, force)
    return report


def filled(tree: Tree, looks: Looks, notes: Notes) -> Tree:
    """Fills in what shapes imply: missing tensors, and masses where no link, or no link of a moving body, has one."""
    seen = {n: None if look.guessed else look.points for n, look in looks.of.items()}
    masses = {n: link.mass for n, link in tree.links.items()}
    shown = {n: points if looks.of[n].drawn else None for n, points in seen.items()}
    if sum(m.mass for m in masses.values()) < inertia.LIGHTEST * len(masses):
        masses = {n: inertia.weighed(m, shown[n]) for n, m in masses.items()}
        total = sum(m.mass for m in masses.values())
        notes.add("guessed", "robot", tree.name, f"no link has a mass: now {total:.3g} kg, the shapes filled with water")
    for body in bodies(tree).values():
        if body.joint and sum(masses[n].mass for n in body.links) < inertia.PLACEHOLDER:
            masses |= {n: inertia.guessed(masses[n], shown[n], n, notes) for n in body.links}
    links = {n: dataclasses.replace(tree.links[n], mass=inertia.filled(m, seen[n], n, notes)) for n, m in masses.items()}
    if wild := [repr(n) for n, m in masses.items() if inertia.absurd(m, seen[n])]:
        named = ", ".join(wild[:3]) + (f" and {len(wild) - 3} more" if len(wild) > 3 else "")
        text = f"the inertia of {named} is more than {inertia.ABSURD:g} times what its mass and shape can have"
        notes.add("warning", "robot", tree.name, f"{text}: taken as a placeholder, and from the shape; correct its <inertia>")
    return dataclasses.replace(tree, links=links)


class _Model:
    """The data that ``model.xml`` is written from."""

    def __init__(
        self,
        tree: Tree,
        parts: dict[str, Body],
        hand: Hand,
        collisions: collide.Collisions,
        at_home: Mapping[str, float],
        notes: Notes,
    ):
        self.tree, self.parts, self.hand, self.collisions, self.at_home = tree, parts, hand, collisions, at_home
        self.masses = {n: inertia.body_mass(b, notes) if b.joint else b.mass for n, b in parts.items()}
        self.joints = {b.joint.name: b.joint for b in parts.values() if b.joint}
        self.site = free("ee", [link for b in parts.values() for link in b.links])

    def xml(self, drawn: Mapping[str, list[Visual]], rotors: Mapping[str, float]) -> str:
        at_home = positions(self.parts, {n: np.array([v]) for n, v in self.at_home.items()}, 1)
        return mjcf.document(
            self.tree.name,
            self.parts,
            self.masses,
            drawn,
            self.collisions,
            (self.site, self.hand.link, self.hand.site),
            rotors,
            {n: float(q[0]) for n, q in at_home.items()},
        )


def _drives(made: _Model, gains: pathlib.Path | None, notes: Notes) -> tuple[dict[str, float], drives.Rows]:
    """Computes the rotor inertia of every joint [kg m2, kg], and stiffness, damping, effort and speed of the driven ones."""
    bare = made.xml(dict.fromkeys(made.tree.links, []), dict.fromkeys(made.joints, 0.0))
    moved = drives.carried(_compiled(bare))
    levers = _levers(made.parts, made.hand)
    rotors = {n: drives.armature(j, moved[0][n], levers.get(n)) for n, j in made.joints.items()}
    for name, value in rotors.items():
        notes.add("guessed", "joint", name, f"rotor inertia (armature) {value:.3g}: URDFs have none")
    driven = {n: j for n, j in made.joints.items() if not j.mimic}
    given = {} if gains is None else drives.load_gains(pathlib.Path(gains), driven)
    return rotors, drives.rows(made.parts, made.hand, moved, rotors, levers, given, notes)


def _robot(
    made: _Model,
    stand: rest.Stand,
    rows: drives.Rows,
    down: tuple[float, float, float, float],
    boxes: tuple[workspace.Box | None, ...],
    out: pathlib.Path,
) -> RobotCfg:
    arm = [n for n, j in made.joints.items() if not j.mimic and n not in made.hand.joints]
    return RobotCfg(
        name=made.tree.name,
        arm=DriveCfg(**_columns(arm, rows, made.at_home)),
        gripper=GripperCfg(**_columns(made.hand.joints, rows, made.at_home), open=made.hand.open, close=made.hand.close),
        ee_site=made.site,
        base_link=made.tree.root,
        base_pos=_floats(stand.mount[:3, 3]),
        base_quat=_floats(quats.of_matrix(stand.mount[:3, :3])),
        down=down,
        gravity_compensation=True,
        workspace=boxes[0],
        pick=boxes[1],
        hold=boxes[2],
        floor=stand.floor,
        opening=made.hand.gap,
        closed=made.hand.closed,
        pad=made.hand.pad,
        grip=_floats(made.hand.grip),
        folder=str(out),
    )


def _compiled(text: str) -> mujoco.MjModel:
    try:
        return mujoco.MjModel.from_xml_string(text)
    except ValueError as error:
        raise UserError(f"MuJoCo refuses the model: {' '.join(str(error).split())}") from None


def _levers(parts: dict[str, Body], hand: Hand) -> dict[str, float]:
    """Distance from a gripper joint's axis to the pads that it moves [m]; 1 for slides."""
    inside = [parts[n] for n in hand.inside]
    at = {n: p[0] for n, p in body_poses(parts, {j: np.array([v]) for j, v in zip(hand.joints, hand.close, strict=True)}).items()}
    ends = [at[f] @ np.append(hand.pads[f].pose[:3, 3], 1.0) for f in hand.fingers]
    out = {}
    for body in inside:
        assert body.joint is not None
        if body.joint.type == "prismatic":
            out[body.joint.name] = 1.0
            continue
        axis = at[body.name][:3, :3] @ body.joint.axis
        arms = [float(np.linalg.norm(np.cross(end[:3] - at[body.name][:3, 3], axis))) for end in ends]
        out[body.joint.name] = float(np.clip(min(arms), 0.02, 0.3)) if arms else 0.1
    return out


def _columns(joints: Sequence[str], rows: drives.Rows, home: Mapping[str, float]) -> dict[str, Any]:
    columns = {c: tuple(rows[j][c] for j in joints) for c in ("stiffness", "damping", "effort", "speed")}
    return {"joints": tuple(joints), **columns, "home": tuple(home[j] for j in joints)}


def _link_rows(tree: Tree, parts: dict[str, Body], looks: Looks, collisions: collide.Collisions) -> dict[str, dict[str, Any]]:
    body_of = {link: body.name for body in parts.values() for link in body.links}
    rows: dict[str, dict[str, Any]] = {}
    for name, link in tree.links.items():
        shapes = [
            {
                "name": label,
                "kind": shape.kind,
                "size": [round(s, 5) for s in shape.size],
                "covered": shape.covered,
                "fill": shape.fill,
                "meets": [what for bit, what in ((mjcf.TABLE, "table"), (mjcf.CUBE, "cube")) if bits & bit],
            }
            for label, shape, bits in collisions[name]
        ]
        rows[name] = {
            "body": body_of[name],
            "mass": link.mass.mass,
            "visuals": len(link.visuals),
            "collisions": len(link.collisions),
            "covered": collide.covered(looks.of[name], [shape for _, shape, _ in collisions[name]]),
            "meshes": sorted({d.mesh for d in looks.of[name].drawn if d.mesh}),
            "shapes": shapes,
        }
    return rows


def _joint_rows(
    tree: Tree, rotors: Mapping[str, float], rows: drives.Rows, home: Mapping[str, float]
) -> dict[str, dict[str, Any]]:
    out: dict[str, dict[str, Any]] = {}
    for name, joint in tree.joints.items():
        out[name] = {"type": joint.type, "parent": joint.parent, "child": joint.child}
        if not joint.moves:
            out[name]["merged"] = True
            continue
        out[name] |= {"limits": [joint.lower, joint.upper], "effort": joint.effort, "velocity": joint.velocity}
        out[name] |= {"damping": joint.damping, "frictionloss": joint.friction, "armature": rotors[name]}
        if joint.mimic:
            out[name]["mimic"] = dict(zip(("joint", "multiplier", "offset"), joint.mimic, strict=True))
        else:
            out[name] |= {"drive": rows[name], "home": home[name]}
    return out


def free(name: str, taken: Sequence[str]) -> str:
    return name if name not in taken else free(f"{name}_site", taken)


def _floats(values: np.ndarray) -> Any:
    return tuple(float(v) + 0.0 for v in values)
