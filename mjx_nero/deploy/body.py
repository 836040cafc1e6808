"""Forward kinematics and clearances in numpy, for many postures at once, of the robot that an exported policy describes."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

Vector = Sequence[float] | np.ndarray
STILL = np.array([1.0, 0.0, 0.0, 0.0])


def matrix(quat: Vector) -> np.ndarray:
    """Returns the rotation matrix [3, 3] of a quaternion (wxyz) of any length."""
    w, x, y, z = np.asarray(quat, float) / np.linalg.norm(quat)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Multiplies quaternions (wxyz): rotation ``b`` first, then ``a``."""
    (aw, *av), (bw, *bv) = a, b
    return np.append(aw * bw - np.dot(av, bv), aw * np.array(bv) + bw * np.array(av) + np.cross(av, bv))


def transform(pos: Vector, quat: Vector = STILL) -> np.ndarray:
    """Returns the transform [4, 4] of a position [m] and an orientation (wxyz)."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = matrix(quat), pos
    return out


@dataclasses.dataclass(frozen=True)
class Node:
    """A joint in the tree. ``still + sine sin(q) + cosine cos(q) + slide q``, each [4, 4], maps its frame to its parent's."""

    parent: int
    joint: int
    still: np.ndarray
    sine: np.ndarray
    cosine: np.ndarray
    slide: np.ndarray


