"""Reads URDF text to a checked ``Tree``. Faults are repaired with a note, or raise an error that says what to do."""

import dataclasses
import io
import logging
import math
import pathlib
import re
from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
import yourdfpy
from lxml import etree

from mjx_nero import config
from mjx_nero.types import UserError
from mjx_nero.urdf import couplings, files, inertia, validate, xacro
from mjx_nero.urdf import units as units_of
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import MOVING, Joint, Link, Mass, Pose, Shape, Tree

MAX_MOVING = 100  # MuJoCo's XML reader nests no deeper than a few hundred bodies
RESERVED = {"link": ("world", "cube", "goal"), "joint": ("cube",)}  # names that scenes use
_ARGUMENT = re.compile(r"[\w.-]{1,40}")  # names of arguments that fit a message
_OTHERS = {"mujoco": "MuJoCo", "sdf": "Gazebo"}  # by outermost element
logging.getLogger("yourdfpy").setLevel(logging.CRITICAL)


def read(
    path: pathlib.Path,
    roots: files.Roots,
    notes: Notes,
    args: Mapping[str, str] = MappingProxyType({}),
    *,
    units: units_of.Units = units_of.METRES,
) -> tuple[Tree, Pose]:
    """Returns the robot that the file describes, and the pose of its root in the world [4, 4].

    An empty root link ``world`` with one fixed joint becomes that pose and leaves the tree. ``units`` states the units, if not
    metres and radians.

    Raises:
        UserError: the file is missing, too large, malformed, or describes no tree of links with fixed, revolute, continuous and
            prismatic joints.
    """
    root = files.parse_xml(files.read(path, files.MAX_URDF), str(path))
    unset: list[str] = []
    if xacro.is_xacro(root):
        unset = [
            name for arg in root.iter("{*}arg", "arg") if _ARGUMENT.fullmatch(name := arg.get("name", "")) and name not in args
        ]
        root = xacro.expand(root, path, roots, args, notes)
    elif args:
        raise UserError(f"--arg {next(iter(args))}: {path} is not a xacro file")
    if root.tag in _OTHERS:
        raise UserError(f"{path} is a model for {_OTHERS[root.tag]}, not a URDF: give the URDF or xacro of this robot")
    if root.tag != "robot":
        raise UserError(f"{path} is not a URDF: its outermost element is <{root.tag}>, not <robot>")
    if not (root.get("name") or "").strip():
        root.set("name", path.stem)
    root.set("name", "".join(c for c in root.get("name") if c.isprintable())[: validate.MAX_NAME].strip() or "robot")
    couplings.adopt(root, notes)
    validate.check(root, notes)
    try:
        urdf = yourdfpy.URDF.load(
            io.BytesIO(etree.tostring(root)),
            build_scene_graph=False,
            load_meshes=False,
            filename_handler=yourdfpy.filename_handler_null,
        )
    except Exception as error:  # yourdfpy fails in its own ways on what passed the checks above
        raise UserError(f"{path} cannot be read as a URDF: {type(error).__name__}: {' '.join(str(error).split())}") from None
    units_of.applied(urdf.robot, units)
    tree, mount = _tree(urdf.robot, notes, unset)
    if not units.degrees:
        units_of.suspect_degrees(tree, notes)
    return tree, mount


def _tree(robot: yourdfpy.Robot, notes: Notes, unset: list[str]) -> tuple[Tree, Pose]:
    """Returns what ``read`` does; ``unset`` are arguments of the file that may decide whether its parts are joined."""
    mount = _unmounted(robot, notes)
    rename = {kind: _free_names(kind, names, notes) for kind, names in _names(robot).items()}
    links = [rename["link"][link.name] for link in robot.links]
    if not links:
        raise UserError("the URDF has no links")
    joints = [_joint(j, rename, notes) for j in robot.joints]
    left_out = "".join(f" ({note.text})" for note in notes if note.text.startswith("left out: "))  # it may have had a link
    advice = f"; or set what joins it, --arg NAME:=VALUE ({', '.join(unset[:8])})" if unset else ""
    order, root = _ordered(links, joints, left_out + advice)
    colours = {m.name: _rgba(m) for m in robot.materials}
    read = {rename["link"][link.name]: link for link in robot.links}
    parsed = {name: _link(name, read[name], colours, notes) for name in [root, *(j.child for j in order)]}
    joined = {j.name: j for j in _with_mimics(order, robot, rename["joint"], notes)}
    return Tree(robot.name.strip(), root, parsed, joined), mount


