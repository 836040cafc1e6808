"""Masses and inertia tensors of a URDF, made physical."""

import numpy as np
import yourdfpy

from mjx_nero.urdf import primitives
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Mass, Matrix, Points, Vec

PLACEHOLDER = 1e-4  # [kg] lighter links are placeholders: exporters write 1e-6 or 1e-9 for unknown masses
LIGHTEST = 1e-3  # [kg] least mass of a moving body, negligible beside the robot's
LIGHTEST_RADIUS = 0.01  # [m] least radius of the ball that it is spread over
DENSITY = 1000.0  # [kg/m3]
MAX_MASS = 1e6  # [kg]
ABSURD = 100.0  # a placeholder exceeds by this factor what shape and mass allow: exporters write 1 if it is unknown
HEAVY = 0.1  # [kg m2] smaller placeholders do little harm
EXACT, ROUNDED = 1e-6, 0.02  # shares of the largest second moment lost to floats, and to rounding to two digits


def checked(inertial: yourdfpy.Inertial, name: str, notes: Notes) -> Mass:
    """Returns a link's mass and tensor in the link's frame; the tensor is turned from the inertial frame.

    Values that are not numbers, negative or unreasonable become 0. Moments with only a wrong sign are corrected. A tensor that no
    mass distribution has (a second moment ``tr(I)/2 - I`` is negative) is left to ``filled``, unless rounding explains it.
    """
    origin = np.eye(4) if inertial.origin is None else inertial.origin
    mass = 0.0 if inertial.mass is None else float(inertial.mass)
    if not 0 <= mass <= MAX_MASS:
        notes.add("warning", "link", name, f"the mass is {mass:g} kg: taken as 0")
        mass = 0.0
    tensor = np.zeros((3, 3)) if inertial.inertia is None else np.array(inertial.inertia, float)
    if not (np.isfinite(tensor).all() and np.abs(tensor).max() <= MAX_MASS):
        notes.add("warning", "link", name, "the inertia is not finite: taken as 0")
        tensor = np.zeros((3, 3))
    if mass == 0 and tensor.any():
        notes.add("warning", "link", name, "an inertia without mass: left out")
        tensor = np.zeros((3, 3))
    if tensor.any():
        tensor = _signed(tensor, name, notes)
        if EXACT < _lack(tensor) <= ROUNDED:
            read, tensor = tensor, _nearest(tensor)
            notes.add("repaired", "link", name, f"{_impossible(read)}, by rounding: now {_principal(tensor)}")
    return Mass(mass, np.zeros(3), tensor).moved(origin)


def filled(mass: Mass, points: Points | None, name: str, notes: Notes) -> Mass:
    """Returns the link's ``mass`` with a usable tensor.

    If the tensor is zero, impossible or ``absurd``, it becomes that of a box around the shape's ``points`` [n, 3], or of a ball.
    Without a shape, an impossible tensor becomes the nearest possible one. Suspicious values are noted but kept: a placeholder
    mass, or mass that would have to lie outside the shape.
    """
    if mass.mass == 0:
        return mass
    if mass.mass < PLACEHOLDER:
        notes.add("note", "link", name, f"{mass.mass:g} kg looks like a placeholder")
    lack = _lack(mass.inertia)
    wild = absurd(mass, points)
    if mass.inertia.any() and lack <= ROUNDED and not wild:
        if points is not None and mass.mass >= PLACEHOLDER:
            _compare(mass, points, name, notes)
        return mass
    if points is not None:
        moments = np.maximum(np.ptp(points, axis=0), 1e-3) ** 2 * mass.mass / 12
        tensor, what = np.diag(moments.sum() - moments), "that of a box around its shape"
    elif ROUNDED < lack < np.inf:
        tensor, what = _nearest(mass.inertia), "the nearest that one has"
    else:
        tensor = _ball(mass.mass, max(LIGHTEST_RADIUS, (mass.mass / DENSITY / 4.19) ** (1 / 3)))
        what = f"that of a ball of {DENSITY:g} kg/m3"
    if wild:
        notes.add(
            "repaired", "link", name, f"the inertia {_principal(mass.inertia)} is a placeholder: now {_principal(tensor)}, {what}"
        )
    elif lack > ROUNDED:
        text = f"{_impossible(mass.inertia)}: now {_principal(tensor)}, {what}; correct its <inertia>"
        notes.add("warning", "link", name, text)
    elif mass.mass >= PLACEHOLDER:
        notes.add("repaired", "link", name, f"the inertia was zero: now {what}")
    return Mass(mass.mass, mass.com, tensor)


def guessed(mass: Mass, points: Points | None, name: str, notes: Notes) -> Mass:
    """Gives a weightless link of a moving body, in a robot with masses, the mass of ``weighed``, if that is more."""
    out = weighed(mass, points)
    if out.mass <= max(mass.mass, PLACEHOLDER):
        return mass
    notes.add(
        "guessed", "link", name, f"moves with {mass.mass:g} kg: now {out.mass:.3g} kg, its shape filled with water; weigh it"
    )
    return out


