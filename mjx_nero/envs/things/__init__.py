"""Replaces a task's object with a mesh, which lies in its own resting poses. Terms then use the mesh's own size."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero import config
from mjx_nero.config import bounds
from mjx_nero.envs.task import EnvCfg
from mjx_nero.envs.things import placing
from mjx_nero.envs.things.gripping import GRIP, LIFTED, NEAR, expert
from mjx_nero.mdp import randomization, success
from mjx_nero.mdp.terms import ONCE, Term
from mjx_nero.sim import contacts
from mjx_nero.sim.meshes import body, events
from mjx_nero.sim.scene import ObjectCfg
from mjx_nero.sim.solids import rests
from mjx_nero.types import UserError

LONGER = 2.0  # [s] extra time of the script compared with a cube: it searches for a grasp, and lifts loose grasps slowly
STEP = 0.005  # [s] physics step: at 10 ms, things held at their rim slip out
_UPRIGHT = np.cos(np.radians(3.0))
SCRIPTS = ("pick_up", "grasp_thing")  # of tasks that lift one object
LIFTS, PUSHES, PLACES = "lifts", "pushes", "places"


def overridden(cfg: EnvCfg, fields: Mapping[str, Any]) -> EnvCfg:
    """Returns the task with fields replaced by dotted name. Those of ``object`` come first; the others apply to the result.

    Raises:
        UserError: a name or value is wrong, or the object does not suit the task.
    """
    thing = {name: value for name, value in fields.items() if name.startswith("object.")}
    others = {name: value for name, value in fields.items() if name not in thing}
    return config.override(applied(config.override(cfg, thing)), others)


def applied(cfg: EnvCfg) -> EnvCfg:
    """Returns the task with ``cfg.object`` in place of its one object.

    A thing to lift starts in any of its resting poses. A thing to push stands in the orientation of its file. So does a thing to
    place, if it can; otherwise it lies in its most frequent resting pose. Terms measure heights and grasps from the thing's
    surface, and the script uses its grasps.

    Raises:
        UserError: the task does not have exactly one object to lift, push or place, or the thing is unusable or cannot stand.
    """
    if not cfg.object.file:
        return cfg
    name, what = _part(cfg)
    thing, was = cfg.object, cfg.scene.objects[name]
    item = ObjectCfg(shape="mesh", file=thing.file, scale=thing.scale, density=thing.density, **GRIP)
    item = dataclasses.replace(item, pos=was.pos, quat=(1.0, 0.0, 0.0, 0.0) if what == LIFTS else _stands(item, what))
    if (was.shape, was.file, was.scale, was.density) == (item.shape, item.file, item.scale, item.density):
        return cfg  # it is there already
    scene = dataclasses.replace(cfg.scene, objects={name: item})
    changed: dict[str, Any] = {
        "scene": scene,
        "sim": contacts.crowded(cfg.robot, scene, cfg.sim),
        "randomization": _kept(cfg.randomization, name, item),
    }
    cfg = dataclasses.replace(cfg, **changed).changed(lambda term: _sized(term, name))
    return {LIFTS: _lifted, PUSHES: _pushed, PLACES: placing.applied}[what](cfg, name, item)


def _part(cfg: EnvCfg) -> tuple[str, str]:
    """The name of the task's one object, and what the task does with it."""
    names, script, judged = tuple(cfg.scene.objects), next(iter(cfg.controllers), ""), cfg.success.condition
    what = PUSHES if bounds.unwrapped(judged.func) is success.object_at_pose else LIFTS if script in SCRIPTS else ""
    what = PLACES if placing.places(judged) else what
    if len(names) != 1 or not what:
        several = "several objects of their own shapes" if len(names) > 1 else "none"
        raise UserError(
            f"object replaces the one object that a task lifts, pushes or places, but this task has {several}: set "
            "scene.objects.NAME.shape=mesh and scene.objects.NAME.file=FILE instead"
        )
    return names[0], what


def _stands(item: ObjectCfg, what: str) -> tuple[float, float, float, float]:
    """Returns the orientation of a thing: its file's, if it stands so, or else its most frequent resting pose without yaw.

    Raises:
        UserError: the thing is to be pushed, but cannot stand.
    """
    (solid,) = item.solids
    if any(rests.up(quat)[2] > _UPRIGHT for quat in solid.rest_quat):
        return item.quat
    if what == PUSHES:
        raise UserError(f"{item.file} cannot stand in its orientation, but an object to push must: turn it in the file")
    return placing.tilted(*placing.tilt(rests.up(solid.rest_quat[int(np.argmax(solid.rest_share))])))


def _lifted(cfg: EnvCfg, name: str, item: ObjectCfg) -> EnvCfg:
    lies = Term(events.at_rest, params={"files": (item.file,), "scale": item.scale, "object": name})
    return dataclasses.replace(
        cfg,
        sim=cfg.sim.finer(STEP),
        episode_length_s=cfg.episode_length_s + LONGER,
        command=dataclasses.replace(cfg.command, resample_s=ONCE),
        events={**cfg.events, "reset_object_shape": lies},
        controllers=expert(cfg.robot, name, item),
    )


def _pushed(cfg: EnvCfg, name: str, item: ObjectCfg) -> EnvCfg:
    height = round(item.rest_height - cfg.robot.base_pos[2], 4)
    command = dataclasses.replace(cfg.command, params={**cfg.command.params, "z": (height, height)})
    return dataclasses.replace(cfg, command=command, controllers={})


def laid(cfg: EnvCfg) -> EnvCfg:
    """Returns the task with ``at_rest`` events that know all shapes of their object, in the scene's order.

    Raises:
        UserError: an event names a file that its object does not have.
    """
    found = {}
    for key, event in cfg.events.items():
        found[key] = event
        item = cfg.scene.objects.get(event.params.get("object", ""))
        if bounds.unwrapped(event.func) is not events.at_rest or item is None:
            continue
        bank, files = (item.file, *item.bank), event.params["files"]
        if unknown := [file for file in files if file not in bank]:
            name = event.params["object"]
            has = f"file and bank of scene.objects.{name} are {', '.join(bank)}"
            raise UserError(f"events.{key}.params.files names {', '.join(unknown)}, but {has}")
        if files != bank:
            found[key] = dataclasses.replace(event, params={**event.params, "bank": bank})
    return cfg if found == cfg.events else dataclasses.replace(cfg, events=found)


def _sized(term: Term, name: str) -> Term:
    """Returns the term, measured from the surface of a mesh. A thing without symmetry looks the same only after a full turn."""
    if term.params.get("object") != name:
        return term
    own = {"minimal_height": LIFTED, "grasp_radius": NEAR, "fold": 1}
    return dataclasses.replace(term, params={**term.params, **{key: value for key, value in own.items() if key in term.params}})


def _kept(terms: Mapping[str, Term], name: str, item: ObjectCfg) -> dict[str, Term]:
    """Randomization without the size, which a mesh cannot change, and with the friction of all parts of the mesh."""
    out = {}
    for key, term in terms.items():
        if bounds.unwrapped(term.func) is randomization.size and term.params["object"] == name:
            continue
        if name in term.params.get("geoms", ()) and bounds.unwrapped(term.func) is randomization.friction:
            others = tuple(geom for geom in term.params["geoms"] if geom != name)
            term = dataclasses.replace(term, params={**term.params, "geoms": (*others, *body.names(name, item.solids))})
        out[key] = term
    return out
