"""The sweeps: one parameter at a time, and all at once as in the preset ``sim2real``."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from mjx_nero.envs.task import EnvCfg
from mjx_nero.mdp.terms import Term
from mjx_nero.tasks import sim2real
from mjx_nero.tools.robustness import seen

ALL = "all at once"


@dataclasses.dataclass(frozen=True)
class Point:
    """One setting of the world.

    Attributes:
        terms: randomization terms, with ranges of zero width, or scaled ranges of the preset for all at once.
        delay: minimum and maximum delay of the actions [control steps].
        offset: maximum error of observed object positions along each axis [m].
        look: look of the world, for a task with cameras.
    """

    terms: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    delay: tuple[int, int] = (0, 0)
    offset: float = 0.0
    look: seen.Look = seen.Look()


# Parameter -> (the preset's term, its parameter, values). {object} is the scene's first object.
_FIELDS = {
    "object mass [factor]": ("{object}_mass", "scale", (0.5, 1.0, 2.0, 4.0, 8.0)),
    "object size [factor]": ("{object}_size", "scale", (0.8, 0.9, 1.0, 1.15, 1.3)),
    "pads' friction": ("pad_friction", "slide", (0.2, 0.4, 0.6, 1.0, 1.5)),
    "link masses [factor]": ("link_mass", "scale", (0.5, 0.8, 1.0, 1.2, 1.5)),
    "stiffness [factor]": ("drives", "stiffness", (0.5, 0.75, 1.0, 1.25, 2.0)),
    "damping [factor]": ("drives", "damping", (0.5, 0.75, 1.0, 1.25, 2.0)),
    "effort [factor]": ("drives", "effort", (0.2, 0.4, 0.6, 0.8, 0.999)),
    "armature [factor]": ("joints", "armature", (0.5, 0.75, 1.0, 1.5, 3.0)),
    "joint friction [share of effort]": ("joints", "friction", (0.0, 0.01, 0.02, 0.04, 0.08)),
    "gravity compensation [factor]": ("gravity_compensation", "scale", (0.5, 0.8, 1.0, 1.2, 1.5)),
}
_DELAYS = (0, 1, 2, 3, 5)
_OFFSETS = (0.0, 0.005, 0.01, 0.02)
LONGEST = max(_DELAYS)


def sweeps(cfg: EnvCfg) -> dict[str, list[tuple[float, Point]]]:
    """Returns (value, setting) by parameter, for the parameters that a task has, and for all at once over the ranges' width."""
    terms, things = sim2real.randomized(cfg).randomization, list(cfg.scene.objects)
    out: dict[str, list[tuple[float, Point]]] = {}
    for name, (term, parameter, values) in _FIELDS.items():
        if (term := term.format(object=(things or [""])[0])) in terms:
            out[name] = [(v, Point({term: _only(terms[term], {parameter: (v, v)})})) for v in values]
    out |= {name: [(value, Point(look=look)) for value, look in points] for name, points in seen.sweeps(cfg).items()}
    out["action delay [control steps]"] = [(steps, Point(delay=(steps, steps))) for steps in _DELAYS]
    if things and not cfg.scene.cameras:  # a task with cameras is not told positions
        out["objects seen off by [m]"] = [(offset, Point(offset=offset)) for offset in _OFFSETS]
    out[ALL] = [(width, _wide(terms, width)) for width in (0.0, 0.5, 1.0, 1.5)]
    return out


def _only(term: Term, params: dict[str, Any]) -> Term:
    """Returns a term that draws these parameters and leaves the others unchanged."""
    neutral = {name: _narrow(name, value, 0.0) for name, value in term.params.items()}
    if "spin" in neutral:  # of contacts, absolute
        neutral |= {"slide": neutral["slide"], "spin": None, "roll": None}
    return dataclasses.replace(term, params={**neutral, **params})


def _wide(terms: Mapping[str, Term], width: float) -> Point:
    """Returns all of the preset's ranges, ``width`` times as wide about the model's values."""
    narrowed = {
        name: dataclasses.replace(term, params={key: _narrow(key, value, width) for key, value in term.params.items()})
        for name, term in terms.items()
    }
    if not width:
        narrowed = {}
    return Point(narrowed, (0, round(3 * width)), 0.005 * width)


def _narrow(name: str, value: Any, width: float) -> Any:
    """Scales a parameter's range about 1, or about 0 if it begins there."""
    if name in ("spin", "roll") or not isinstance(value, tuple | float) or isinstance(value, tuple) and isinstance(value[0], str):
        return value
    if isinstance(value, float):
        return value * width
    if value[0] == 0:
        return (0.0, value[1] * width)
    low, high = (1 + (end - 1) * width for end in value)
    return (max(low, 0.01), max(high, 0.01))
