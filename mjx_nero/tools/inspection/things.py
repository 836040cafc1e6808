"""Describes a mesh object, with its parts, mass and resting poses, as values, tables and a picture."""

import dataclasses

import mujoco
import numpy as np

from mjx_nero.runs import console
from mjx_nero.sim import render, solids
from mjx_nero.sim.meshes import body as bodies
from mjx_nero.sim.scene import ObjectCfg
from mjx_nero.sim.solids import rests

_COLOURS = ((0.86, 0.37, 0.34), (0.36, 0.6, 0.85), (0.45, 0.7, 0.42), (0.93, 0.72, 0.3), (0.62, 0.45, 0.75), (0.4, 0.72, 0.72))


@dataclasses.dataclass(frozen=True)
class Thing:
    """A mesh object.

    Attributes:
        edges: edge lengths of its bounding box, along the file's axes [m].
        corners: number of corners of each convex part.
        volume, mass, inertia: [m3], [kg], and the principal moments about the center of mass [kg m2].
        center: center of mass in the file's frame [m].
        rests: orientation (wxyz) and height of the center [m] of each resting pose, and the share of throws that end in it.
        triangles: number of triangles drawn.
        texture: width and height [pixels]; (0, 0): none.
    """

    file: str
    scale: float
    edges: tuple[float, ...]
    corners: tuple[int, ...]
    volume: float
    mass: float
    inertia: tuple[float, ...]
    center: tuple[float, ...]
    rests: tuple[tuple[tuple[float, ...], float, float], ...]
    triangles: int
    texture: tuple[int, int]
    note: str


def of(file: str, scale: float = 1.0) -> Thing:
    """Reads a file.

    Raises:
        UserError: the file cannot be used as an object; the message says why.
    """
    item = ObjectCfg(shape="mesh", file=file, scale=scale)
    (solid,), (mass,) = item.solids, item.masses
    return Thing(
        file=file,
        scale=scale,
        edges=_floats(np.ptp(solid.points, axis=0)),
        corners=tuple(map(int, solid.sizes)),
        volume=solid.volume,
        mass=mass,
        inertia=_floats(np.linalg.eigvalsh(solid.inertia) * mass / solid.volume),
        center=_floats(solid.center),
        rests=tuple((_floats(q), solid.height(q), float(s)) for q, s in zip(solid.rest_quat, solid.rest_share, strict=True)),
        triangles=len(solid.faces),
        texture=(solid.texture.shape[1], solid.texture.shape[0]) if len(solid.uv) else (0, 0),
        note="; ".join(filter(None, (bodies.misfit(solid, scale), solid.note))),
    )


def tables(thing: Thing) -> list[console.Table]:
    """Makes the tables of an object."""
    view = console.Table(thing.file, ("", ""), left=("",))
    view.add("size", " x ".join(f"{1e3 * edge:.1f}" for edge in thing.edges) + " mm")
    view.add("convex parts", f"{len(thing.corners)}, of up to {max(thing.corners)} corners")
    view.add("volume", f"{1e6 * thing.volume:.1f} cm³")
    view.add("mass", f"{thing.mass:.4g} kg, at {thing.mass / thing.volume:.0f} kg/m³")
    view.add("principal moments", " ".join(f"{moment:.3g}" for moment in thing.inertia) + " kg m²")
    view.add("center of mass", " ".join(f"{1e3 * x:.1f}" for x in thing.center) + " mm in the file")
    view.add(
        "drawn",
        f"{thing.triangles:,} triangles, "
        + ("texture of {} x {}".format(*thing.texture) if any(thing.texture) else "no texture"),
    )
    view.caption = thing.note
    lies = console.Table(
        "resting poses on a table", ("pose", "share", "height of the center", "up in its own axes"), left=("pose",)
    )
    for i, (quat, height, share) in enumerate(thing.rests):
        lies.add(str(i + 1), f"{share:.0%}", f"{1e3 * height:.1f} mm", " ".join(f"{x:.2f}" for x in rests.up(np.array(quat))))
    return [view, lies]


def picture(thing: Thing, width: int = 1280, height: int = 480) -> np.ndarray:
    """Draws an object in its resting poses, and behind them its convex parts in colours; uint8 [height, width, 3].

    Raises:
        UserError: this machine cannot draw.
    """
    solid = solids.find(thing.file).scaled(thing.scale)
    far = 1.25 * float(np.linalg.norm(thing.edges))
    spec = mujoco.MjSpec()
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_FLAT,
        rgb1=[0.9, 0.93, 0.96],
        width=8,
        height=48,
    )
    spec.visual.global_.offwidth, spec.visual.global_.offheight = width, height
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.4] * 3, [0.3] * 3
    world, columns = spec.worldbody, max(len(thing.rests), 3)
    world.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[50 * far, 50 * far, 1], rgba=[0.8, 0.78, 0.75, 1])
    world.add_light(pos=[-2 * far, -3 * far, 6 * far], dir=[0.3, 0.5, -1], diffuse=[0.6] * 3)
    for i, part in enumerate(solid.parts):
        spec.add_mesh(name=f"part {i}").uservert = part.ravel().tolist()
    for i, (quat, up, _) in enumerate(thing.rests):
        x = far * (i - (len(thing.rests) - 1) / 2)
        bodies.draw(spec, world.add_body(pos=[x, 0, up], quat=quat), f"rest {i}", 0, solid)
        body = world.add_body(pos=[x, far, up], quat=quat)
        for k in range(len(solid.sizes)):
            body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"part {k}", rgba=[*_COLOURS[k % len(_COLOURS)], 1])
    camera = mujoco.MjvCamera()
    camera.lookat, camera.distance = [0, 0.35 * far, 0], (0.4 + max(1.2, 1.25 * columns * height / width)) * far
    camera.azimuth, camera.elevation = 90, -35
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with render.renderer(model, height, width) as renderer:
        renderer.update_scene(data, camera)
        return renderer.render()


def _floats(values) -> tuple[float, ...]:
    return tuple(float(x) for x in values)
