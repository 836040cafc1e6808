"""A fence that keeps an arm above the table, within a box, and clear of itself. It computes the clearances of all links, for
several postures at once."""

import dataclasses

import numpy as np

from mjx_nero.deploy.body import Body

Box = tuple[tuple[float, float], tuple[float, float], tuple[float, float]]
_STEP = 1e-4  # finite difference [rad or m]
_SAMPLES, _ALWAYS = 300, 0.9  # number of postures; share of them in which links that touch are ignored, as made that way


@dataclasses.dataclass(frozen=True)
class FenceCfg:
    """Bounds for the links.

    Attributes:
        table: height of the table top in the world [m].
        press: depth to which commands may press into the table [m], because policies slide fingertips over it, and drives yield.
        box: ranges of x, y and z in the world that no link may leave [m]; None: the policy's task region plus ``room``.
        apart: minimum distance between links that are not neighbours [m].
        room: margin around the policy's task region if no box is given [m].
    """

    table: float = 0.0
    press: float = 0.003
    box: Box | None = None
    apart: float = 0.0
    room: float = 0.3


class Fence:
    """Computes signed clearances of moving shapes from the table and the box's sides, and of links from each other.

    Shapes that violate a limit at home (such as a foot below the table top) may be as close as they are at home, but not closer.

    Args:
        arm: names of the arm's joints, without the gripper's.
        home: home positions of all joints [rad or m].
        ranges: lower and upper limits of all joints [rad or m].

    Attributes:
        names: names of the constraints, for messages.
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
        """Selects the pairs of shapes to keep apart: all but those that touch at home or in nearly all postures."""
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
        """Computes the clearances [k, constraints] of postures [k, n] [m]; negative: not allowed."""
        return self._raw(q) - self._allowed

    def gradient(self, q: np.ndarray, constraint: int) -> np.ndarray:
        """Computes the gradient [n] of a clearance with respect to the joints."""
        around = self._raw(np.concatenate([q[None], q + _STEP * np.eye(len(q))]))[:, constraint]
        return (around[1:] - around[0]) / _STEP
