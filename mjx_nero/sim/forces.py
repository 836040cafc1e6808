"""Force and torque at the wrist, and the forces at the fingers' pads, measured in the last physics step of a control step.

The wrist's readings are MuJoCo's force and torque sensors: what the arm exerts on the hand, in the axes of the flange, including
the hand's own weight and inertia. A pad's reading is the net force of its contacts. ``mdp.sensors.Gauge`` has the errors of real
sensors.
"""

import dataclasses
from collections.abc import Callable, Collection
from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError

WRIST, FINGERS = "wrist", "fingers"  # the readings, and the prefixes of their sensors' names
_NET = 3  # of a contact sensor: one force for all contacts, in the world's axes


def add(spec: mujoco.MjSpec, robot: RobotCfg, names: Collection[str]) -> None:
    """Adds the sensors of the robot's wrist and of its pads, if they are named.

    Raises:
        UserError: the robot has no pads to measure at.
    """
    if WRIST in names:
        site = _hand(spec, robot).add_site(name=WRIST, size=[1e-3, 1e-3, 1e-3], rgba=[0, 0, 0, 0], group=5)
        for kind in ("force", "torque"):
            measures = getattr(mujoco.mjtSensor, f"mjSENS_{kind.upper()}")
            spec.add_sensor(name=f"{WRIST}:{kind}", type=measures, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site.name)
    if FINGERS not in names:
        return
    base = spec.body(robot.base_link)
    pads = [geom for geom in base.find_all(mujoco.mjtObj.mjOBJ_GEOM) if "pad" in geom.name and geom.conaffinity]
    if not pads:
        raise UserError(f"the sensor 'fingers' measures at shapes with 'pad' in their names, but {robot.name} has none")
    for geom in pads:
        spec.add_sensor(
            name=f"{FINGERS}:{geom.name}",
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_GEOM,
            objname=geom.name,
            intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FORCE), _NET, 1],
        )


def _hand(spec: mujoco.MjSpec, robot: RobotCfg) -> Any:
    """The first body beyond the link that the arm's last joint moves; that link itself if it is the hand."""
    last = spec.joint(robot.arm.joints[-1]).parent
    site = spec.site(robot.ee_site)
    body = beyond = site.parent if site is not None else spec.body(robot.ee_site)
    while body.name != last.name and body.name != "world":
        body, beyond = body.parent, body
    return beyond if body.name == last.name else last


@dataclasses.dataclass(frozen=True)
class Gauge:
    """Computes a reading [*b, size] from the sensor values [*b, nsensordata] of one physics step, in NumPy or JAX.

    Attributes:
        addresses: place of each sensor's three numbers among the values.
        norms: the reading is the length of each sensor's force [N]; otherwise all three numbers.
    """

    addresses: np.ndarray
    norms: bool

    @property
    def size(self) -> int:
        """Number of numbers in the reading."""
        return len(self.addresses) * (1 if self.norms else 3)

    def __call__(self, values: Any) -> Any:
        """Returns the reading."""
        each = values[..., self.addresses[:, None] + np.arange(3)]
        return (each**2).sum(-1) ** 0.5 if self.norms else each.reshape(*each.shape[:-2], -1)


def gauges(model: mujoco.MjModel) -> dict[str, Gauge]:
    """Makes the gauges of a model's sensors, by name in ``Sim.readings``. Empty if the scene has no such sensor.

    ``wrist`` [6] is force [N] and torque [N m]; ``fingers`` [pads] are forces [N].
    """
    found = {}
    for name in (WRIST, FINGERS):
        ours = [i for i in range(model.nsensor) if model.sensor(i).name.startswith(f"{name}:")]
        if ours:
            found[name] = Gauge(np.array(model.sensor_adr[ours]), name == FINGERS)
    return found


def on_warp(m: mujoco.MjModel, model: Any, data: Any, out: Any) -> Callable[[], None]:
    """Makes a function that measures in MuJoCo Warp, between a step's solver and its integrator, as MuJoCo's sensors do.

    The package's own kernels leave out what only sensors need, so it is computed here, once per control step.

    Args:
        m: the compiled model; model, data: MuJoCo Warp's.
        out: the readings [worlds, numbers], all gauges' one after another.
    """
    found, parts, end = gauges(m), [], 0
    for name, make in ((WRIST, _wrench), (FINGERS, _press)):
        if name in found:
            parts.append(make(m, model, data, out[:, end : end + found[name].size]))
            end += found[name].size

    def measure():
        for part in parts:
            part()

    return measure


