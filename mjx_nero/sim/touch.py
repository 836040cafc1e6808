"""Contacts of the robot: unwanted ones, with obstacles or with itself, and those with objects. Adds their sensors and reads them.

The force is the strongest contact of each obstacle and each pair of links, from MuJoCo's contact sensors: all three backends have
them with the same meaning. A net force on a link would hide a link that is squeezed. Distances between all shapes would cost time
in every step and miss what happens between two control steps.
"""

import collections
import copy
import functools
import itertools
from collections.abc import Iterator

import mujoco
import numpy as np

from mjx_nero.sim import linkage, robot_file
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError

OBSTACLE = 8  # contact bit; scenes without obstacles leave out robot shapes with this bit alone
COLLISION = 3  # geom group of the robots' collision shapes, including those that do not collide yet
NAME, HAND = "touch", "hand"  # the readings, and the prefixes of their sensors' names
STRONGEST, NET = 2, 3  # what a contact sensor gives: the force of the strongest contact, or that of all, in the world's axes
# Shapes that every backend can collide with a box.
MEETS_BOX = {mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH}
_SAMPLES = 1000  # postures in which links are tested
_ALWAYS = 0.9  # links that touch in this share of the postures are built that way

Pair = tuple[int, int]  # geoms
Depths = dict[Pair, float]


def add_pairs(spec: mujoco.MjSpec, robot: RobotCfg, name: str = "") -> None:
    """Lets shapes of the robot collide with one another (``self_pairs``), and adds sensors for their contacts.

    Args:
        robot: the robot, with the names of its own file.
        name: its name in the scene (``sim.team``).
    """
    before = f"{name}/" if name else ""
    collision_shapes(spec, before + robot.base_link)  # names them
    for pair in self_pairs(robot):
        first, second = (before + shape for shape in pair)
        spec.add_pair(geomname1=first, geomname2=second)
        add_sensor(spec, first, second)


def add_hand(spec: mujoco.MjSpec, base: str, objects: tuple[str, ...]) -> None:
    """Adds sensors for the contacts between the robot and objects. What collides stays the same.

    Args:
        spec: robot and objects.
        base: the robot's base link.
        objects: names of objects; body and geom share a name.
    """
    for shape in collision_shapes(spec, base):
        for name in objects if shape.contype or shape.conaffinity else ():
            add_sensor(spec, name, shape.name, HAND)


def collision_shapes(spec: mujoco.MjSpec, base: str) -> list:
    """Lists the robot's collision shapes and names those without a name."""
    geoms = [geom for geom in spec.body(base).find_all(mujoco.mjtObj.mjOBJ_GEOM) if geom.conaffinity or geom.group == COLLISION]
    for i, geom in enumerate(geoms):
        geom.name = geom.name or f"{geom.parent.name}'s shape {i + 1}"
    return geoms


def add_sensor(spec: mujoco.MjSpec, first: str, second: str | None = None, reading: str = NAME, reduce: int = STRONGEST) -> None:
    """Adds a sensor of the contact force of a geom: with another one, or with anything."""
    spec.add_sensor(
        name=":".join(filter(None, (reading, first, second))),
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_GEOM,
        objname=first,
        **({"reftype": mujoco.mjtObj.mjOBJ_GEOM, "refname": second} if second else {}),
        intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), reduce, 1],
    )


@functools.cache
def self_pairs(robot: RobotCfg) -> tuple[tuple[str, str], ...]:
    """Lists pairs of the robot's collision shapes that can collide but should not, by name.

    It leaves out consecutive links, parts of the gripper, and pairs that touch at home, in nearly all sampled postures, or in
    none of them.

    Raises:
        UserError: not every backend can collide two of the shapes.
    """
    model, (home, *others) = _depths(robot)
    found = [pair for pair in _now_and_then(home, others) if pair not in home]
    for a, b in found:
        kinds = {mujoco.mjtGeom(model.geom_type[g]) for g in (a, b)}
        if not kinds <= MEETS_BOX:
            names = " and ".join(repr(model.geom(g).name) for g in (a, b))
            raise UserError(f"scene.self_collision: {names} of {robot.name} are shapes that not every backend can collide")
    return tuple((model.geom(a).name, model.geom(b).name) for a, b in found)


