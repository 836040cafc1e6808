"""The robot of a URDF as plain values: links, joints and shapes, which the importer's other modules pass around."""

import dataclasses

import numpy as np
from jaxtyping import Float

Vec = Float[np.ndarray, "3"]
Matrix = Float[np.ndarray, "3 3"]
Pose = Float[np.ndarray, "4 4"]
Values = Float[np.ndarray, " n"]
Points = Float[np.ndarray, "n 3"]
Poses = Float[np.ndarray, "n 4 4"]

MOVING = ("revolute", "continuous", "prismatic")


@dataclasses.dataclass(frozen=True)
class Shape:
    """A visual or a collision.

    Attributes:
        kind: ``box``, ``sphere``, ``cylinder``, ``capsule`` or ``mesh``.
        size: full extents, (radius,) or (radius, length without a capsule's ends) [m]; for a mesh, its scale along x, y and z.
        origin: pose in the link [4, 4].
        file: a mesh's file, as the URDF names it.
        rgba: colour, if the URDF gives one.
    """

    kind: str
    size: tuple[float, ...]
    origin: Pose
    file: str = ""
    rgba: tuple[float, ...] | None = None


@dataclasses.dataclass(frozen=True)
class Mass:
    """Mass [kg], centre of mass [m] and inertia tensor about it [kg m2], in some frame."""

    mass: float
    com: Vec
    inertia: Matrix

    def moved(self, pose: Pose) -> "Mass":
        """Returns the same mass in the frame where its own frame has the ``pose`` [4, 4]."""
        turn = pose[:3, :3]
        return Mass(self.mass, turn @ self.com + pose[:3, 3], turn @ self.inertia @ turn.T)


def together(parts: list[Mass]) -> Mass:
    """Joins masses rigidly: masses add, tensors follow Steiner's theorem."""
    total = sum(p.mass for p in parts)
    com = sum((p.mass * p.com for p in parts), np.zeros(3)) / total if total > 0 else np.zeros(3)
    inertia = np.zeros((3, 3))
    for p in parts:
        d = p.com - com
        inertia += p.inertia + p.mass * (d @ d * np.eye(3) - np.outer(d, d))
    return Mass(total, com, inertia)


@dataclasses.dataclass(frozen=True)
class Link:
    name: str
    mass: Mass
    visuals: tuple[Shape, ...] = ()
    collisions: tuple[Shape, ...] = ()


@dataclasses.dataclass(frozen=True)
class Joint:
    """A joint. Limits are finite unless it is continuous; the axis has unit length, in the child's frame.

    Attributes:
        mimic: ``(source joint, multiplier, offset)``. The source is not a mimic itself; an empty source means held at ``offset``.
        effort, velocity: the URDF's limits; None if it has no usable one.
    """

    name: str
    type: str
    parent: str
    child: str
    origin: Pose
    axis: Vec
    lower: float = 0.0
    upper: float = 0.0
    effort: float | None = None
    velocity: float | None = None
    damping: float = 0.0
    friction: float = 0.0
    mimic: tuple[str, float, float] | None = None

    @property
    def moves(self) -> bool:
        return self.type in MOVING

    def motion(self, q: Values) -> Poses:
        """Displacement of the child [n, 4, 4] at positions ``q`` [n] (rad or m)."""
        out = np.tile(np.eye(4), (len(q), 1, 1))
        if self.type == "prismatic":
            out[:, :3, 3] = q[:, None] * self.axis
        else:
            x, y, z = self.axis
            cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
            sine, versine = np.sin(q)[:, None, None], (1 - np.cos(q))[:, None, None]
            out[:, :3, :3] += sine * cross + versine * (cross @ cross)  # Rodrigues
        return out


@dataclasses.dataclass(frozen=True)
class Tree:
    """A robot: links and joints by name, parents before children."""

    name: str
    root: str
    links: dict[str, Link]
    joints: dict[str, Joint]


@dataclasses.dataclass(frozen=True)
class Body:
    """Links that do not move against each other: one body of the model, named after the first of them.

    Attributes:
        joint: the joint that moves it; None for the base.
        parent: name of the body that carries it.
        frame: pose in the parent at joint position 0 [4, 4].
        links: name -> pose in this body [4, 4].
    """

    name: str
    joint: Joint | None
    parent: str
    frame: Pose
    links: dict[str, Pose]
    mass: Mass


def bodies(tree: Tree) -> dict[str, Body]:
    """Merges links that fixed joints hold together. Parents come before children."""
    home: dict[str, tuple[str, Pose]] = {tree.root: (tree.root, np.eye(4))}
    members: dict[str, dict[str, Pose]] = {tree.root: {tree.root: np.eye(4)}}
    moved: dict[str, tuple[Joint | None, str, Pose]] = {tree.root: (None, "", np.eye(4))}
    for joint in tree.joints.values():
        body, pose = home[joint.parent]
        pose = pose @ joint.origin
        if joint.moves:
            moved[joint.child] = joint, body, pose
            body, pose = joint.child, np.eye(4)
        home[joint.child] = body, pose
        members.setdefault(body, {})[joint.child] = pose
    return {
        name: Body(
            name, joint, parent, frame, members[name], together([tree.links[n].mass.moved(p) for n, p in members[name].items()])
        )
        for name, (joint, parent, frame) in moved.items()
    }


def below(parts: dict[str, Body], name: str) -> list[str]:
    """Lists a body and those that it carries."""
    found = [name]
    for other in parts.values():
        if other.parent in found:
            found.append(other.name)
    return found


def body_of(parts: dict[str, Body], link: str) -> Body:
    """Finds the body that a link belongs to."""
    return next(b for b in parts.values() if link in b.links)


def carriers(parts: dict[str, Body], name: str) -> list[str]:
    """Lists a body and those that carry it, down to the base."""
    return [name, *carriers(parts, parts[name].parent)] if name else []


def positions(parts: dict[str, Body], driven: dict[str, Values], n: int) -> dict[str, Values]:
    """Positions [n] of all joints: those given, 0 for the others, and what mimics follow from them."""
    joints = [b.joint for b in parts.values() if b.joint]
    q = {j.name: driven.get(j.name, np.zeros(n)) for j in joints}
    for j in joints:
        if j.mimic:
            source, multiplier, offset = j.mimic
            q[j.name] = multiplier * (q[source] if source else np.zeros(n)) + offset
    return q


def poses(parts: dict[str, Body], driven: dict[str, Values], n: int = 1) -> dict[str, Poses]:
    """Poses [n, 4, 4] of the bodies in the base's frame at joint positions [n]; joints not given are at 0."""
    q = positions(parts, driven, n)
    out: dict[str, Poses] = {}
    for name, body in parts.items():
        if body.joint is None:
            out[name] = np.tile(np.eye(4), (n, 1, 1))
        else:
            out[name] = out[body.parent] @ body.frame @ body.joint.motion(q[body.joint.name])
    return out
