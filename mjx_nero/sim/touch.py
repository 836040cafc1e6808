"""What must not happen: touching an obstacle, or the robot itself. Obstacles in the model, and the force of such contacts.

The force is that of MuJoCo's contact sensors, the strongest contact of each obstacle and each pair of links, because all three
backends have them with the same meaning; the net force on a link would hide a link that is squeezed, and distances between all
shapes would be computed once more in every step and know nothing of the physics steps between two control steps.
"""

import dataclasses
import functools
from collections.abc import Iterator, Mapping
from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim import linkage, robot_file
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError

OBSTACLE = 8  # contact bit; robot shapes of this bit alone are left out where there is nothing of the kind
COLLISION = 3  # geom group of the robots' collision shapes, those that meet nothing as yet included
NAME = "touch"  # of the reading
_PREFIX = f"{NAME}:"  # of the sensors' names
# Shapes that every backend can bring together with a box.
_MEETS_BOX = {mujoco.mjtGeom.mjGEOM_SPHERE, mujoco.mjtGeom.mjGEOM_CAPSULE, mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_MESH}
_SAMPLES = 1000  # postures in which links are looked at
_ALWAYS = 0.9  # links that touch in so many of them are made that way
_ANYWHERE = 10.0  # [m] half the edge of the bounding box of what may stand anywhere


def add(spec: mujoco.MjSpec, base: str, obstacles: Mapping[str, Any], objects: tuple[str, ...], pairs) -> None:
    """Puts obstacles into a scene, lets robot and objects meet them, and measures their contacts.

    Args:
        spec: robot and objects.
        base: the robot's base link.
        obstacles: ``scene.ObstacleCfg`` by name.
        objects: names of bodies and their geoms.
        pairs: names of the robot's geoms that can meet.

    Raises:
        UserError: a name is taken, or a shape cannot meet a box on every backend.
    """
    shapes = [*_collision_shapes(spec, base), *(spec.geom(name) for name in objects)]
    if obstacles:
        # Under a body that can be moved (though nobody does): MuJoCo Warp takes what is fixed to the world to be where it was.
        body = spec.worldbody.add_body(name="obstacles", mocap=True)
        for geom in shapes:
            if geom.type not in _MEETS_BOX:
                kind = mujoco.mjtGeom(geom.type).name.removeprefix("mjGEOM_").lower()
                raise UserError(
                    f"scene.obstacles cannot meet {geom.name or geom.parent.name!r}, a {kind}: only spheres, capsules, boxes and "
                    "meshes meet boxes on every backend"
                )
            geom.conaffinity |= OBSTACLE
    for name, item in obstacles.items():
        if spec.geom(name):
            raise UserError(f"scene.obstacles.{name} needs another name: the robot or the scene has one that is called so")
        body.add_geom(
            name=name,
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[edge / 2 for edge in item.size],
            pos=item.pos,
            quat=item.quat,
            contype=OBSTACLE,
            conaffinity=0,
            mass=0,
            rgba=item.rgba,
        )
        _add_sensor(spec, name, None)
    for first, second in pairs:
        spec.add_pair(geomname1=first, geomname2=second)
        _add_sensor(spec, first, second)


def _collision_shapes(spec: mujoco.MjSpec, base: str) -> list:
    """Of the robot, named."""
    geoms = [geom for geom in spec.body(base).find_all(mujoco.mjtObj.mjOBJ_GEOM) if geom.conaffinity or geom.group == COLLISION]
    for i, geom in enumerate(geoms):
        geom.name = geom.name or f"{geom.parent.name}'s shape {i + 1}"
    return geoms


def _add_sensor(spec: mujoco.MjSpec, first: str, second: str | None) -> None:
    data, strongest = 1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), 2
    spec.add_sensor(
        name=f"{_PREFIX}{first}:{second}" if second else _PREFIX + first,
        type=mujoco.mjtSensor.mjSENS_CONTACT,
        objtype=mujoco.mjtObj.mjOBJ_GEOM,
        objname=first,
        **({"reftype": mujoco.mjtObj.mjOBJ_GEOM, "refname": second} if second else {}),
        intprm=[data, strongest, 1],
    )


def unbounded(model: mujoco.MjModel) -> mujoco.MjModel:
    """The model, ready for obstacles anywhere: what MuJoCo derives from their first poses is made to hold for all."""
    for geom in np.flatnonzero(model.geom_contype & OBSTACLE):
        body = model.geom_bodyid[geom]
        model.geom_sameframe[geom] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        model.geom_aabb[geom, 3:] = _ANYWHERE
        model.bvh_aabb[model.body_bvhadr[body] : model.body_bvhadr[body] + model.body_bvhnum[body], 3:] = _ANYWHERE
    return model


