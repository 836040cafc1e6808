"""Pairs of geoms that can touch, and the most contacts and constraint rows that a scene can need."""

import dataclasses
import itertools

import mujoco
import numpy as np

from mjx_nero.sim import scene
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg

# The most contacts that MuJoCo and MJX-Warp find between two shapes. Other pairs use their general convex routine: 4.
_MOST = {
    "plane": {"sphere": 1, "ellipsoid": 1, "capsule": 2, "cylinder": 4, "box": 4},
    "sphere": {"sphere": 1, "capsule": 1, "ellipsoid": 1, "cylinder": 1, "box": 1, "mesh": 1},
    "capsule": {"capsule": 2, "box": 2},
    "box": {"box": 8},
    "hfield": dict.fromkeys(("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh"), 50),
}
_CONVEX = 4
_PARTS = 3  # most parts of a mesh that one geom touches at once
_EQUALITY_ROWS = {"CONNECT": 3, "WELD": 6, "JOINT": 1, "TENDON": 1}


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two geoms that can meet, with the most contacts that their shapes make and the constraint rows of all of them."""

    first: str
    second: str
    shapes: str
    contacts: int
    condim: int
    rows: int


def contact_pairs(model: mujoco.MjModel) -> tuple[Pair, ...]:
    """Lists the pairs of geoms that MuJoCo lets collide.

    These are the explicit pairs, and those whose contact bits match, except within a body, between a body and its parent, and
    between excluded bodies.
    """
    explicit = {(int(a), int(b)): int(d) for a, b, d in zip(model.pair_geom1, model.pair_geom2, model.pair_dim, strict=True)}
    excluded = {(int(s) >> 16, int(s) & 0xFFFF) for s in model.exclude_signature}
    weld, pairs = model.body_weldid, []
    parents = not model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT
    for a, b in itertools.combinations(range(model.ngeom), 2):
        if (a, b) in explicit or (b, a) in explicit:
            continue
        bodies = int(model.geom_bodyid[a]), int(model.geom_bodyid[b])
        wa, wb = (int(weld[body]) for body in bodies)
        related = wa and wb and (weld[model.body_parentid[wa]] == wb or weld[model.body_parentid[wb]] == wa)
        if wa == wb or (parents and related) or bodies in excluded or bodies[::-1] in excluded:
            continue
        if model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]:
            pairs.append((a, b, _condim(model, a, b)))
    pairs += [(a, b, dim) for (a, b), dim in explicit.items()]
    elliptic = model.opt.cone == mujoco.mjtCone.mjCONE_ELLIPTIC
    return tuple(_pair(model, a, b, dim, elliptic) for a, b, dim in pairs)


def constraint_rows(model: mujoco.MjModel) -> dict[str, int]:
    """Counts the most constraint rows by kind: all contacts made, every joint at a limit."""
    kinds = [mujoco.mjtEq(kind).name.removeprefix("mjEQ_") for kind in model.eq_type]
    return {
        "contacts": sum(pair.rows for pair in contact_pairs(model)),
        "joint limits": int(np.sum(model.jnt_limited != 0) + np.sum(model.tendon_limited != 0)),
        "joint friction": int(np.sum(model.dof_frictionloss > 0) + np.sum(model.tendon_frictionloss > 0)),
        "equalities": sum(_EQUALITY_ROWS.get(kind, 1) for kind in kinds),
    }


def sized(robot: RobotCfg, objects: SceneCfg, sim: SimCfg) -> SimCfg:
    """Sizes MJX-Warp's buffers for all possible contacts of the scene. Imported robots use it: their contacts are not counted."""
    model = scene.build(robot, objects, sim, visuals=False)
    contacts = sum(pair.contacts for pair in contact_pairs(model))
    rows = sum(constraint_rows(model).values())
    return _of_size(sim, contacts, rows)


def crowded(robot: RobotCfg, objects: SceneCfg, sim: SimCfg) -> SimCfg:
    """Sizes MJX-Warp's buffers for a scene of several objects, which cannot all touch one another at once.

    The count assumes that every object lies on the table, every geom of the robot touches the table and one object (of a mesh up
    to ``_PARTS`` of its parts), and every second object touches one more; each time the pair with the most contacts. Contacts
    beyond that are lost and counted (see ``Physics``).
    """
    model = scene.build(robot, objects, sim, visuals=False)
    of_object = {geom: _body(model, geom) for geom in range(model.ngeom) if _body(model, geom) in objects.objects}
    names = {_geom(model, geom): body for geom, body in of_object.items()}
    pairs, least = contact_pairs(model), constraint_rows(model)
    at_table = [pair for pair in pairs if "table" in (pair.first, pair.second)]
    between = [pair for pair in pairs if pair.first in names and pair.second in names]
    rest = [pair for pair in pairs if pair not in at_table and pair not in between]
    hand = {name for pair in rest for name in (pair.first, pair.second) if name not in names}

    def most(count: str) -> int:
        each = []
        for geom in hand:
            of_body: dict[str, list[int]] = {}
            for pair in rest:
                if geom in (pair.first, pair.second):
                    other = pair.second if geom == pair.first else pair.first
                    of_body.setdefault(names.get(other, other), []).append(getattr(pair, count))
            each.append(max(sum(sorted(found, reverse=True)[:_PARTS]) for found in of_body.values()))
        others = sorted((getattr(pair, count) for pair in between), reverse=True)[: len(objects.objects) // 2]
        return sum(getattr(pair, count) for pair in at_table) + sum(each) + sum(others)

    rows = most("rows") + sum(least.values()) - least["contacts"]
    return _of_size(sim, most("contacts"), rows)


def _of_size(sim: SimCfg, contacts: int, rows: int) -> SimCfg:
    return dataclasses.replace(sim, contacts_per_env=max(contacts, 1), constraints_per_env=max(rows, 1))


def _body(model: mujoco.MjModel, geom: int) -> str:
    return model.body(model.geom_bodyid[geom]).name


def _condim(model: mujoco.MjModel, a: int, b: int) -> int:
    """Contact dimension of a pair: that of the geom with higher priority, else the larger one."""
    (pa, pb), (da, db) = model.geom_priority[[a, b]], model.geom_condim[[a, b]]
    return int(max(da, db) if pa == pb else da if pa > pb else db)


def _pair(model: mujoco.MjModel, a: int, b: int, condim: int, elliptic: bool) -> Pair:
    a, b = sorted((a, b), key=lambda g: int(model.geom_type[g]))  # plane, height field, sphere, capsule, ..., as _MOST has them
    kinds = [mujoco.mjtGeom(model.geom_type[g]).name.removeprefix("mjGEOM_").lower() for g in (a, b)]
    contacts = _MOST.get(kinds[0], {}).get(kinds[1], _CONVEX)
    each = condim if elliptic else max(1, 2 * (condim - 1))
    return Pair(_geom(model, a), _geom(model, b), ", ".join(kinds), contacts, condim, contacts * each)


def _geom(model: mujoco.MjModel, geom: int) -> str:
    return model.geom(geom).name or f"{model.body(model.geom_bodyid[geom]).name}'s geom {geom}"