def _unmounted(robot: yourdfpy.Robot, notes: Notes) -> Pose:
    """Removes the link ``world`` and its joint from ``robot``, if they are nothing more; returns the pose of the link below."""
    world = next((link for link in robot.links if link.name == "world"), None)
    below = [j for j in robot.joints if j.parent == "world"]
    heavy = world is not None and world.inertial is not None and bool(world.inertial.mass)
    if world is None or heavy or world.visuals or world.collisions or len(below) != 1 or below[0].type != "fixed":
        return np.eye(4)
    if any(j.child == "world" for j in robot.joints):
        return np.eye(4)
    robot.links.remove(world)
    robot.joints.remove(below[0])
    notes.add(
        "note", "link", below[0].child, f"stands where joint {below[0].name!r} puts it in the world: base_pos and base_quat"
    )
    return np.eye(4) if below[0].origin is None else below[0].origin


def _names(robot: yourdfpy.Robot) -> dict[str, list[str]]:
    return {"link": [link.name for link in robot.links], "joint": [joint.name for joint in robot.joints]}


def _free_names(kind: str, names: list[str], notes: Notes) -> dict[str, str]:
    """Returns name -> name in the model, which differs only if scenes use that name."""
    out = {}
    for name in names:
        out[name] = name
        while out[name] in RESERVED[kind] or out[name] != name and out[name] in names:
            out[name] += f"_{kind}"
        if out[name] != name:
            notes.add("warning", kind, out[name], f"called {name!r} in the URDF, a name that scenes use: renamed")
    return out


def _ordered(links: list[str], joints: list[Joint], why: str) -> tuple[list[Joint], str]:
    """Orders joints, parents first, and finds the root link. ``why`` ends the errors: what the file lacks may be the reason."""
    parent_of: dict[str, Joint] = {}
    for joint in joints:
        for link in (joint.parent, joint.child):
            if link not in links:
                lack = f"joint {joint.name!r} names link {link!r}, which is not there{config.hint(link, links)}"
                raise UserError(lack + why)
        if joint.child in parent_of:
            raise UserError(
                f"link {joint.child!r} hangs on two joints, {parent_of[joint.child].name!r} and {joint.name!r}: "
                "a URDF is a tree; remove one of them"
            )
        parent_of[joint.child] = joint
    roots = [link for link in links if link not in parent_of]
    if len(roots) > 1:
        names = ", ".join(map(repr, roots[:5])) + ", ..." * (len(roots) > 5)
        raise UserError(f"{len(roots)} links hang on no joint ({names}): join them to one root, or remove them{why}")
    children: dict[str, list[Joint]] = {}
    for joint in joints:
        children.setdefault(joint.parent, []).append(joint)
    order, stack = [], list(roots)
    while stack:
        below = children.get(stack.pop(0), [])
        order += below
        stack += [j.child for j in below]
    if len(order) != len(joints):
        loop = next(j for j in joints if j not in order)
        raise UserError(f"the joints form a loop, at joint {loop.name!r} and link {loop.child!r}: a URDF is a tree; cut the loop")
    return order, roots[0]


