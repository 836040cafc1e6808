"""Joints that equalities of the model couple."""

import dataclasses
from collections.abc import Iterator

import mujoco
import numpy as np
from jaxtyping import Array, Float


@dataclasses.dataclass(frozen=True)
class Coupling:
    """An equality of one joint's position with a polynomial of another's; MuJoCo counts both from their ``qpos0``.

    Attributes:
        follower, leader: addresses in qpos; a follower without a leader is its own, and the polynomial a constant.
        coefficients: from the constant one on, which holds the follower's ``qpos0``, too.
        reference: the leader's ``qpos0`` [rad or m].
    """

    follower: int
    leader: int
    coefficients: tuple[float, ...]
    reference: float = 0.0

    def position(self, qpos: Float[Array, " nq"] | Float[np.ndarray, " nq"]) -> Float[Array, ""] | float:
        """Where the follower has to be [rad or m]."""
        offset, *powers = self.coefficients
        leader = qpos[self.leader] - self.reference
        return offset + sum((c * leader ** (k + 1) for k, c in enumerate(powers)), 0.0)


def couplings(model: mujoco.MjModel) -> list[Coupling]:
    """The joints that active equalities couple, leaders before their followers: where a linkage starts closed."""
    found = list(_couplings(model))
    followers = {c.follower for c in found}
    ordered: list[Coupling] = []
    while found:
        placed = {c.follower for c in ordered}
        ready = [c for c in found if c.leader not in followers - placed or c.leader == c.follower]
        ordered += ready or found  # of a ring, as they come
        found = [c for c in found if c not in ordered]
    return ordered


def _couplings(model: mujoco.MjModel) -> Iterator[Coupling]:
    for e in np.flatnonzero((model.eq_type == mujoco.mjtEq.mjEQ_JOINT) & model.eq_active0.astype(bool)):
        follower = int(model.jnt_qposadr[model.eq_obj1id[e]])
        constant, *powers = (float(c) for c in model.eq_data[e, :5])
        constant += float(model.qpos0[follower])
        if model.eq_obj2id[e] < 0:
            yield Coupling(follower, follower, (constant,))
            continue
        leader = int(model.jnt_qposadr[model.eq_obj2id[e]])
        while powers and not powers[-1]:
            powers.pop()
        yield Coupling(follower, leader, (constant, *powers), float(model.qpos0[leader]))
