"""Masses and inertia tensors as a URDF gives them, made physical."""

import numpy as np
import yourdfpy

from mjx_nero.urdf import primitives
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Mass, Matrix, Points, Vec

PLACEHOLDER = 1e-4  # [kg] lighter links are placeholders: exporters write 1e-6 or 1e-9 for parts that nobody weighed
LIGHTEST = 1e-3  # [kg] what a moving body is given at least: little enough to leave a robot's mass alone
LIGHTEST_RADIUS = 0.01  # [m] ... spread like a ball of this size at least
DENSITY = 1000.0  # [kg/m3]
MAX_MASS = 1e6  # [kg]
ABSURD = 100.0  # times the most inertia that a link of its shape and mass can have: exporters write 1 where nobody gave it
HEAVY = 0.1  # [kg m2] less than that does little harm
EXACT, ROUNDED = 1e-6, 0.02  # of the largest second moment: what floats lose, and what figures rounded to two digits can


def checked(inertial: yourdfpy.Inertial, name: str, notes: Notes) -> Mass:
    """Mass and tensor of a link, in the link's frame, with the tensor turned from the inertial frame to the link's.

    What is no number, negative or beyond reason becomes 0. Moments of inertia that only have the wrong sign get the right one.
    What no mass distribution can have (one of the second moments ``tr(I)/2 - I`` is negative) stays for ``filled`` if it is
    more than rounding.
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
    """``mass`` of a link; with the tensor of a box around its shape's ``points`` [n, 3], or of a ball, if its own is zero or such
    as no body has (without a shape, the nearest that one can have), or ``absurd``.

    Also notes what is suspicious and leaves it alone: a placeholder's mass, mass that would have to lie outside the shape.
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
    """Of a link of a moving body that weighs nothing, where others have masses: as ``weighed``, if that is more."""
    out = weighed(mass, points)
    if out.mass <= max(mass.mass, PLACEHOLDER):
        return mass
    notes.add(
        "guessed", "link", name, f"moves with {mass.mass:g} kg: now {out.mass:.3g} kg, its shape filled with water; weigh it"
    )
    return out


def weighed(mass: Mass, points: Points | None) -> Mass:
    """Of a link whose mass nobody says: that of the convex hull of its shape's ``points`` [n, 3], as heavy as water."""
    if points is None:
        return mass
    return Mass(DENSITY * primitives.hull(points), points.mean(0), np.zeros((3, 3)))


def body_mass(body: Body, notes: Notes) -> Mass:
    """Of a moving body: at least ``LIGHTEST``, and a tensor that MuJoCo takes."""
    mass, com, tensor = body.mass.mass, body.mass.com, body.mass.inertia
    if mass < LIGHTEST:
        notes.add("repaired", "link", body.name, f"moves with {mass:g} kg: given {LIGHTEST:g} kg; weigh it")
        mass = LIGHTEST
        if np.linalg.eigvalsh(tensor)[0] < _ball(mass, LIGHTEST_RADIUS)[0, 0]:
            tensor = _ball(mass, LIGHTEST_RADIUS)
    smallest = _ball(mass, 1e-3)
    if np.linalg.eigvalsh(tensor)[0] < smallest[0, 0]:  # a rod without thickness, or a point
        tensor = tensor + smallest
    return Mass(mass, com, tensor)


def _ball(mass: float, radius: float) -> Matrix:
    return 0.4 * mass * radius**2 * np.eye(3)


def absurd(mass: Mass, points: Points | None) -> bool:
    """Whether the inertia is a placeholder: ``HEAVY``, and ``ABSURD`` for its mass within its shape's ``points`` [n, 3]."""
    if points is None or mass.mass < PLACEHOLDER or _lack(mass.inertia) > ROUNDED:
        return False
    return float(np.linalg.eigvalsh(mass.inertia)[-1]) >= HEAVY and _excess(mass, points)[0] > ABSURD


def _compare(mass: Mass, points: Points, name: str, notes: Notes) -> None:
    """Notes what is odd about a mass within its shape's ``points``."""
    ratio, outside = _excess(mass, points)
    if outside:
        notes.add("note", "link", name, "the centre of mass lies outside the link's shape (kept)")
    elif ratio > 1:
        text = f"the inertia needs mass outside the link: {ratio:.1f} times the most that fits its shape (kept)"
        notes.add("note", "link", name, text)


def _excess(mass: Mass, points: Points) -> tuple[float, bool]:
    """How many times the most that fits the shape the inertia is, and whether the centre of mass lies outside.

    Mass within lower .. upper has a second moment of at most mass (upper - com) (com - lower) along each axis; of a centre
    outside, mass times the square of its distance from the far end.
    """
    lower, upper = points.min(0), points.max(0)
    slack = 0.02 * np.ptp(points, axis=0).max()
    moments = np.trace(mass.inertia) / 2 - np.diag(mass.inertia)
    outside = bool(((mass.com < lower - slack) | (mass.com > upper + slack)).any())
    above, under = upper - mass.com + slack, mass.com - lower + slack
    most = np.maximum(above, under) ** 2 if outside else above * under
    return float((moments / (mass.mass * most)).max()), outside


def _signed(tensor: Matrix, name: str, notes: Notes) -> Matrix:
    """With positive moments of inertia, if they make it one that a body can have: all signs turned, or those of negative ones."""
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
    """What the least second moment lacks to 0, as a share of the largest; infinite where none is positive, 0 of no tensor."""
    values = np.linalg.eigvalsh(tensor)
    moments = values.sum() / 2 - values
    if moments.max() <= 0:
        return np.inf if tensor.any() else 0.0
    return float(max(-moments.min() / moments.max(), 0.0))


def _nearest(tensor: Matrix) -> Matrix:
    """With second moments of at least 1% of the largest."""
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