def _joint(joint: yourdfpy.Joint, rename: dict[str, dict[str, str]], notes: Notes) -> Joint:
    name = rename["joint"][joint.name]
    if joint.type not in (*MOVING, "fixed"):
        known = ", ".join((*MOVING, "fixed"))
        raise UserError(f"joint {name!r} is of type {joint.type!r}: {known} are known; a robot that floats cannot be imported")
    origin = np.eye(4) if joint.origin is None else joint.origin
    parent, child = (rename["link"].get(link, link) for link in (joint.parent, joint.child))
    if joint.type == "fixed":
        return Joint(name, "fixed", parent, child, origin, np.array([1.0, 0.0, 0.0]))
    length = float(np.linalg.norm(joint.axis))
    if not 1e-9 < length:
        raise UserError(f"joint {name!r} has the axis 0 0 0: give its direction")
    if abs(length - 1) > 1e-6:
        notes.add("repaired", "joint", name, f"the axis had length {length:g}, now 1")
    kind = "revolute" if _bounded(joint) else joint.type
    lower, upper = (0.0, 0.0) if joint.mimic else _limits(joint, name, notes)  # a follower takes its driver's
    effort, velocity = (_positive(joint.limit, field, name, notes) for field in ("effort", "velocity"))
    losses = {}
    for field in ("damping", "friction"):
        text = None if joint.dynamics is None else getattr(joint.dynamics, field)
        value = 0.0 if text is None else float(text)
        if not 0 <= value <= validate.MAX_NUMBER:
            notes.add("repaired", "joint", name, f"{field} was {value:g}, now 0")
            value = 0.0
        losses[field] = value
    axis, damping, friction = joint.axis / length, losses["damping"], losses["friction"]
    return Joint(name, kind, parent, child, origin, axis, lower, upper, effort, velocity, damping, friction)


def _positive(limit: yourdfpy.urdf.Limit | None, field: str, name: str, notes: Notes) -> float | None:
    value = None if limit is None else getattr(limit, field)
    if value is not None and 0 < value <= validate.MAX_NUMBER:
        return value
    notes.add("note", "joint", name, f"{field} limit: {'none' if value is None else f'{value:g}'}")
    return None


def _bounded(joint: yourdfpy.Joint) -> bool:
    """True if a continuous joint still gives usable limits, of less than a turn either way."""
    if joint.type != "continuous" or joint.limit is None or joint.limit.lower is None or joint.limit.upper is None:
        return False
    return joint.limit.lower < joint.limit.upper and max(abs(joint.limit.lower), abs(joint.limit.upper)) < math.tau


def _limits(joint: yourdfpy.Joint, name: str, notes: Notes) -> tuple[float, float]:
    if _bounded(joint):
        text = f"continuous, but with limits {joint.limit.lower:g} .. {joint.limit.upper:g}: they are used"
        notes.add("warning", "joint", name, text)
    elif joint.type == "continuous":
        notes.add("note", "joint", name, "continuous: no limits; drive targets within two turns either way")
        return -2 * math.tau, 2 * math.tau
    limit = joint.limit
    lower, upper = (None if limit is None else getattr(limit, side) for side in ("lower", "upper"))
    lower = 0.0 if lower is None and upper is not None else lower  # URDF's default
    upper = 0.0 if upper is None and lower is not None else upper
    usable = lower is not None and upper is not None and max(abs(lower), abs(upper)) <= validate.MAX_NUMBER and lower != upper
    if not usable:
        got = "has no limits" if lower is None else f"has the limits {lower:g} .. {upper:g}"
        if joint.type == "prismatic":
            raise UserError(f"prismatic joint {name!r} {got}: give it a range")
        notes.add("warning", "joint", name, f"{got}: half a turn either way is assumed")
        return -math.pi, math.pi
    assert lower is not None and upper is not None
    if lower > upper:
        notes.add("warning", "joint", name, f"limits {lower:g} .. {upper:g} are reversed: swapped")
        return upper, lower
    return lower, upper


