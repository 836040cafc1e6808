"""A fence around an arm: above the table, within a box, and clear of itself. It computes clearances of all links, for several
postures at once."""

import dataclasses

import numpy as np

from mjx_nero.deploy.body import Body

Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
_STEP = 1e-4  # of a finite difference [rad or m]
_SAMPLES, _ALWAYS = 300, 0.9  # postures looked at; links that touch in so many of them are made that way


@dataclasses.dataclass(frozen=True)
class FenceCfg:
    """Bounds for the links.

    Attributes:
        table: height of the table's top, in the world [m].
        press: how far commands may press into it [m]: policies slide fingertips over the table, and drives give way.
        box: ranges of x, y and z in the world that no link may leave [m]; None: what the policy's task needs, and some room.
        apart: between links that do not follow one another, at least [m].
        room: about what the policy's task needs, where no box is given [m].
    """

    table: float = 0.0
    press: float = 0.003
    box: Box | None = None
    apart: float = 0.0
    room: float = 0.3


class Fence:
    """Signed clearances: of each moving shape from the table and from the box's sides, and of links from one another.

    What is closer than that at home already (an arm whose foot stands below the table's top) may be as close there, no closer.

    Args:
        arm: names of the arm's joints, without the gripper's.
        home: of all joints [rad or m].
        ranges: of all joints, the least and the greatest [rad or m].

    Attributes:
        names: of the constraints, for messages.
    """

    def __init__(self, body: Body, arm: tuple[str, ...], home: np.ndarray, ranges: tuple[np.ndarray, np.ndarray], cfg: FenceCfg):
        if cfg.box is None:
            raise ValueError("a fence needs a box: see room_for")
        self._body, self._cfg = body, cfg
        link = body.link(arm)
        self._moving = np.flatnonzero(link > 0)
        solid = range(body.solid)
        pairs = [(i, j) for i in solid for j in solid if i < j and abs(link[i] - link[j]) > 1]
        self._pairs = self._meeting(np.array(pairs, int).reshape(-1, 2), home, ranges)
        low, high = np.array(cfg.box).T
        self._low, self._high = np.maximum(low, [-np.inf, -np.inf, cfg.table - cfg.press]), high
        below = "the table" if cfg.table - cfg.press >= low[2] else "z from below"
        sides = ("x from below", "y from below", below, "x from above", "y from above", "z from above")
        links = [
            f"{body.names[i]} at {side} of the box" if "from" in side else f"{body.names[i]} at {side}"
            for i in self._moving
            for side in sides
        ]
        self.names = (*links, *(f"{body.names[i]} and {body.names[j]}" for i, j in self._pairs))
        self._allowed = np.minimum(0.0, self._raw(home)[0])

    def _meeting(self, pairs: np.ndarray, home: np.ndarray, ranges: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        """The pairs of shapes that ought to be apart: not those that touch at home, or in nearly all postures."""
        low, high = ranges
        postures = np.concatenate([home[None], low + (high - low) * np.random.default_rng(0).random((_SAMPLES, len(home)))])
        touching = self._body.apart(self._body.shapes(postures), pairs) < 0
        return pairs[~touching[0] & (touching.mean(axis=0) < _ALWAYS)]

    def _raw(self, q: np.ndarray) -> np.ndarray:
        frames = self._body.shapes(q)
        low, high = self._body.bounds(frames)
        sides = np.concatenate([low - self._low, self._high - high], axis=-1)[:, self._moving]
        apart = self._body.apart(frames, self._pairs) - self._cfg.apart
        return np.concatenate([sides.reshape(len(frames), -1), apart], axis=1)

    def clearance(self, q: np.ndarray) -> np.ndarray:
        """[k, constraints] of postures [k, n]; negative: not allowed [m]."""
        return self._raw(q) - self._allowed

    def gradient(self, q: np.ndarray, constraint: int) -> np.ndarray:
        """[n] how a clearance changes with the joints."""
        around = self._raw(np.concatenate([q[None], q + _STEP * np.eye(len(q))]))[:, constraint]
        return (around[1:] - around[0]) / _STEP
