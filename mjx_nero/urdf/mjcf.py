"""Writes ``model.xml``: the robot as an MJCF, in the conventions of the package's own models."""

from collections.abc import Iterable, Mapping

import numpy as np
from lxml import etree

from mjx_nero.sim import quats
from mjx_nero.urdf import primitives
from mjx_nero.urdf.drawing import Visual
from mjx_nero.urdf.tree import Body, Joint, Mass, Pose

TABLE, CUBE = 1, 2  # contact bits of the scenes
_PAD = {  # the values of assets/nero/nero.xml, which gives the reasons
    "condim": "4",
    "priority": "1",
    "friction": "1 0.02 0.001",
    "solref": "0.02 1",
    "solimp": "0.95 0.98 0.001",
}
_HEAD = " Made by python -m mjx_nero import-urdf; report.json tells what was changed and guessed. Robot only: scenes add drives. "


def document(
    title: str,
    parts: Mapping[str, Body],
    masses: Mapping[str, Mass],
    drawn: Mapping[str, list[Visual]],
    collisions: Mapping[str, list[tuple[str, primitives.Primitive, int]]],
    site: tuple[str, str, Pose],
    armature: Mapping[str, float],
    rest: Mapping[str, float],
) -> str:
    """Returns the XML text.

    Args:
        title: the model's name.
        parts: bodies, parents first. Joints and links keep their names; merged links remain as sites.
        masses: body -> mass in the body's frame.
        drawn: link -> visual geoms in the link's frame.
        collisions: link -> (name, shape in the link's frame, contact bits).
        site: name of the grasp point, its link, and its pose there [4, 4].
        armature: joint -> rotor inertia [kg m2 or kg].
        rest: joint -> position in the home pose [rad, m]. It is the reference of followers, so that they start where their
            source's home puts them.
    """
    root = etree.Element("mujoco", model=title)
    root.append(etree.Comment(_HEAD))
    etree.SubElement(root, "compiler", angle="radian", autolimits="true", meshdir="meshes")
    asset = etree.SubElement(root, "asset")
    for mesh in dict.fromkeys(d.mesh for items in drawn.values() for d in items if d.mesh):
        etree.SubElement(asset, "mesh", name=mesh, file=f"{mesh}.stl")
    elements = {"": etree.SubElement(root, "worldbody")}
    for body in parts.values():
        # MuJoCo displaces a joint from its reference, so the body's frame is given there, and poses stay the URDF's.
        frame = body.frame
        if body.joint and body.joint.mimic:
            frame = frame @ body.joint.motion(np.array([rest[body.joint.name]]))[0]
        element = etree.SubElement(elements[body.parent], "body", name=body.name, **_pose(frame))
        elements[body.name] = element
        _inertial(element, masses[body.name])
        if body.joint:
            _joint(element, body.joint, armature[body.joint.name], rest)
        for link, at in body.links.items():
            for item in drawn[link]:
                _drawn(element, item, at)
            for label, shape, bits in collisions[link]:
                _collision(element, label, shape, bits, at)
            if link != body.name:
                etree.SubElement(element, "site", name=link, group="5", size="0.002", **_pose(at))
            if link == site[1]:
                look = {"size": "0.004", "group": "4", "rgba": "0.1 0.8 0.3 0.3"}
                etree.SubElement(element, "site", name=site[0], **look, **_pose(at @ site[2]))
    mimics = [b.joint for b in parts.values() if b.joint and b.joint.mimic]
    if mimics:
        equality = etree.SubElement(root, "equality")
        for joint in mimics:
            _mimic(equality, joint, rest)
    return etree.tostring(root, pretty_print=True, encoding="unicode")


def _inertial(element: etree._Element, mass: Mass) -> None:
    if mass.mass <= 0:
        return
    moments, axes = np.linalg.eigh(mass.inertia)
    axes = axes * np.sign(np.linalg.det(axes))
    # Rounding may put the largest moment of a flat body just above the sum of the others, which MuJoCo refuses.
    moments[2] = min(moments[2], moments[0] + moments[1])
    place = _pose(primitives.pose(axes, mass.com))
    figures = {"mass": repr(float(mass.mass)), "diaginertia": _text(moments), "pos": "0 0 0", **place}
    etree.SubElement(element, "inertial", **figures)


def _collision(element: etree._Element, label: str, shape: primitives.Primitive, bits: int, at: Pose) -> None:
    geom = {"name": label, "type": shape.kind, "size": _text(shape.size), **_pose(at @ shape.pose)}
    geom |= {"group": "3", "contype": "0", "conaffinity": str(bits), "mass": "0", "rgba": "0.9 0.3 0.2 0.5"}
    etree.SubElement(element, "geom", **geom, **(_PAD if bits & CUBE else {}))


def _mimic(element: etree._Element, joint: Joint, rest: Mapping[str, float]) -> None:
    assert joint.mimic is not None
    source, multiplier, offset = joint.mimic
    both = {"joint1": joint.name} | ({"joint2": source} if source else {})
    terms = (offset - rest[joint.name], multiplier if source else 0.0, 0.0, 0.0, 0.0)  # relative to references; a source's is 0
    etree.SubElement(element, "joint", **both, polycoef=_text(terms), solref="0.02 1", solimp="0.95 0.99 0.001")


def _joint(element: etree._Element, joint: Joint, armature: float, rest: Mapping[str, float]) -> None:
    row = {"name": joint.name, "type": "slide" if joint.type == "prismatic" else "hinge", "axis": _text(joint.axis)}
    row |= {"range": _text((joint.lower, joint.upper)), "armature": repr(float(armature))}
    if joint.mimic:
        row["ref"] = repr(float(rest[joint.name]))
    if joint.type == "continuous" or joint.mimic:
        row["limited"] = "false"
    if joint.damping:
        row["damping"] = repr(joint.damping)
    if joint.friction:
        row["frictionloss"] = repr(joint.friction)
    etree.SubElement(element, "joint", **row)


def _drawn(element: etree._Element, item: Visual, at: Pose) -> None:
    shape = {"mesh": item.mesh} if item.mesh else {"size": _text(item.size)}
    look = {"group": "2", "contype": "0", "conaffinity": "0", "mass": "0", "rgba": _text(item.rgba)}
    etree.SubElement(element, "geom", type=item.kind, **shape, **look, **_pose(at @ item.pose))


def _pose(pose: Pose) -> dict[str, str]:
    """Writes ``pos`` and ``quat``, omitted where they are zero."""
    quat = quats.of_matrix(pose[:3, :3])
    out = {} if not pose[:3, 3].any() else {"pos": _text(pose[:3, 3])}
    return out if np.array_equal(np.abs(quat), [1, 0, 0, 0]) else {**out, "quat": _text(quat)}


def _text(numbers: Iterable[float]) -> str:
    """Writes all digits, so that poses equal the URDF's."""
    return " ".join(repr(float(v)) for v in numbers)