def _node(parent: int, joint: int, fixed: np.ndarray, what: Mapping[str, Any]) -> Node:
    axis = np.asarray(what["axis"], float) / np.linalg.norm(what["axis"])
    still, sine, cosine, slide = np.zeros((4, 4, 4))
    if what["type"] == "slide":
        still, slide[:3, 3] = np.eye(4), axis
    else:
        along = np.outer(axis, axis)
        x, y, z = axis
        still[:3, :3], cosine[:3, :3], still[3, 3] = along, np.eye(3) - along, 1.0
        sine[:3, :3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return Node(parent, joint, *(fixed @ part for part in (still, sine, cosine, slide)))


class Body:
    """A robot's links. Postures are arrays [k, n] along ``joints`` [rad or m]; results are in the world frame.

    Args:
        description: result of ``interop.description.body``.
        joints: names of the joints, in the order of all joint vectors.
        base: position of the robot's base, the origin of observed positions [m].

    Attributes:
        names: names of the shapes, followed by the names of the links that joints move, for their origins.
        depth: number of ``joints`` that move each of these.
    """

    def __init__(self, description: Mapping[str, Any], joints: Sequence[str], base: Sequence[float] = (0.0, 0.0, 0.0)):
        self.joints, self.base = tuple(joints), np.asarray(base, float)
        self._couplings = list(description["couplings"])
        self._columns = {name: i for i, name in enumerate(joints)}
        for coupling in self._couplings:
            self._columns.setdefault(coupling["follower"], len(self._columns))
        self._zero = np.zeros(len(self._columns))
        self._nodes: list[Node] = []
        places: dict[str | None, tuple[int, np.ndarray]] = {None: (-1, np.eye(4))}
        for body in description["bodies"]:
            if body["name"] in places:
                raise ValueError(f"two bodies are called {body['name']!r}")
            places[body["name"]] = self._place(body, *places[body["parent"]])
        del places[None]
        self._set_shapes(description["shapes"], places)
        ee = description["ee"]
        node, fixed = places[ee["body"]]
        self._ee = node, fixed @ transform(ee["pos"], ee["quat"])
        self._turns = self._turns_to(description)

    def _turns_to(self, description: Mapping[str, Any]) -> list[tuple[int, np.ndarray]]:
        """Lists the rotations from the world to the end effector: fixed quaternions (joint -1), and axes of hinges.

        Two quaternions describe each rotation. A policy has learnt the one that is the product of this list.
        """
        bodies, ee = {body["name"]: body for body in description["bodies"]}, description["ee"]
        turns, name = [(-1, np.array(ee["quat"], float))], ee["body"]
        while name is not None:
            body = bodies[name]
            for joint in reversed(body["joints"]):
                if joint["name"] in self._columns and joint["type"] == "hinge":
                    axis = np.asarray(joint["axis"], float)
                    turns.append((self._columns[joint["name"]], axis / np.linalg.norm(axis)))
            turns.append((-1, np.array(body["quat"], float)))
            name = body["parent"]
        return turns[::-1]

    def _place(self, body: Mapping[str, Any], node: int, fixed: np.ndarray) -> tuple[int, np.ndarray]:
        """Returns the joint that carries a body, and the body's pose in the joint's frame."""
        fixed = fixed @ transform(body["pos"], body["quat"])
        for joint in body["joints"]:
            column = self._columns.get(joint["name"])
            if column is None:  # it never moves
                continue
            self._zero[column] = joint["zero"]
            self._nodes.append(_node(node, column, fixed @ transform(joint["pos"]), joint))
            node, fixed = len(self._nodes) - 1, transform(-np.asarray(joint["pos"], float))
        return node, fixed

    def _set_shapes(self, shapes: Sequence[Mapping[str, Any]], places: Mapping[str | None, tuple[int, np.ndarray]]) -> None:
        """Stores the shapes, and the origins of moving links as spheres of radius zero."""
        origins = [
            {"name": name, "body": name, "type": "sphere", "size": [0.0, 0.0, 0.0]} for name, (at, _) in places.items() if at >= 0
        ]
        frames, half, radius, capsules, rounds = [], [], [], [], []
        self._owner: list[int] = []
        for shape in (*shapes, *origins):
            node, fixed = places[shape["body"]]
            self._owner.append(node)
            frames.append(fixed @ transform(shape.get("pos", np.zeros(3)), shape.get("quat", STILL)))
            edges, round_, ball = _extent(shape["type"], np.asarray(shape["size"], float))
            half.append(edges)
            rounds.append(round_)
            radius.append(ball)
            capsules.append(_capsule(edges, round_, ball))
        self.names = tuple(shape["name"] for shape in (*shapes, *origins))
        self.solid = len(shapes)  # number of shapes that have an extent
        self._frames, self._half, self._round, self._ball = (np.array(x) for x in (frames, half, rounds, radius))
        self._ends, self._radius = np.array([c[0] for c in capsules]), np.array([c[1] for c in capsules])
        self.depth = np.array([self._depth(node) for node in self._owner])

    def _depth(self, node: int) -> int:
        moved = set()
        while node >= 0:
            moved.add(self._nodes[node].joint)
            node = self._nodes[node].parent
        return len(moved)

    def link(self, names: Sequence[str]) -> np.ndarray:
        """Counts how many of the named joints move each shape."""
        wanted = {self._columns[name] for name in names}
        out = []
        for node in self._owner:
            count = 0
            while node >= 0:
                count += self._nodes[node].joint in wanted
                node = self._nodes[node].parent
            out.append(count)
        return np.array(out)

    def forward(self, q: np.ndarray) -> np.ndarray:
        """Computes the joints' frames [k, nodes + 1, 4, 4]; the last one is the world's, so that index -1 finds it."""
        q = self._all(np.atleast_2d(np.asarray(q, float)))
        out = np.empty((len(q), len(self._nodes) + 1, 4, 4))
        out[:, -1] = np.eye(4)
        sine, cosine = np.sin(q)[..., None, None], np.cos(q)[..., None, None]
        for i, node in enumerate(self._nodes):
            j = node.joint
            own = node.still + node.sine * sine[:, j] + node.cosine * cosine[:, j] + node.slide * q[:, j, None, None]
            np.matmul(out[:, node.parent], own, out=out[:, i])
        return out

    def _all(self, q: np.ndarray) -> np.ndarray:
        """Adds the joints that follow others, and subtracts each joint's zero position."""
        if self._couplings:
            q = np.concatenate([q, np.zeros((len(q), len(self._columns) - q.shape[1]))], axis=1)
            for c in self._couplings:
                leader = q[:, self._columns[c["leader"]]] - c["reference"] if c["leader"] != c["follower"] else np.zeros(len(q))
                powers = leader[:, None] ** np.arange(len(c["coefficients"]))
                q[:, self._columns[c["follower"]]] = powers @ np.asarray(c["coefficients"])
        return q - self._zero

    def ee(self, q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Computes position [m] and orientation (wxyz) of the end effector in the world, for one posture."""
        half, quat = self._all(np.atleast_2d(np.asarray(q, float)))[0] / 2, STILL
        for joint, turn in self._turns:
            quat = product(quat, turn if joint < 0 else np.append(np.cos(half[joint]), np.sin(half[joint]) * turn))
        return self.hands(q)[0], quat

    def hands(self, q: np.ndarray) -> np.ndarray:
        """Computes the end effector's positions in the world [k, 3] [m]."""
        node, fixed = self._ee
        return (self.forward(q)[:, node] @ fixed)[:, :3, 3]

    def shapes(self, q: np.ndarray) -> np.ndarray:
        """Computes the frames of all shapes [k, shapes, 4, 4]."""
        return self.forward(q)[:, self._owner] @ self._frames

    def bounds(self, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Computes the minimum and maximum coordinates of all shapes in the world, [k, shapes, 3] each [m]."""
        turn = frames[..., :3, :3]
        reach = np.abs(turn) @ self._half[..., None]
        flat = self._round[:, None] * np.sqrt(np.maximum(0.0, 1 - turn[..., 2] ** 2))  # reach of a cylinder's ends
        reach = reach[..., 0] + flat + self._ball[:, None]
        return frames[..., :3, 3] - reach, frames[..., :3, 3] + reach

    def apart(self, frames: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Computes distances [k, pairs] between the bounding capsules of shapes [m]; negative if they overlap.

        Args:
            pairs: indices of shapes [pairs, 2].
        """
        if not len(pairs):
            return np.full((len(frames), 0), np.inf)
        ends = frames[..., None, :3, :3] @ self._ends[..., None]  # [k, shapes, 2, 3, 1]
        ends = ends[..., 0] + frames[..., None, :3, 3]
        a, b = ends[:, pairs[:, 0]], ends[:, pairs[:, 1]]
        return _between(a[..., 0, :], a[..., 1, :], b[..., 0, :], b[..., 1, :]) - self._radius[pairs].sum(1)


def _extent(kind: str, size: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Describes a shape as the sum of a box (half edges), a disc across z (radius), and a ball (radius)."""
    size = np.concatenate([size, np.zeros(3)])[:3]
    if kind == "box":
        return size, 0.0, 0.0
    if kind == "sphere":
        return np.zeros(3), 0.0, float(size[0])
    along = np.array([0.0, 0.0, size[1]])
    return (along, 0.0, float(size[0])) if kind == "capsule" else (along, float(size[0]), 0.0)


def _capsule(half: np.ndarray, round_: float, ball: float) -> tuple[np.ndarray, float]:
    """Returns the bounding capsule of a shape: its ends [2, 3], and its radius [m]."""
    k = int(np.argmax(half))
    along = np.zeros(3)
    along[k] = half[k]
    return np.stack([-along, along]), float(np.linalg.norm(np.delete(half, k))) + round_ + ball


def _between(p: np.ndarray, p_end: np.ndarray, q: np.ndarray, q_end: np.ndarray) -> np.ndarray:
    """Computes distances between segments [..., 3]. The nearest points lie inside both, or at an end of one."""
    d, e, r = p_end - p, q_end - q, p - q
    a, b, c = _dot(d, d), _dot(d, e), _dot(e, e)
    f, g = _dot(d, r), _dot(e, r)
    tiny = 1e-18
    aa, cc = np.maximum(a, tiny), np.maximum(c, tiny)
    across = a * c - b * b
    s = np.where(across > 1e-12 * aa * cc, np.clip((b * g - c * f) / np.maximum(across, tiny), 0, 1), 0.0)
    t = np.clip((b * s + g) / cc, 0, 1)
    s = np.clip((b * t - f) / aa, 0, 1)
    return np.linalg.norm(r + s[..., None] * d - t[..., None] * e, axis=-1)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", a, b)