@dataclasses.dataclass(frozen=True)
class Reader:
    """Sensor values [*b, nsensordata], NumPy's or JAX's -> the strongest contact's force [*b] [N].

    Attributes:
        addresses: of the three numbers of each contact's force.
        pairs: the geoms that they are about, [ngeom, ngeom] of booleans.
    """

    addresses: np.ndarray
    pairs: np.ndarray

    def __call__(self, values: Any) -> Any:
        """The force."""
        return (values[..., self.addresses[:, None] + np.arange(3)] ** 2).sum(-1).max(-1) ** 0.5


def readers(model: mujoco.MjModel) -> dict[str, Reader]:
    """What reads a model's sensors, by the names of ``Sim.readings``; none if the scene does not ask for them."""
    ours = [i for i in range(model.nsensor) if model.sensor(i).name.startswith(_PREFIX)]
    pairs = np.zeros((model.ngeom, model.ngeom), bool)
    for first, second in zip(model.sensor_objid[ours], model.sensor_refid[ours], strict=True):
        pairs[first, second if second >= 0 else slice(None)] = True
    return {NAME: Reader(np.array(model.sensor_adr[ours]), pairs | pairs.T)} if ours else {}


@functools.cache
def self_pairs(robot: RobotCfg) -> tuple[tuple[str, str], ...]:
    """Names of the robot's collision shapes that can meet one another and ought not to.

    Left out are links that follow one another, the gripper's own parts, and what touches at home, in nearly all postures, or in
    none of those looked at.

    Raises:
        UserError: shapes that not every backend can bring together.
    """
    spec = robot_file.model(robot)
    shapes = _collision_shapes(spec, robot.base_link)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = 0
    for geom in shapes:
        geom.contype = geom.conaffinity = 1
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_NATIVECCD
    model = spec.compile()
    arm = [model.joint(name).id for name in robot.arm.joints]
    link = [_link(model, body, arm) for body in model.geom_bodyid]
    count: dict[tuple[int, int], int] = {}
    postures = list(_postures(model, robot))
    data = mujoco.MjData(model)
    for k, qpos in enumerate(postures):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        touching = {(int(min(contact.geom)), int(max(contact.geom))) for contact in data.contact if contact.dist < 0}
        for pair in touching:
            if abs(link[pair[0]] - link[pair[1]]) > 1:
                count[pair] = count.get(pair, 0) + (len(postures) if k == 0 else 1)  # the first is home
    found = sorted(pair for pair, times in count.items() if times < _ALWAYS * len(postures))
    for a, b in found:
        kinds = {mujoco.mjtGeom(model.geom_type[g]) for g in (a, b)}
        if not kinds <= _MEETS_BOX:
            names = " and ".join(repr(model.geom(g).name) for g in (a, b))
            raise UserError(f"scene.self_collision: {names} of {robot.name} are shapes that not every backend brings together")
    return tuple((model.geom(a).name, model.geom(b).name) for a, b in found)


def _link(model: mujoco.MjModel, body: int, arm: list[int]) -> int:
    """How many of the arm's joints move a body: its place in the chain."""
    moved = 0
    while body:
        moved += sum(int(model.jnt_bodyid[joint]) == body for joint in arm)
        body = int(model.body_parentid[body])
    return moved


def _postures(model: mujoco.MjModel, robot: RobotCfg) -> Iterator[np.ndarray]:
    """Home, and postures of the arm spread evenly over its joints' ranges."""
    ids = [model.joint(name).qposadr[0] for name in robot.joints]
    limits = [model.joint(name).range if model.joint(name).limited[0] else (-np.pi, np.pi) for name in robot.arm.joints]
    low, high = np.array(limits).T
    # Kronecker's sequence of square roots of primes: evenly spread, and the same everywhere.
    primes = [p for p in range(2, 100) if all(p % q for q in range(2, p))]
    steps = np.sqrt(primes[: len(low)])
    coupled = linkage.couplings(model)
    for k in range(_SAMPLES + 1):
        qpos, home = model.qpos0.copy(), np.array(robot.home)
        if k:
            home[: len(low)] = low + (high - low) * ((k * steps) % 1)
        qpos[ids] = home
        for coupling in coupled:
            qpos[coupling.follower] = coupling.position(qpos)
        yield qpos
