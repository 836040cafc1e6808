"""The set-point of an arm: it follows joint positions that jump, without jumps of its own. And what a script of phases keeps."""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Bool, Float, Int

from mjx_nero.mdp.actions import rate_limit

_SMOOTH = 0.15  # [s] the set-point comes to rest in about this time
# [rad/s2] What it is accelerated by at most. Targets lead by the drives' lag, so that they jump with the speed; strong damping is
# integrated after contacts are solved for, and such a jump kicks what the hand holds (at 10 rad/s2 and a lag of half a second by
# 0.1 m/s a control step).
FASTEST = 6.0
_GENTLE = 1.5
_JUMP = 0.75  # [rad/s] of a target, by a second's acceleration


@struct.dataclass
class Script:
    """The state of a script of phases between two steps; each script adds its own."""

    phase: Int[Array, ""]
    count: Int[Array, ""]  # steps made in this phase
    q: Float[Array, " nj"]  # the arm's set-point [rad]
    qd: Float[Array, " nj"]  # and how fast it moves [rad/s]
    tries: Int[Array, ""]  # how often the script has begun anew


def gentle(lead: Sequence[float]) -> float:
    """Greatest acceleration of an arm that holds something, whose drives lag by ``lead`` [s]: [rad/s2 or m/s2]."""
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
    """Moves the set-point ``q``, which moves at ``qd``, for a step on its way to ``wanted``.

    Args:
        speed: greatest speeds [rad/s or m/s].
        dt: the step [s].
        fastest: greatest acceleration [rad/s2 or m/s2].
        straight: all joints are on their way for as long. Otherwise those with less to go are there sooner.

    Returns:
        the set-point and its speed.
    """
    way = wanted - q
    far = jnp.abs(way)
    quick = jnp.sign(way) * jnp.minimum(far / _SMOOTH, jnp.sqrt(fastest * far))
    together = way * jnp.minimum(1.0 / _SMOOTH, jnp.sqrt(fastest / (jnp.max(far) + 1e-9)))
    quick = jnp.where(straight, together, quick)
    quick /= jnp.maximum(1.0, jnp.max(jnp.abs(quick) / speed))
    qd = rate_limit(quick, qd, step=jnp.full(q.shape, fastest * dt))
    return q + qd * dt, qd
