"""The damping of position drives: one rule for imported robots and for tune-gains."""

import math


def critical_damping(stiffness: float, inertia: float, dt: float, friction: float = 0.0) -> float:
    """Damping at which a drive neither overshoots nor creeps [N m s/rad or N s/m].

    The integrator (implicitfast) takes a drive's spring force from the beginning of a physics step and its damping from the end.
    That recursion has a double real pole at d = 2 sqrt(k I) + k dt.

    Args:
        stiffness: [N m/rad or N/m].
        inertia: inertia to damp critically [kg m2 or kg].
        dt: physics step [s].
        friction: the joint's own damping.
    """
    return max(2 * math.sqrt(stiffness * inertia) + stiffness * dt - friction, 0.0)
