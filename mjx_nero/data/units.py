"""Units of joints in a data set: the package's own (rad, m), or those of LeRobot's robots (degrees, grippers from 0 to 100)."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

KINDS = ("si", "lerobot")
LEROBOT = {"so_arm100": "so100_follower", "so_arm101": "so101_follower"}  # robot -> LeRobot's name of it


@dataclasses.dataclass(frozen=True)
class Units:
    """Units of joints' positions: a data set has ``factor * position + offset``.

    Attributes:
        kind: one of ``KINDS``.
        names: of the units, one a joint.
        factor, offset: [joints], from rad or m.
    """

    kind: str
    names: tuple[str, ...]
    factor: np.ndarray
    offset: np.ndarray

    def shown(self, positions: Any) -> Any:
        """Positions [..., joints] as the data set has them."""
        return positions * self.factor + self.offset

    def positions(self, shown: Any) -> Any:
        """The inverse of ``shown`` [rad or m]."""
        return (shown - self.offset) / self.factor

    def to_json(self) -> dict[str, Any]:
        """Plain JSON, which ``from_json`` reads."""
        return {
            "kind": self.kind,
            "names": list(self.names),
            "factor": [float(x) for x in self.factor],
            "offset": [float(x) for x in self.offset],
        }


def from_json(found: Mapping[str, Any]) -> Units:
    """Units from what ``Units.to_json`` made."""
    factor, offset = (np.array(found[name], np.float32) for name in ("factor", "offset"))
    return Units(found["kind"], tuple(found["names"]), factor, offset)


def si(slides: Sequence[bool]) -> Units:
    """Radians and metres.

    Args:
        slides: of each joint, whether it is one.
    """
    n = len(slides)
    return Units("si", tuple("m" if each else "rad" for each in slides), np.ones(n, np.float32), np.zeros(n, np.float32))


def lerobot(robot: str, slides: Sequence[bool], low: np.ndarray, high: np.ndarray, opens: np.ndarray) -> Units:
    """Those of LeRobot's robots: hinges in degrees, slides in millimetres, a gripper's joints from 0, closed, to 100, open.

    LeRobot counts the SO-ARM100's degrees from the middle of a joint's range, those of all others from the model's zero: see
    ``deploy.drivers.so_arm``.

    Args:
        low, high: the joints' ranges [joints], arm first [rad or m].
        opens: of each of the gripper's joints, which are the last ones, whether it opens to its upper end.
    """
    slide, arm = np.array(slides), len(slides) - len(opens)
    factor = np.where(slide, 1000.0, 180 / np.pi)
    zero = np.where(robot == "so_arm100", (low + high) / 2, 0.0)
    factor[arm:] = np.where(opens, 100.0, -100.0) / (high - low)[arm:]
    zero[arm:] = np.where(opens, low[arm:], high[arm:])
    names = [*("mm" if each else "deg" for each in slide[:arm]), *("%" for _ in opens)]
    return Units("lerobot", tuple(names), factor.astype(np.float32), (-zero * factor).astype(np.float32))
