"""Readings in MuJoCo Warp, between a step's solver and its integrator, as MuJoCo's sensors measure them.

The package's own kernels leave out what only sensors need, and for each contact sensor MuJoCo Warp would search all contacts.
"""

# The type of the contacts, an argument of the kernels, is made when they are.
# mypy: disable-error-code="attr-defined"

from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim import readings
from mjx_nero.sim.forces import FINGERS, WRIST
from mjx_nero.sim.physics.warp import engine, kernels
from mjx_nero.sim.readings import Reading

Work = Callable[[], None]


def make(m: mujoco.MjModel, model: Any, data: Any) -> tuple[Any, list[Work], list[Work]]:
    """Makes the array of all readings [worlds, numbers], None without any, and the functions that fill it.

    The first ones keep the strongest contacts of every physics step. The others measure the rest, once per control step.

    Args:
        m: the compiled model.
        model, data: MuJoCo Warp's.
    """
    import warp as wp

    found = readings.of(m)
    if not found:
        return None, [], []
    out: Any = wp.zeros((data.nworld, readings.size(found)), dtype=float)
    strongest = [reading for reading in found.values() if reading.strongest]
    end, last = len(strongest), []
    for name, work in ((WRIST, _wrench), (FINGERS, _press)):
        if name in found:
            last.append(work(m, model, data, found[name], out[:, end : end + found[name].size]))
            end += found[name].size
    return out, [_strongest(m, model, data, strongest, out[:, : len(strongest)])] if strongest else [], last


def _contacts(model: Any, data: Any) -> tuple[Any, Any, Any]:
    """Packs the contacts into one kernel argument. Returns its type, its value, and the function of one contact's force [N]."""
    import warp as wp

    names = ("frame", "friction", "dim", "efc_address", "adhesion", "geom", "worldid")
    values = {name: getattr(data.contact, name) for name in names} | {"cone": int(model.opt.cone), "njmax": int(data.njmax)}
    Contacts, found = kernels.packed("Contacts", values | {"force": data.efc.force, "count": data.nacon})
    contact_force_fn = engine.contact_force_fn

    @wp.func
    def force(c: Contacts, i: int, in_world: bool):  # type: ignore[valid-type]
        wrench = contact_force_fn(
            c.cone, c.frame, c.friction, c.dim, c.efc_address, c.adhesion, c.force, c.njmax, c.count, c.worldid[i], i, in_world
        )
        return wp.spatial_top(wrench)

    return Contacts, found, force


def _strongest(m: mujoco.MjModel, model: Any, data: Any, strongest: list[Reading], out: Any) -> Work:
    """Makes a function that raises the greatest forces [worlds, readings] to those of the present contacts."""
    import warp as wp

    pairs = np.zeros((len(strongest), m.ngeom, m.ngeom), bool)  # geoms whose contacts count
    for counted, reading in zip(pairs, strongest, strict=True):
        for first, second in zip(m.sensor_objid[reading.sensors], m.sensor_refid[reading.sensors], strict=True):
            counted[first, second if second >= 0 else slice(None)] = True
        counted |= counted.T.copy()
    Contacts, contacts, force = _contacts(model, data)

    @wp.kernel(module="unique", enable_backward=False)
    def keep(c: Contacts, pairs: wp.array3d(dtype=bool), out: wp.array2d(dtype=float)):  # type: ignore
        i = wp.tid()
        if i >= c.count[0]:
            return
        for k in range(out.shape[1]):
            if pairs[k, c.geom[i][0], c.geom[i][1]]:
                wp.atomic_max(out, c.worldid[i], k, wp.length(force(c, i, False)))

    inputs = [contacts, wp.array(pairs, dtype=bool), out]
    return lambda: wp.launch(keep, dim=data.naconmax, inputs=inputs)


def _wrench(m: mujoco.MjModel, model: Any, data: Any, reading: Reading, out: Any) -> Work:
    """Makes a function that writes force and torque at the wrist [worlds, 6]."""
    import warp as wp

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
        engine.kinematics(model, data)
        engine.com_pos(model, data)
        engine.rne_postconstraint(model, data)
        inputs = [data.cfrc_int, data.subtree_com, data.site_xpos, data.site_xmat]
        wp.launch(turned, dim=data.nworld, inputs=inputs, outputs=[out])

    return measure


def _press(m: mujoco.MjModel, model: Any, data: Any, reading: Reading, out: Any) -> Work:
    """Makes a function that writes the net forces at the pads [worlds, pads]."""
    import warp as wp

    pad = np.full(m.ngeom, -1, np.int32)
    pad[m.sensor_objid[reading.sensors]] = np.arange(reading.size)
    net: Any = wp.zeros((data.nworld, reading.size), dtype=wp.vec3)
    Contacts, contacts, force = _contacts(model, data)
    inputs = [contacts, wp.array(pad, dtype=int), net]

    @wp.kernel(module="unique", enable_backward=False)
    def add_up(c: Contacts, pads: wp.array(dtype=int), net: wp.array2d(dtype=wp.vec3)):  # type: ignore
        i = wp.tid()
        if i >= c.count[0]:
            return
        for side in range(2):  # the force is what the first geom exerts on the second
            k = pads[c.geom[i][side]]
            if k >= 0:
                wp.atomic_add(net, c.worldid[i], k, force(c, i, True) * float(2 * side - 1))

    @wp.kernel(module="unique", enable_backward=False)
    def lengths(net: wp.array2d(dtype=wp.vec3), out: wp.array2d(dtype=float)):  # type: ignore
        w, k = wp.tid()  # type: ignore[misc]
        out[w, k] = wp.length(net[w, k])

    def measure():
        net.zero_()
        wp.launch(add_up, dim=data.naconmax, inputs=inputs)
        wp.launch(lengths, dim=(data.nworld, reading.size), inputs=[net], outputs=[out])

    return measure
