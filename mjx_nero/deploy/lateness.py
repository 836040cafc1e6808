"""The delay of an arm, found while it moves: after this time its joints are where they were told to be."""

import collections

import numpy as np

MOST = 8  # steps that are looked for
_WAY = 5  # steps: what is compared are ways over so many, for drives that sag are off by a constant
_FADE = 0.99  # of what was seen, a step
_ENOUGH = 0.02  # [rad^2] of ways that make a delay known


class Lateness:
    """Compares ways of the joints with those of their commands, for each delay of whole steps.

    Args:
        arm: which of the joints count.

    Attributes:
        steps: the delay that explains the readings best; 0 until the arm has moved enough.
    """

    def __init__(self, arm: np.ndarray):
        self._arm, self.steps = arm, 0
        self._told = collections.deque[np.ndarray](maxlen=MOST + _WAY + 1)
        self._read = collections.deque[np.ndarray](maxlen=_WAY + 1)
        self._off, self._moved = np.zeros(MOST + 1), 0.0

    def __call__(self, read: np.ndarray, told: np.ndarray) -> int:
        """Takes where the joints are, and what they were told last [rad or m]; returns ``steps``."""
        self._read.append(read[self._arm])
        self._told.append(told[self._arm])
        if len(self._told) == self._told.maxlen:
            way, ways = self._read[-1] - self._read[0], np.array(self._told)
            ways = (ways[_WAY:] - ways[:-_WAY])[::-1]  # [MOST + 1, joints], the newest first
            self._off = _FADE * self._off + ((way - ways) ** 2).sum(axis=1)
            self._moved = _FADE * self._moved + float(way @ way)
            if self._moved > _ENOUGH:
                self.steps = int(np.argmin(self._off))
        return self.steps
