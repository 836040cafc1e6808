"""Puts a thing of a mesh in the place of a task's object: it lies as such a thing rests, and its own size counts."""

import dataclasses
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np

from mjx_nero.config import bounds
from mjx_nero.envs.task import EnvCfg
from mjx_nero.envs.tasks.lift_any import GRIP, LIFTED, NEAR, expert
from mjx_nero.mdp import randomization, success
from mjx_nero.mdp.terms import ObservationGroup, Term
from mjx_nero.sim import contacts
from mjx_nero.sim.objects import body, events, rests
from mjx_nero.sim.scene import ObjectCfg
from mjx_nero.types import UserError

_UPRIGHT = np.cos(np.radians(3.0))
T = TypeVar("T", bound=Term)


def applied(cfg: EnvCfg) -> EnvCfg:
    """Returns the task with ``cfg.object`` in the place of its one object.

    A lifted thing lies in any of its ways of resting; one that is pushed stands as its file does. Terms about heights and grasps
    then count from its surface, and the script that picks up uses its grasps.

    Raises:
        UserError: the task has not one object that is lifted or pushed, the thing cannot be used, or does not stand.
    """
    if not cfg.object.file:
        return cfg
    names, script = tuple(cfg.scene.objects), next(iter(cfg.controllers), "")
    pushed = any(bounds.unwrapped(term.func) is success.object_at_pose for term in (cfg.success.condition,))
    if len(names) != 1 or not (pushed or script in ("pick_up", "grasp_thing")):
        raise UserError(
            "object takes the place of the one object that a task lifts or pushes, and this task has none: in others, write "
            "scene.objects.NAME.shape=mesh and scene.objects.NAME.file=FILE"
        )
    (name,), thing = names, cfg.object
    item = ObjectCfg(shape="mesh", file=thing.file, scale=thing.scale, density=thing.density, **GRIP)
    if cfg.scene.objects[name] == item:
        return cfg
    (solid,) = item.solids
    standing = [quat for quat in solid.rest_quat if rests.up(quat)[2] > _UPRIGHT]
    if pushed and not standing:
        raise UserError(f"{thing.file} does not stand as its file has it, and what is pushed has to: turn it in the file")
    was = cfg.scene.objects[name]
    scene = dataclasses.replace(cfg.scene, objects={name: dataclasses.replace(item, pos=was.pos)})
    lies = (
        {}
        if pushed
        else {"reset_object_shape": Term(events.at_rest, params={"files": (thing.file,), "scale": thing.scale, "object": name})}
    )
    new: dict[str, Any] = {
        "scene": scene,
        "sim": contacts.crowded(cfg.robot, scene, cfg.sim),
        "object": thing,
        "events": {**cfg.events, **lies},
        "randomization": _kept(cfg.randomization, name, item),
        "controllers": {} if pushed else {**expert(cfg.robot, name, item)},
    }
    if pushed:
        low, high = (round(item.rest_height - cfg.robot.base_pos[2], 4),) * 2
        new["command"] = dataclasses.replace(cfg.command, params={**cfg.command.params, "z": (low, high)})
    cfg = dataclasses.replace(cfg, **new)
    groups: dict[str, Any] = {each: _own_size(getattr(cfg, each), name) for each in ("rewards", "terminations", "metrics")}
    groups["success"] = dataclasses.replace(
        cfg.success, condition=_sized(cfg.success.condition, name), distance=_sized(cfg.success.distance, name)
    )
    groups["observations"] = {key: _seen(group, name) for key, group in cfg.observations.items()}
    return dataclasses.replace(cfg, **groups)


def _seen(group: ObservationGroup, name: str) -> ObservationGroup:
    return dataclasses.replace(group, terms=_own_size(group.terms, name))


def _own_size(terms: Mapping[str, T], name: str) -> dict[str, T]:
    return {key: _sized(term, name) for key, term in terms.items()}


def _sized(term: T, name: str) -> T:
    """The term with heights and distances that count from the surface of a mesh; a thing looks the same once in a turn."""
    if term.params.get("object") != name:
        return term
    own = {"minimal_height": LIFTED, "grasp_radius": NEAR, "fold": 1}
    return dataclasses.replace(term, params={**term.params, **{key: value for key, value in own.items() if key in term.params}})


def _kept(terms: Mapping[str, Term], name: str, item: ObjectCfg) -> dict[str, Term]:
    """Randomization without another size, which a mesh cannot have, and with the friction of all its parts."""
    out = {}
    for key, term in terms.items():
        if bounds.unwrapped(term.func) is randomization.size and term.params["object"] == name:
            continue
        if name in term.params.get("geoms", ()) and bounds.unwrapped(term.func) is randomization.friction:
            others = tuple(geom for geom in term.params["geoms"] if geom != name)
            term = dataclasses.replace(term, params={**term.params, "geoms": (*others, *body.names(name, item.solids))})
        out[key] = term
    return out
