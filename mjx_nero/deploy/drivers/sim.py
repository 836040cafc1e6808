"""The simulated arm: MuJoCo's C library in real time, with the drives of training."""

import pathlib

import numpy as np

from mjx_nero.deploy.arm import Clock, Feedback
from mjx_nero.deploy.emulators.plant import Plant


class SimArm:
    """An arm of a ``Plant``.

    Args:
        lead: of ``executor.Lag``: how far targets have to lead positions that move [s].
    """

    def __init__(self, plant: Plant, joints: tuple[str, ...], lead: np.ndarray, clock: Clock):
        self.plant, self.joints, self._lead, self._clock = plant, joints, lead, clock

    def connect(self) -> None:
        """See ``Arm``."""

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


def of(model: str, joints: tuple[str, ...], start: np.ndarray, lead: np.ndarray, clock: Clock, **plant) -> SimArm:
    """The arm of a model's file."""
    return SimArm(Plant(pathlib.Path(model), joints, start, clock, **plant), joints, lead, clock)
