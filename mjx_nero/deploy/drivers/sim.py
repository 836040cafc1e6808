"""The simulated arm: MuJoCo's C library in real time, with the drives of training."""

import dataclasses
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from mjx_nero.deploy.arm import Clock, Feedback
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.places import sender


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


def of(
    metadata: Mapping[str, Any],
    joints: tuple[str, ...],
    lead: np.ndarray,
    clock: Clock,
    model: str,
    tracker: int | None = None,
    start: Sequence[float] | None = None,
    objects: Mapping[str, Sequence[float]] | None = None,
    **faults: Any,
) -> SimArm:
    """Makes the arm of a model file (``.mjb``).

    Args:
        tracker: port of this machine to which object positions are sent.
        start: first positions of the joints [rad or m]; None: home.
        objects: first positions of the objects, in the root frame [m].
        faults: fields of ``emulators.plant.Faults``.
    """
    at = np.array(metadata["joints"]["home"] if start is None else start, float)
    told = sender("127.0.0.1", tracker) if tracker else None
    plant = Plant(pathlib.Path(model), joints, at, clock, metadata["base"]["position"], told)
    plant.faults = dataclasses.replace(plant.faults, **faults)
    plant.reset(at, {name: np.array(position, float) for name, position in (objects or {}).items()})
    return SimArm(plant, joints, lead, clock)
