"""Units of joints in a data set: the package's own (rad, m), or LeRobot's (degrees, grippers from 0 to 100)."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

KINDS = ("si", "lerobot")
LEROBOT = {"so_arm100": "so100_follower", "so_arm101": "so101_follower"}  # robot -> LeRobot's name for it


@dataclasses.dataclass(frozen=True)
class Units:
    """Units of joint positions: a data set has ``factor * position + offset``.

    Attributes:
        kind: one of ``KINDS``.
        names: name of each joint's unit.
        factor, offset: conversion from rad or m [joints].
    """

    kind: str
    names: tuple[str, ...]
    factor: np.ndarray
    offset: np.ndarray

    def shown(self, positions: Any) -> Any:
        """Converts positions [..., joints] [rad or m] to the data set's units."""
        return positions * self.factor + self.offset

    def positions(self, shown: Any) -> Any:
        """Inverts ``shown``; returns positions [rad or m]."""
        return (shown - self.offset) / self.factor

    def to_json(self) -> dict[str, Any]:
        """Converts the units to plain JSON, which ``from_json`` reads."""
        return {
            "kind": self.kind,
            "names": list(self.names),
            "factor": [float(x) for x in self.factor],
            "offset": [float(x) for x in self.offset],
        }


def from_json(found: Mapping[str, Any]) -> Units:
    """Reads units written by ``Units.to_json``."""
    factor, offset = (np.array(found[name], np.float32) for name in ("factor", "offset"))
    return Units(found["kind"], tuple(found["names"]), factor, offset)


def si(slides: Sequence[bool]) -> Units:
    """Makes units of radians and metres.

    Args:
        slides: whether each joint is a slide.
    """
    n = len(slides)
    return Units("si", tuple("m" if each else "rad" for each in slides), np.ones(n, np.float32), np.zeros(n, np.float32))


def lerobot(robot: str, slides: Sequence[bool], low: np.ndarray, high: np.ndarray, opens: np.ndarray) -> Units:
    """Makes LeRobot's units: hinges in degrees, slides in millimetres, a gripper's joints from 0 (closed) to 100 (open).

    LeRobot counts the SO-ARM100's degrees from the middle of each joint's range, and those of all other robots from the model's
    zero: see ``deploy.drivers.so_arm``.

    Args:
        slides: whether each joint is a slide.
        low, high: the joints' ranges [joints], arm first [rad or m].
        opens: for each joint of the gripper (the last joints): whether it opens towards its upper limit.
    """
    slide, arm = np.array(slides), len(slides) - len(opens)
    factor = np.where(slide, 1000.0, 180 / np.pi)
    zero = np.where(robot == "so_arm100", (low + high) / 2, 0.0)
    factor[arm:] = np.where(opens, 100.0, -100.0) / (high - low)[arm:]
    zero[arm:] = np.where(opens, low[arm:], high[arm:])
    names = [*("mm" if each else "deg" for each in slide[:arm]), *("%" for _ in opens)]
    return Units("lerobot", tuple(names), factor.astype(np.float32), (-zero * factor).astype(np.float32))
