"""Grasps of things by a hand, as padded tables. They take seconds to find, so they are kept in the user's cache."""

import dataclasses
import functools
import hashlib

import numpy as np

from mjx_nero.sim.solids import grasps, kept, rests, store
from mjx_nero.sim.solids.grasps import Hand
from mjx_nero.sim.solids.solid import Solid
from mjx_nero.types import UserError

NONE = 1e3  # cost of an entry that only pads the table
_VERSION = 1
Table = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]


@functools.lru_cache(maxsize=16)
def table(names: tuple[str, ...], scale: float, hand: Hand) -> Table:
    """Directions of up [things, rests, 3]; for each rest its ``Grasps``: middle, across [.., grasps, 3], gap, cost [.., grasps].

    Raises:
        UserError: a thing cannot be grasped in any of its resting poses.
    """
    found = []
    for name in names:
        solid = store.find(name).scaled(scale)
        found.append((solid, _kept(solid, hand)))
        if not any(len(each.cost) for each in found[-1][1]):
            raise UserError(f"{name} cannot be grasped from above by a hand that opens to {hand.opening:g} m: give another scale")
    most = max(len(each) for _, each in found)
    lead = len(found), most, grasps.MOST
    ups, middle, across = np.zeros((*lead[:2], 3)), np.zeros((*lead, 3)), np.zeros((*lead, 3))
    gap, cost = np.full(lead, hand.opening), np.full(lead, NONE)
    across[..., 1] = 1.0
    for i, (solid, each) in enumerate(found):
        for j, (quat, one) in enumerate(zip(solid.rest_quat, each, strict=True)):
            n = len(one.cost)
            ups[i, j] = rests.up(quat)
            middle[i, j, :n], across[i, j, :n], gap[i, j, :n], cost[i, j, :n] = one.middle, one.across, one.gap, one.cost
    return ups, middle, across, gap, cost


def _kept(solid: Solid, hand: Hand) -> list[grasps.Grasps]:
    """The grasps of each resting pose: cached, or new ones."""
    said = hashlib.sha256(repr((_VERSION, grasps.MOST, dataclasses.astuple(hand))).encode())
    for array in (solid.points, solid.sizes, solid.rest_quat):
        said.update(np.ascontiguousarray(array).tobytes())

    def make() -> dict[str, np.ndarray]:
        found = [grasps.find(solid, quat, hand) for quat in solid.rest_quat]
        return {f"{i}.{name}": value for i, each in enumerate(found) for name, value in dataclasses.asdict(each).items()}

    read = kept.arrays(f"{said.hexdigest()[:32]}.grasps", make)
    names = [field.name for field in dataclasses.fields(grasps.Grasps)]
    return [grasps.Grasps(*(read[f"{i}.{name}"] for name in names)) for i in range(len(solid.rest_quat))]