def at_home(robot: RobotCfg) -> dict[tuple[str, str], float]:
    """Lists pairs of the robot's links that overlap at home, and how deep [m].

    It leaves out consecutive links, the gripper's own parts, and pairs that touch in nearly all postures. Collision shapes are
    wider than the links, so the depth is that of the hulls of the visual shapes, if both links have some.
    """
    model, (home, *others) = _depths(robot)
    bodies = {tuple(sorted(model.geom_bodyid[list(pair)])): home[pair] for pair in _now_and_then(home, others) if pair in home}
    model, found = copy.copy(model), {}
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
    data = mujoco.MjData(model)
    data.qpos[:] = next(_postures(model, robot))
    mujoco.mj_kinematics(model, data)
    for (first, second), depth in bodies.items():
        drawn = [np.flatnonzero((model.geom_bodyid == body) & (model.geom_group != COLLISION)) for body in (first, second)]
        gaps = [mujoco.mj_geomDistance(model, data, a, b, 0.0, None) for a, b in itertools.product(*drawn)]
        deep = -min(gaps) if gaps else depth
        if deep > 0:
            found[model.body(first).name, model.body(second).name] = float(deep)
    return found


def _now_and_then(home: Depths, others: list[Depths]) -> list[Pair]:
    """The pairs that touch in some postures, and not in nearly all."""
    count = collections.Counter(pair for depths in (home, *others) for pair in depths)
    return sorted(pair for pair, times in count.items() if times < _ALWAYS * (len(others) + 1))


@functools.lru_cache(maxsize=8)
def _depths(robot: RobotCfg) -> tuple[mujoco.MjModel, list[Depths]]:
    """The robot with shapes that all meet, and the depth [m] of each overlapping pair in each of ``_postures``.

    Consecutive links are left out.
    """
    spec = robot_file.model(robot)
    shapes = collision_shapes(spec, robot.base_link)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for geom in shapes:
        geom.contype = geom.conaffinity = 1
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    model = spec.compile()
    arm = [model.joint(name).id for name in robot.arm.joints]
    link = [_link(model, body, arm) for body in model.geom_bodyid]
    data, out = mujoco.MjData(model), []
    for qpos in _postures(model, robot):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        depths: Depths = {}
        for contact in data.contact:
            pair = int(min(contact.geom)), int(max(contact.geom))
            if contact.dist < 0 and abs(link[pair[0]] - link[pair[1]]) > 1:
                depths[pair] = max(-float(contact.dist), depths.get(pair, 0.0))
        out.append(depths)
    return model, out


def _link(model: mujoco.MjModel, body: int, arm: list[int]) -> int:
    """Place of a body in the chain: the number of arm joints that move it."""
    moved = 0
    while body:
        moved += sum(int(model.jnt_bodyid[joint]) == body for joint in arm)
        body = int(model.body_parentid[body])
    return moved


def _postures(model: mujoco.MjModel, robot: RobotCfg) -> Iterator[np.ndarray]:
    """Yields home, then postures of the arm spread evenly over its joints' ranges."""
    ids = [model.joint(name).qposadr[0] for name in robot.joints]
    limits = [model.joint(name).range if model.joint(name).limited[0] else (-np.pi, np.pi) for name in robot.arm.joints]
    low, high = np.array(limits).T
    # Kronecker's sequence of square roots of primes: evenly spread, and the same everywhere.
    primes = (p for p in itertools.count(2) if all(p % q for q in range(2, p)))
    steps = np.sqrt(list(itertools.islice(primes, len(low))))
    coupled = linkage.couplings(model)
    for k in range(_SAMPLES + 1):
        qpos, home = model.qpos0.copy(), np.array(robot.home)
        if k:
            home[: len(low)] = low + (high - low) * ((k * steps) % 1)
        qpos[ids] = home
        linkage.close(coupled, qpos)
        yield qpos
