"""Measures the delay of an arm while it moves: the time after which its joints reach their commanded positions."""

import collections

import numpy as np

MOST = 8  # maximum delay [control steps]
_WAY = 5  # control steps over which motions are compared; motions, because drives that sag are off by a constant
_FADE = 0.99  # weight of past observations, per step
_ENOUGH = 0.02  # squared motion [rad^2] from which on a delay is known


class Lateness:
    """Compares the motion of the joints with that of their commands, for each delay in whole control steps.

    Args:
        arm: which of the joints count.

    Attributes:
        steps: the delay that explains the readings best [control steps]; 0 until the arm has moved enough.
    """

    def __init__(self, arm: np.ndarray):
        self._arm, self.steps = arm, 0
        self._told = collections.deque[np.ndarray](maxlen=MOST + _WAY + 1)
        self._read = collections.deque[np.ndarray](maxlen=_WAY + 1)
        self._off, self._moved = np.zeros(MOST + 1), 0.0

    def __call__(self, read: np.ndarray, told: np.ndarray) -> int:
        """Adds the joints' positions and their last commands [rad or m]; returns ``steps``."""
        self._read.append(read[self._arm])
        self._told.append(told[self._arm])
        if len(self._told) == self._told.maxlen:
            way, ways = self._read[-1] - self._read[0], np.array(self._told)
            ways = (ways[_WAY:] - ways[:-_WAY])[::-1]  # [MOST + 1, joints], newest first
            self._off = _FADE * self._off + ((way - ways) ** 2).sum(axis=1)
            self._moved = _FADE * self._moved + float(way @ way)
            if self._moved > _ENOUGH:
                self.steps = int(np.argmin(self._off))
        return self.steps
