"""The set-point of an arm, which follows jumping joint positions smoothly; and the state of a script of phases."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from mjx_nero.mdp.actions import rate_limit

_SMOOTH = 0.15  # [s] the set-point comes to rest in about this time
# [rad/s2] Greatest acceleration of the set-point. Targets lead by the drives' lag, so they jump when the speed changes. Strong
# damping is integrated after the contacts are solved, and such a jump kicks the object in the hand: at 10 rad/s2 and a lag of
# half a second by 0.1 m/s per control step.
FASTEST = 6.0
_GENTLE = 1.5
_JUMP = 0.75  # [rad/s] acceleration times lag of an arm that holds something


@struct.dataclass
class Script:
    """The state of a script of phases between two steps; each script adds its own."""

    phase: Int[Array, ""]
    count: Int[Array, ""]  # steps made in this phase
    q: Float[Array, " nj"]  # the arm's set-point [rad]
    qd: Float[Array, " nj"]  # velocity of the set-point [rad/s]
    tries: Int[Array, ""]  # how often the script has started again


def gentle(lead: Sequence[float]) -> float:
    """Greatest acceleration [rad/s2 or m/s2] of an arm that holds something, with drives that lag by ``lead`` [s]."""
    return float(np.clip(_JUMP / max([*lead, 1e-6]), _GENTLE, FASTEST))


def follow(
    q: Float[Array, " nj"],
    qd: Float[Array, " nj"],
    wanted: Float[Array, " nj"],
    speed: Float[Array, " nj"],
    dt: float,
    fastest: float | Float[Array, ""] = _GENTLE,
    straight: bool | Bool[Array, ""] = False,
) -> tuple[Float[Array, " nj"], Float[Array, " nj"]]:
    """Moves the set-point ``q``, whose velocity is ``qd``, by one step towards ``wanted``.

    Args:
        speed: greatest speeds [rad/s or m/s].
        dt: the step [s].
        fastest: greatest acceleration [rad/s2 or m/s2].
        straight: all joints arrive at the same time. Otherwise those with less to go arrive sooner.

    Returns:
        The set-point and its velocity.
    """
    way = wanted - q
    far = jnp.abs(way)
    quick = jnp.sign(way) * jnp.minimum(far / _SMOOTH, jnp.sqrt(fastest * far))
    together = way * jnp.minimum(1.0 / _SMOOTH, jnp.sqrt(fastest / (jnp.max(far) + 1e-9)))
    quick = jnp.where(straight, together, quick)
    quick /= jnp.maximum(1.0, jnp.max(jnp.abs(quick) / speed))
    qd = rate_limit(quick, qd, step=jnp.full(q.shape, fastest * dt))
    return q + qd * dt, qd
