"""Joints that are coupled by equality constraints of the model."""

import dataclasses
from collections.abc import Iterable, Iterator

import mujoco
import numpy as np
from jaxtyping import Array, Float


@dataclasses.dataclass(frozen=True)
class Coupling:
    """One joint's position as a polynomial of another's. MuJoCo measures both from their ``qpos0``.

    Attributes:
        follower, leader: addresses in qpos. A follower without a leader is its own leader, with a constant polynomial.
        coefficients: polynomial coefficients, lowest first. The constant includes the follower's ``qpos0``.
        reference: the leader's ``qpos0`` [rad or m].
    """

    follower: int
    leader: int
    coefficients: tuple[float, ...]
    reference: float = 0.0

    def position(self, qpos: Float[Array, " nq"] | Float[np.ndarray, " nq"]) -> Float[Array, ""] | float:
        """Position of the follower that satisfies the coupling [rad or m]."""
        offset, *powers = self.coefficients
        leader = qpos[self.leader] - self.reference
        return offset + sum((c * leader ** (k + 1) for k, c in enumerate(powers)), 0.0)


def couplings(model: mujoco.MjModel) -> list[Coupling]:
    """Lists the active couplings, leaders before their followers, so that a linkage can start closed."""
    found = list(_couplings(model))
    followers = {c.follower for c in found}
    ordered: list[Coupling] = []
    while found:
        placed = {c.follower for c in ordered}
        ready = [c for c in found if c.leader not in followers - placed or c.leader == c.follower]
        ordered += ready or found  # a ring has no order
        found = [c for c in found if c not in ordered]
    return ordered


def close(coupled: Iterable[Coupling], qpos: Float[np.ndarray, " nq"]) -> None:
    """Moves followers to match their leaders, in place. ``coupled``: leaders before their followers."""
    for coupling in coupled:
        qpos[coupling.follower] = coupling.position(qpos)


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
