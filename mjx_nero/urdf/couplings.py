"""Couplings of joints: those that a file states outside of ``<mimic>``, and fingers left behind by their twins."""

from collections.abc import Iterator
from typing import NamedTuple

from lxml import etree

from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Tree, bodies, body_of

DRIVERS = ("ros2_control", "transmission")  # elements that describe drives, and may couple joints


class _Stated(NamedTuple):
    """A coupling as a file states it; ``where`` is the element."""

    follower: str
    source: str
    multiplier: str
    offset: str
    where: str


def adopt(root: etree._Element, notes: Notes) -> None:
    """Gives joints, in place, the ``<mimic>`` that a simulator's plugin or a driver's parameters state.

    The URDF's own ``<mimic>`` has priority. A coupling with an unknown joint, or one that closes a loop, is left out with a note.
    """
    joints = {(j.get("name") or "").strip(): j for j in root.findall("joint")}
    follows = {name: (j.find("mimic").get("joint") or "").strip() for name, j in joints.items() if j.find("mimic") is not None}
    for stated in _stated(root):
        joint = joints.get(stated.follower)
        if joint is None or stated.follower in follows or joint.get("type") == "fixed":
            continue
        text = f"<{stated.where}> lets it follow joint {stated.source[:60]!r}"
        if stated.source not in joints:
            notes.add("note", "joint", stated.follower, f"{text}, which is not there: left out")
        elif stated.follower in _followed(stated.source, follows):
            notes.add("note", "joint", stated.follower, f"{text}, which follows it: left out")
        else:
            figures = {"multiplier": stated.multiplier or "1", "offset": stated.offset or "0"}
            etree.SubElement(joint, "mimic", joint=stated.source, **figures)
            follows[stated.follower] = stated.source
            notes.add("note", "joint", stated.follower, f"{text}: read as its <mimic>")


def _stated(root: etree._Element) -> Iterator[_Stated]:
    """Yields stated couplings.

    Gazebo's plugins name a ``joint`` and its follower; ros2_control gives the follower a parameter.
    """
    for plugin in root.iterfind("gazebo//plugin"):
        source, follower, multiplier, offset = (
            (plugin.findtext(tag) or "").strip() for tag in ("joint", "mimicJoint", "multiplier", "offset")
        )
        if source and follower:
            yield _Stated(follower, source, multiplier, offset, "gazebo")
    for where in DRIVERS:
        for joint in root.iterfind(f".//{where}//joint"):
            given = {p.get("name"): (p.text or "").strip() for p in joint.findall("param")}
            if given.get("mimic"):
                rest = given.get("multiplier", ""), given.get("offset", "")
                yield _Stated((joint.get("name") or "").strip(), given["mimic"], *rest, where)


def _followed(source: str, follows: dict[str, str]) -> set[str]:
    """Returns a joint and all joints that it follows, directly or not."""
    found: set[str] = set()
    while source and source not in found:
        found.add(source)
        source = follows.get(source, "")
    return found


def warn_of_frozen(read: Tree, used: Tree, gripper: tuple[str, ...], notes: Notes) -> None:
    """Warns of fingers that are held still while their twins move: joints of the same kind on the same body.

    Args:
        read, used: the robot before and after holding still what belongs to neither arm nor gripper.
        gripper: joints that drive the gripper.
    """
    parts = bodies(read)

    def kind(name: str) -> tuple[str, bool]:
        joint = read.joints[name]
        return body_of(parts, joint.parent).name, joint.type == "prismatic"

    moving = {kind(n): n for n, j in used.joints.items() if j.moves and (n in gripper or j.mimic and j.mimic[0] in gripper)}
    for name, joint in read.joints.items():
        if not joint.moves or joint.type == "continuous" or used.joints[name].moves or kind(name) not in moving:
            continue
        twin = moving[kind(name)]
        driver = (used.joints[twin].mimic or (twin,))[0]
        if joint.mimic and not read.joints[joint.mimic[0]].moves:
            continue
        advice = f'give it <mimic joint="{driver}"/> in the URDF, or drive both: --gripper {",".join((*gripper, name))}'
        notes.add("warning", "joint", name, f"held still while its twin {twin!r} moves: {advice}")