def weighed(mass: Mass, points: Points | None) -> Mass:
    """Gives a link without known mass the mass of its convex hull filled with water; ``points``: its surface [n, 3]."""
    if points is None:
        return mass
    return Mass(DENSITY * primitives.hull(points), points.mean(0), np.zeros((3, 3)))


def body_mass(body: Body, notes: Notes) -> Mass:
    """Returns the mass of a moving body: at least ``LIGHTEST``, with a tensor that MuJoCo accepts."""
    mass, com, tensor = body.mass.mass, body.mass.com, body.mass.inertia
    if mass < LIGHTEST:
        notes.add("repaired", "link", body.name, f"moves with {mass:g} kg: given {LIGHTEST:g} kg; weigh it")
        mass = LIGHTEST
        if np.linalg.eigvalsh(tensor)[0] < _ball(mass, LIGHTEST_RADIUS)[0, 0]:
            tensor = _ball(mass, LIGHTEST_RADIUS)
    smallest = _ball(mass, 1e-3)
    if np.linalg.eigvalsh(tensor)[0] < smallest[0, 0]:  # a thin rod, or a point
        tensor = tensor + smallest
    return Mass(mass, com, tensor)


def _ball(mass: float, radius: float) -> Matrix:
    return 0.4 * mass * radius**2 * np.eye(3)


def absurd(mass: Mass, points: Points | None) -> bool:
    """True if the inertia is a placeholder.

    It then is at least ``HEAVY``, and more than ``ABSURD`` times what its mass can have within its shape's ``points`` [n, 3].
    """
    if points is None or mass.mass < PLACEHOLDER or _lack(mass.inertia) > ROUNDED:
        return False
    return float(np.linalg.eigvalsh(mass.inertia)[-1]) >= HEAVY and _excess(mass, points)[0] > ABSURD


def _compare(mass: Mass, points: Points, name: str, notes: Notes) -> None:
    """Notes oddities of a mass within its shape's ``points``."""
    ratio, outside = _excess(mass, points)
    if outside:
        notes.add("note", "link", name, "the centre of mass lies outside the link's shape (kept)")
    elif ratio > 1:
        text = f"the inertia needs mass outside the link: {ratio:.1f} times the most that fits its shape (kept)"
        notes.add("note", "link", name, text)


def _excess(mass: Mass, points: Points) -> tuple[float, bool]:
    """Returns the inertia as a multiple of the most that fits the shape, and whether the centre of mass lies outside.

    Mass within lower .. upper has a second moment of at most mass (upper - com) (com - lower) along each axis. If the centre lies
    outside, the bound is mass times the squared distance from the far end.
    """
    lower, upper = points.min(0), points.max(0)
    slack = 0.02 * np.ptp(points, axis=0).max()
    moments = np.trace(mass.inertia) / 2 - np.diag(mass.inertia)
    outside = bool(((mass.com < lower - slack) | (mass.com > upper + slack)).any())
    above, under = upper - mass.com + slack, mass.com - lower + slack
    most = np.maximum(above, under) ** 2 if outside else above * under
    return float((moments / (mass.mass * most)).max()), outside


def _signed(tensor: Matrix, name: str, notes: Notes) -> Matrix:
    """Makes the moments of inertia positive, if that makes them possible, by turning all signs or only the negative ones."""
    diagonal = np.diag(tensor)
    if not (diagonal < 0).any():
        return tensor
    turned = -tensor if (diagonal <= 0).all() else tensor - np.diag(diagonal) + np.diag(np.abs(diagonal))
    if _lack(turned) > ROUNDED:
        return tensor
    text = f"the moments of inertia {_list(diagonal)} have a wrong sign: now {_list(np.diag(turned))}; correct its <inertia>"
    notes.add("warning", "link", name, text)
    return turned


def _lack(tensor: Matrix) -> float:
    """How far the least second moment is below 0, as a share of the largest; infinite if none is positive, 0 for zeros."""
    values = np.linalg.eigvalsh(tensor)
    moments = values.sum() / 2 - values
    if moments.max() <= 0:
        return np.inf if tensor.any() else 0.0
    return float(max(-moments.min() / moments.max(), 0.0))


def _nearest(tensor: Matrix) -> Matrix:
    """Raises all second moments to at least 1% of the largest."""
    values, axes = np.linalg.eigh(tensor)
    moments = values.sum() / 2 - values
    moments = np.maximum(moments, 0.01 * moments.max())
    return axes @ np.diag(moments.sum() - moments) @ axes.T


def _impossible(tensor: Matrix) -> str:
    return f"no body has the principal inertias {_principal(tensor)}"


def _principal(tensor: Matrix) -> str:
    return _list(np.linalg.eigvalsh(tensor))


def _list(values: Vec) -> str:
    return "(" + ", ".join(f"{v:.3g}" for v in values) + ") kg m2"
