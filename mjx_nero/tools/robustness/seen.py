"""Sweeps of the look of the world: one property at a time, and the preset's whole look at once."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from mjx_nero.envs.task import EnvCfg
from mjx_nero.mdp import images, looks
from mjx_nero.mdp.images import Lens
from mjx_nero.mdp.terms import Term
from mjx_nero.tasks import seeing

LATE = "pictures late [control steps]"
LATEST = 5  # control steps
ALL = "whole look [width]"
_AS_THEY_ARE = ("x", "y", "z")  # parameters that are positions


@dataclasses.dataclass(frozen=True)
class Look:
    """The look of the world.

    Attributes:
        terms: terms of the look.
        late: delay of all pictures [control steps].
    """

    terms: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    late: int = 0


def lenses(cfg: EnvCfg) -> dict[str, Term]:
    """Returns lenses for the task's cameras, by name. Each only delays its pictures, by an amount set at the start."""
    plain = {name: term.made.camera for name, term in cfg.sensors.items() if isinstance(term.made, Lens)}
    cameras = plain or {f"lens_{camera}": camera for camera in cfg.scene.cameras}
    return {name: Term(images.Lens, params={"camera": camera, "delay": (0, LATEST)}) for name, camera in cameras.items()}


def prepared(cfg: EnvCfg) -> EnvCfg:
    """Returns the task with one look for all episodes, and with everything that the sweeps change."""
    whole = seeing.randomized(cfg)
    scene = dataclasses.replace(whole.scene, patterns=seeing.PATTERNS)
    sensors = {name: term for name, term in cfg.sensors.items() if not isinstance(term.made, Lens)}
    return dataclasses.replace(cfg, scene=scene, look=whole.look, sensors={**sensors, **lenses(cfg)})


def sweeps(cfg: EnvCfg) -> dict[str, list[tuple[float, Look]]]:
    """Returns (value, look) by parameter for a task with cameras; empty for one without."""
    if not cfg.scene.cameras:
        return {}
    look, objects = seeing.randomized(cfg).look, tuple(cfg.scene.objects)
    fixed = tuple(name for name, camera in cfg.scene.cameras.items() if not camera.link)
    surfaces = ("table_top", "backdrop")
    props = {name: term for name, term in look.items() if name.startswith("props_")}

    def light(factor: float) -> Term:
        return Term(looks.lights, params={"turn": 0.0, "brightness": (factor, factor), "tint": 0.0})

    def there(share: float) -> dict[str, Term]:
        return {n: _with(t, {"there": share}) if "there" in t.params else t for n, t in props.items() if "pattern" not in n}

    def colored(geoms: tuple[str, ...], change: float) -> Term:
        return Term(looks.colors, params={"geoms": geoms, "change": change})

    shown = {
        "light [factor]": {x: {"lights": light(x)} for x in (0.2, 0.5, 2.0, 4.0)},
        "camera moved by [m]": {x: {"pose": _pose(fixed, x, 0.0)} for x in (0.02, 0.05, 0.1)},
        "camera turned by [rad]": {x: {"pose": _pose(fixed, 0.0, x)} for x in (0.04, 0.1, 0.2)},
        "colour of table and wall": {x: {"colors": colored(surfaces, x)} for x in (0.5, 1.0)},
        "colour of the object": {x: {"colors": colored(objects, x)} for x in (0.25, 0.5, 1.0)},
        "patterns [share]": {x: {"patterns": _patterned((*surfaces, *objects), x)} for x in (0.5, 1.0)},
        "distractors [share of six]": {x: there(x) for x in (0.5, 1.0)},
        ALL: {width: {name: _wide(term, width) for name, term in look.items()} for width in (0.5, 1.0, 1.5)},
    }
    out = {name: [(x, Look(terms)) for x, terms in points.items()] for name, points in shown.items()}
    out[LATE] = [(float(x), Look(late=x)) for x in (1, 2, 3, LATEST)]
    return {
        name: sorted([(float("factor" in name), Look()), *points], key=lambda point: point[0]) for name, points in out.items()
    }


def _pose(cameras: tuple[str, ...], offset: float, turn: float) -> Term:
    return Term(looks.camera_pose, params={"cameras": cameras, "offset": offset, "turn": turn})


def _patterned(geoms: tuple[str, ...], share: float) -> Term:
    return Term(looks.patterns, params={"geoms": geoms, "share": share})


def _with(term: Term, params: Mapping[str, Any]) -> Term:
    return dataclasses.replace(term, params={**term.params, **params})


def _wide(term: Term, width: float) -> Term:
    """Returns a term with its ranges ``width`` times as wide about the model's values; no share exceeds 1."""
    return _with(term, {name: _range(name, value, width) for name, value in term.params.items()})


def _range(name: str, value: Any, width: float) -> Any:
    if isinstance(value, float):
        return value * width if name in ("turn", "offset") else min(1.0, value * width)
    if name in _AS_THEY_ARE or not isinstance(value, tuple) or not value or isinstance(value[0], str):
        return value
    return tuple(max(0.05, 1 + (end - 1) * width) for end in value)
