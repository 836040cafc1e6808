"""Units of a URDF: metres and radians. Numbers that suggest others raise a message that names the right flag."""

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
import yourdfpy

from mjx_nero.config.bounds import Positive
from mjx_nero.types import UserError
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Joint, Tree

MAX_TURNS = 4  # a hinge's limits beyond this look like degrees
MAX_SPAN = 10.0  # [m] a mesh with its link's origin that spans more than this, and ...
MAX_SPANS = 50.0  # ... more than this many of the longest joint offset, is in millimetres
LEAST, MOST = 0.02, 10.0  # [m] plausible lengths of an arm along its joints
SERIES = 3  # least moving joints that make a robot shorter than LEAST implausible
HINGES = ("revolute", "continuous")
Spans = Mapping[tuple[str, tuple[float, ...]], float]  # file and scale of a mesh -> its largest extent [m]


@dataclasses.dataclass(frozen=True)
class Units:
    """The units of a URDF.

    Attributes:
        degrees: limits and velocities of hinges are in degrees, not radians.
        scale: factor of all lengths except the meshes': origins, shapes and slides. None: 1, if the result is plausible.
        mesh_scale: factor of the meshes, on top of their own. None: 1, if the result is plausible.
    """

    degrees: bool = False
    scale: Positive | None = None
    mesh_scale: Positive | None = None


METRES = Units()


def applied(robot: yourdfpy.Robot, units: Units) -> None:
    """Converts yourdfpy's numbers to metres and radians, in place."""
    if units.degrees:
        for limit in (j.limit for j in robot.joints if j.type in HINGES and j.limit is not None):
            _multiply(limit, math.pi / 180, "lower", "upper", "velocity")
    if units.scale not in (None, 1.0):
        _scale(robot, units.scale)
    if units.mesh_scale is not None:
        for mesh in (shape.geometry.mesh for link in robot.links for shape in (*link.visuals, *link.collisions)):
            if mesh is not None:
                mesh.scale = units.mesh_scale * np.broadcast_to(1.0 if mesh.scale is None else np.asarray(mesh.scale, float), 3)


def _scale(robot: yourdfpy.Robot, by: float) -> None:
    slides = {joint.name for joint in robot.joints if joint.type == "prismatic"}
    for joint in robot.joints:
        _shift(joint.origin, by)
        if joint.name in slides and joint.limit is not None:
            _multiply(joint.limit, by, "lower", "upper", "velocity")
        if joint.mimic is not None:
            own, source = (by if name in slides else 1.0 for name in (joint.name, joint.mimic.joint))
            joint.mimic.multiplier = 1.0 if joint.mimic.multiplier is None else joint.mimic.multiplier
            _multiply(joint.mimic, own / source, "multiplier")
            _multiply(joint.mimic, own, "offset")
    for link in robot.links:
        if link.inertial is not None:
            _shift(link.inertial.origin, by)
            _multiply(link.inertial, by**2, "inertia")
        for shape in (*link.visuals, *link.collisions):
            _shift(shape.origin, by)
            solid = shape.geometry
            for part, fields in ((solid.box, ("size",)), (solid.cylinder, ("radius", "length")), (solid.sphere, ("radius",))):
                if part is not None:
                    _multiply(part, by, *fields)


def _shift(pose: np.ndarray | None, by: float) -> None:
    if pose is not None:
        pose[:3, 3] *= by


def _multiply(holder: object, by: float, *fields: str) -> None:
    for field in fields:
        value = getattr(holder, field)
        setattr(holder, field, None if value is None else np.asarray(value, float) * by if np.ndim(value) else value * by)


def suspect_degrees(tree: Tree, notes: Notes) -> None:
    """Warns of limits that look like degrees."""
    for joint in tree.joints.values():
        if joint.type == "revolute" and not joint.mimic and max(abs(joint.lower), abs(joint.upper)) > MAX_TURNS * math.tau:
            text = f"limits {joint.lower:g} .. {joint.upper:g} rad lie beyond {MAX_TURNS} turns, which looks like degrees"
            notes.add("warning", "joint", joint.name, f"{text}: if they are, import with --degrees")


def check_lengths(tree: Tree, spans: Spans, units: Units) -> None:
    """Checks that the robot has a plausible size. Factors from the user are not questioned.

    Raises:
        UserError: its arm is longer than ``MOST`` or shorter than ``LEAST``, or its largest mesh looks to be in millimetres.
    """
    far = [j for j in tree.joints.values() if j.type == "prismatic" and _slide(j) > MOST]
    if far and units.scale is None and _reach(tree) - sum(map(_slide, far)) <= MOST:
        joint = far[0]
        text = f"joint {joint.name!r} slides by up to {_slide(joint):.3g} m, as a base that drives does: hold it still with"
        raise UserError(f"{tree.name}: {text} --fix {joint.name}=0, or correct its limits, which are in metres")
    (file, scale), span = max(spans.items(), key=lambda item: item[1], default=(("", ()), 0.0))
    reach = _reach(tree)
    if units.scale is None and not _possible(tree, reach, span):
        by = 0.001 if reach > MOST else 1000
        meshes = f" --mesh-scale {by:g}" if (span > MAX_SPAN if reach > MOST else 0 < span < LEAST) else ""
        origins = (
            f"its joints are up to {reach:.3g} m from its base: the origins look to be in {'milli' if by < 1 else 'kilo'}metres"
        )
        raise UserError(f"{tree.name}: {origins}; import with --scale {by:g}{meshes} (--scale 1 takes them as they are)")
    offset = max(float(np.linalg.norm(j.origin[:3, 3])) for j in tree.joints.values())
    if units.mesh_scale is None and span > max(MAX_SPAN, MAX_SPANS * offset):
        wanted = " ".join(f"{s / 1000:g}" for s in scale)
        raise UserError(
            f"mesh {file!r} is {span:.3g} m large, but no joint is offset by more than {offset:.3g} m: the mesh looks to be in "
            f'millimetres; give it scale="{wanted}" in the URDF, or import with --mesh-scale 0.001'
        )


def _possible(tree: Tree, reach: float, span: float) -> bool:
    """True if the arm's length is plausible. All joints of a robot, or those of a simple one, may be at one place."""
    toy = sum(j.moves for j in tree.joints.values()) < SERIES and not 0 < span < LEAST
    return reach <= MOST and (toy or reach == 0 or reach >= LEAST)


def _reach(tree: Tree) -> float:
    """Greatest distance along the joints from the base to a link, with slides extended [m]."""
    far = {tree.root: 0.0}
    for joint in tree.joints.values():
        far[joint.child] = far[joint.parent] + float(np.linalg.norm(joint.origin[:3, 3])) + _slide(joint)
    return max(far.values())


def _slide(joint: Joint) -> float:
    return max(abs(joint.lower), abs(joint.upper)) if joint.type == "prismatic" else 0.0
