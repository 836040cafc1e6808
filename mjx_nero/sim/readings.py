"""Reads what a scene's sensors measure: contacts (``sim.touch``), and the forces at the wrist and the pads (``sim.forces``)."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim.forces import FINGERS, WRIST
from mjx_nero.sim.touch import HAND, NAME


@dataclasses.dataclass(frozen=True)
class Reading:
    """One entry of ``Sim.readings``, in NumPy or JAX.

    Attributes:
        name: ``touch`` and ``hand`` are the strongest contact's force in a control step [N]. ``wrist`` is force [N] and torque
            [N m], ``fingers`` the force at each pad [N], both of the last physics step.
        sensors: the model's sensors that it is made of.
        addresses: place of each sensor's three numbers among the sensor values.
    """

    name: str
    sensors: np.ndarray
    addresses: np.ndarray

    @property
    def strongest(self) -> bool:
        """True for a maximum over the physics steps of a control step."""
        return self.name in (NAME, HAND)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the reading."""
        return () if self.strongest else (len(self.sensors) * (3 if self.name == WRIST else 1),)

    @property
    def size(self) -> int:
        """Number of numbers in the reading."""
        return math.prod(self.shape)

    def __call__(self, values: Any) -> Any:
        """Returns the reading [*b, *shape] of one physics step from its sensor values [*b, nsensordata]."""
        each = values[..., self.addresses[:, None] + np.arange(3)]
        if self.name == WRIST:
            return each.reshape(*each.shape[:-2], -1)
        squares = (each**2).sum(-1)
        return (squares.max(-1) if self.strongest else squares) ** 0.5


def of(model: mujoco.MjModel) -> dict[str, Reading]:
    """Lists a model's readings by name. Empty if the scene has no sensor."""
    found = {}
    for name in (NAME, HAND, WRIST, FINGERS):
        ours = np.array([i for i in range(model.nsensor) if model.sensor(i).name.startswith(f"{name}:")], int)
        if ours.size:
            found[name] = Reading(name, ours, model.sensor_adr[ours])
    return found


def size(readings: Mapping[str, Reading]) -> int:
    """Number of numbers in all readings."""
    return sum(each.size for each in readings.values())


def split(readings: Mapping[str, Reading], numbers: Any) -> dict[str, Any]:
    """Cuts readings that lie one after another [*b, size] apart."""
    found, end = {}, 0
    for name, each in readings.items():
        found[name] = numbers[..., end : end + each.size].reshape(*numbers.shape[:-1], *each.shape)
        end += each.size
    return found