def _wrench(m: mujoco.MjModel, model: Any, data: Any, out: Any) -> Callable[[], None]:
    """Makes a function that writes force and torque at the wrist [worlds, 6]."""
    import warp as wp
    from mujoco.mjx.third_party import mujoco_warp

    site = int(m.site(WRIST).id)
    body = int(m.site_bodyid[site])
    root = int(m.body_rootid[body])

    @wp.kernel(module="unique", enable_backward=False)
    def turned(
        inner: wp.array2d(dtype=wp.spatial_vector),  # type: ignore
        middle: wp.array2d(dtype=wp.vec3),  # type: ignore
        place: wp.array2d(dtype=wp.vec3),  # type: ignore
        turn: wp.array2d(dtype=wp.mat33),  # type: ignore
        out: wp.array2d(dtype=float),  # type: ignore
    ):
        w = wp.tid()
        # About the tree's centre of mass, in the world's axes: torque, then force.
        force = wp.spatial_bottom(inner[w, body])
        torque = wp.spatial_top(inner[w, body]) - wp.cross(place[w, site] - middle[w, root], force)  # type: ignore[operator]
        axes = wp.transpose(turn[w, site])
        force = axes @ force  # type: ignore[operator]
        torque = axes @ torque
        for i in range(3):
            out[w, i] = force[i]
            out[w, 3 + i] = torque[i]

    def measure():
        mujoco_warp.kinematics(model, data)
        mujoco_warp.com_pos(model, data)
        mujoco_warp.rne_postconstraint(model, data)
        inputs = [data.cfrc_int, data.subtree_com, data.site_xpos, data.site_xmat]
        wp.launch(turned, dim=data.nworld, inputs=inputs, outputs=[out])

    return measure


def _press(m: mujoco.MjModel, model: Any, data: Any, out: Any) -> Callable[[], None]:
    """Makes a function that writes the net forces at the pads [worlds, pads]."""
    import warp as wp
    from mujoco.mjx.third_party.mujoco_warp._src.support import contact_force_fn

    ours = [i for i in range(m.nsensor) if m.sensor(i).name.startswith(f"{FINGERS}:")]
    pad = np.full(m.ngeom, -1, np.int32)
    pad[m.sensor_objid[ours]] = np.arange(len(ours))
    net: Any = wp.zeros((data.nworld, len(ours)), dtype=wp.vec3)
    seen = data.contact
    inputs = [model.opt.cone, wp.array(pad, dtype=int), seen.frame, seen.friction, seen.dim, seen.efc_address, seen.adhesion]
    inputs += [seen.geom, seen.worldid, data.efc.force, data.njmax, data.nacon, net]

    @wp.kernel(module="unique", enable_backward=False)
    def add_up(
        cone: int,
        pads: wp.array(dtype=int),  # type: ignore
        frame: wp.array(dtype=wp.mat33),  # type: ignore
        friction: wp.array(dtype=seen.friction.dtype),  # type: ignore
        dim: wp.array(dtype=int),  # type: ignore
        address: wp.array2d(dtype=int),  # type: ignore
        adhesion: wp.array(dtype=float),  # type: ignore
        geom: wp.array(dtype=wp.vec2i),  # type: ignore
        worldid: wp.array(dtype=int),  # type: ignore
        forces: wp.array2d(dtype=float),  # type: ignore
        njmax: int,
        nacon: wp.array(dtype=int),  # type: ignore
        net: wp.array2d(dtype=wp.vec3),  # type: ignore
    ):
        i = wp.tid()
        if i >= nacon[0]:
            return
        world = worldid[i]
        for side in range(2):  # the force is what the first geom exerts on the second
            k = pads[geom[i][side]]
            if k >= 0:
                force = contact_force_fn(cone, frame, friction, dim, address, adhesion, forces, njmax, nacon, world, i, True)
                wp.atomic_add(net, world, k, wp.spatial_top(force) * float(2 * side - 1))  # type: ignore[operator]

    @wp.kernel(module="unique", enable_backward=False)
    def lengths(net: wp.array2d(dtype=wp.vec3), out: wp.array2d(dtype=float)):  # type: ignore
        w, k = wp.tid()  # type: ignore[misc]
        out[w, k] = wp.length(net[w, k])

    def measure():
        net.zero_()
        wp.launch(add_up, dim=data.naconmax, inputs=inputs)
        wp.launch(lengths, dim=(data.nworld, len(ours)), inputs=[net], outputs=[out])

    return measure