def _with_mimics(joints: list[Joint], robot: yourdfpy.Robot, rename: dict[str, str], notes: Notes) -> list[Joint]:
    """Follows ``mimic`` of joints to the joint that is driven."""
    by_name = {j.name: j for j in joints}
    raw = {rename[j.name]: j.mimic for j in robot.joints if j.mimic is not None and by_name[rename[j.name]].moves}
    out = []
    for joint in joints:
        mimic = None
        if joint.name in raw:
            source, multiplier, offset = joint.name, 1.0, 0.0
            seen: list[str] = []
            while source in raw:
                if source in seen:
                    raise UserError(f"joint {joint.name!r} mimics itself by way of {', '.join(seen)}: remove one of these mimics")
                seen.append(source)
                tag = raw[source]
                offset += multiplier * (tag.offset or 0.0)
                multiplier *= 1.0 if tag.multiplier is None else tag.multiplier
                source = rename.get(tag.joint, tag.joint)
                if source not in by_name:
                    hint = config.hint(str(source), by_name)
                    raise UserError(f"joint {seen[-1]!r} mimics joint {source!r}, which is not there{hint}")
            if not (abs(multiplier) <= validate.MAX_NUMBER and abs(offset) <= validate.MAX_NUMBER):
                raise UserError(f"joint {joint.name!r} mimics {source!r} by a factor beyond {validate.MAX_NUMBER:g}: correct it")
            if not by_name[source].moves:
                notes.add("warning", "joint", joint.name, f"mimics the fixed joint {source!r}: held at {offset:g}")
                source = ""
            mimic = source, multiplier, offset
            joint = _following(joint, by_name[source] if source else None, (multiplier, offset))
        out.append(dataclasses.replace(joint, mimic=mimic))
    moving = sum(j.moves for j in out)
    if not any(j.moves and j.mimic is None for j in out):
        raise UserError("the URDF has no joint that moves: nothing to control")
    if moving > MAX_MOVING:
        raise UserError(f"the URDF has {moving} moving joints: more than {MAX_MOVING} are not supported")
    return out


def _following(joint: Joint, source: Joint | None, by: tuple[float, float]) -> Joint:
    """Gives a follower the limits that follow from its driver's; its own would stop the driver half way."""
    multiplier, offset = by
    ends = (multiplier * end + offset for end in ((source.lower, source.upper) if source else (0.0, 0.0)))
    lower, upper = sorted(ends)
    return dataclasses.replace(joint, lower=lower, upper=upper)


def _link(name: str, link: yourdfpy.Link, colours: dict[str, tuple[float, ...] | None], notes: Notes) -> Link:
    shapes: dict[str, list[Shape]] = {"visual": [], "collision": []}
    for tag, entries in (("visual", link.visuals), ("collision", link.collisions)):
        for entry in entries:
            material = getattr(entry, "material", None)
            rgba = (_rgba(material) or colours.get(material.name)) if material is not None else None
            try:
                shapes[tag].append(_shape(entry, rgba))
            except ValueError as error:
                notes.add("warning", "link", name, f"{tag} left out: {error}")
    mass = inertia.checked(link.inertial, name, notes) if link.inertial else Mass(0.0, np.zeros(3), np.zeros((3, 3)))
    return Link(name, mass, tuple(shapes["visual"]), tuple(shapes["collision"]))


def _shape(entry: yourdfpy.Visual | yourdfpy.Collision, rgba: tuple[float, ...] | None) -> Shape:
    origin = np.eye(4) if entry.origin is None else entry.origin
    g = entry.geometry
    if g.mesh is not None:
        scale = (1.0,) * 3 if g.mesh.scale is None else tuple(np.broadcast_to(np.asarray(g.mesh.scale, float), 3).tolist())
        if 0.0 in scale:
            raise ValueError("its mesh is scaled to nothing")
        return Shape("mesh", scale, origin, g.mesh.filename, rgba)
    if g.box is not None:
        kind, size = "box", tuple(map(float, g.box.size))
    elif g.sphere is not None:
        kind, size = "sphere", (g.sphere.radius,)
    else:
        kind = "capsule" if entry.name == validate.CAPSULE else "cylinder"
        size = g.cylinder.radius, g.cylinder.length
        if kind == "capsule" and 0 <= g.cylinder.length <= 1e-6:
            kind, size = "sphere", size[:1]
    if min(size) <= 1e-6:
        raise ValueError(f"its {kind} has the size {' '.join(f'{s:g}' for s in size)}")
    return Shape(kind, size, origin, rgba=rgba)


def _rgba(material: yourdfpy.Material | None) -> tuple[float, ...] | None:
    if material is None or material.color is None:
        return None
    return tuple(np.clip(np.nan_to_num(material.color.rgba), 0, 1).tolist())
