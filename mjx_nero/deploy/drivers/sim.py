"""The simulated arm: MuJoCo's C library in real time, with the drives of training."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.arm import Clock, Feedback
from mjx_nero.deploy.emulators import plant as plants
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.executor import Lag


class SimArm:
    """An arm in a ``Plant``.

    Args:
        lead: lead of targets over moving positions, from ``executor.Lag`` [s].
    """

    def __init__(self, plant: Plant, joints: tuple[str, ...], lead: np.ndarray, clock: Clock):
        self.plant, self.joints, self._lead, self._clock = plant, joints, lead, clock

    def connect(self) -> None:
        """See ``Arm``."""

    def ranges(self) -> None:
        """See ``Arm``: the model's limits."""

    def engage(self) -> None:
        """See ``Arm``: the simulated drives hold from the start."""

    def read(self) -> Feedback:
        """See ``Arm``."""
        self.plant.advance()
        return Feedback(self._clock.now(), self.plant.position(), self.plant.velocity(), self.plant.load())

    def command(self, position: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """See ``Arm``."""
        told = position + self._lead * velocity
        self.plant.advance()
        self.plant.target(told)
        return told

    def close(self) -> None:
        """See ``Arm``."""


def of(metadata: Mapping[str, Any], clock: Clock, **scene: Any) -> SimArm:
    """Makes the arm of a scene; see ``plant.of``."""
    made = plants.of(metadata, clock, **scene)
    return SimArm(made, tuple(metadata["joints"]["names"]), Lag.of(metadata).lead, clock)
