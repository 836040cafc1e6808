"""Mesh objects in a MuJoCo scene: a body with convex parts for contacts, and a textured mesh for drawing.

If an object may have one of several shapes, its body has as many parts as the shape with the most. ``bank`` looks up the fields
of the model that tell the shapes apart.
"""

from typing import Any

import mujoco
import numpy as np

from mjx_nero.sim.solids import shapes
from mjx_nero.sim.solids.solid import Solid
from mjx_nero.types import UserError

_MESH = mujoco.mjtGeom.mjGEOM_MESH
LEAST, MOST = 0.005, 2.0  # [m] length of an object


def add(
    spec: mujoco.MjSpec,
    name: str,
    solids: list[Solid],
    mass: list[float],
    body: Any,
    table: dict[str, Any],
    others: dict[str, Any],
    visuals: bool,
) -> None:
    """Fills a body with the first of its shapes, and adds the meshes of all.

    The hull meets the table, which is flat, so that the parts would make no difference. The parts meet everything else.

    Args:
        body: body of the spec, with a joint.
        mass: mass of each shape [kg].
        table, others: fields of the geom that meets the table, and of those that meet everything else.
        visuals: also add what is only drawn.
    """
    for k, solid in enumerate(solids):
        for mesh_name, points in meshes(name, k, solid):
            mesh = spec.add_mesh(name=mesh_name)
            mesh.uservert = points.ravel().tolist()
            mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_CONVEX
    weigh(body, solids[0], mass[0])
    for i, geom in enumerate(names(name, solids)):
        # A part that the first shape lacks starts as a copy of its first part, until ``bank`` takes it away.
        mesh_name = geom.replace(name, f"{name}/0", 1) if i <= len(solids[0].sizes) else f"{name}/0/0"
        body.add_geom(name=geom, type=_MESH, meshname=mesh_name, group=3, **(others if i else table))
    if visuals:
        for k, solid in enumerate(solids):
            draw(spec, body, name, k, solid)


def meshes(name: str, shape: int, solid: Solid) -> list[tuple[str, np.ndarray]]:
    """The collision meshes of a shape, with their corners: the hull, then the parts."""
    return [(f"{name}/{shape}", solid.hull), *((f"{name}/{shape}/{i}", part) for i, part in enumerate(solid.parts))]


def names(name: str, solids: list[Solid]) -> list[str]:
    """The collision geoms: the hull, which has the object's name, then as many parts as the shape with the most has."""
    return [name, *(f"{name}/{i}" for i in range(max(len(solid.sizes) for solid in solids)))]


def weigh(body: Any, solid: Solid, mass: float) -> None:
    """Gives a body the mass and the inertia of a solid [kg]."""
    inertia = solid.inertia * (mass / solid.volume)
    body.explicitinertial, body.mass, body.ipos = True, mass, [0.0, 0.0, 0.0]
    body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()


def drawn_name(name: str, shape: int) -> str:
    """Name of the geom that draws a shape."""
    return f"{name}/drawn/{shape}"


def draw(spec: mujoco.MjSpec, body: Any, name: str, shape: int, solid: Solid) -> None:
    """Adds the drawn mesh of a shape to a body. All but the first shape start transparent."""
    mesh = spec.add_mesh(name=drawn_name(name, shape))
    mesh.uservert, mesh.userface = solid.vertices.ravel().tolist(), solid.faces.ravel().tolist()
    mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
    rgba = [*solid.rgba[:3], solid.rgba[3] if shape == 0 else 0.0]
    look: dict[str, Any] = {"rgba": rgba}
    if len(solid.uv) and solid.texture.size:
        mesh.usertexcoord = np.stack([solid.uv[:, 0], 1 - solid.uv[:, 1]], axis=1).ravel().tolist()
        mesh.userfacetexcoord = solid.faces.ravel().tolist()
        texture = spec.add_texture(name=drawn_name(name, shape), type=mujoco.mjtTexture.mjTEXTURE_2D)
        texture.height, texture.width, texture.nchannel = *solid.texture.shape[:2], 3
        texture.data = solid.texture.tobytes()
        material = spec.add_material(name=drawn_name(name, shape))
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
        look = {"material": material.name, "rgba": [1.0, 1.0, 1.0, rgba[3]]}
    geom = {"contype": 0, "conaffinity": 0, "mass": 0, "group": 2, **look}
    body.add_geom(name=drawn_name(name, shape), type=_MESH, meshname=mesh.name, **geom)


def shapes_of(solids: list[Solid]) -> tuple[np.ndarray, ...]:
    """Returns what terms see of each shape, [shapes, ...]: points, middle, edges and code, as in ``ShapeView``."""
    boxes = np.stack([shapes.box(solid) for solid in solids])
    points, codes = (np.stack([make(solid) for solid in solids]) for make in (shapes.points, shapes.code))
    return tuple(x.astype(np.float32) for x in (points, boxes[:, 0], boxes[:, 1], codes))


def checked(name: str, solids: list[Solid], scale: float) -> None:
    """Raises:
    UserError: a shape is too small or too large to be an object on a table.
    """
    for solid in solids:
        if said := misfit(solid, scale):
            raise UserError(f"scene.objects.{name} {said}")


def misfit(solid: Solid, scale: float) -> str:
    """Says why a solid is too small or too large to be an object on a table; empty: it is not."""
    longest = float(np.ptp(solid.points, axis=0).max())
    if LEAST <= longest <= MOST:
        return ""
    units = "0.001 if the file is in millimetres, 0.01 in centimetres, 0.0254 in inches"
    return f"is {longest:.3g} m long: give scale (now {scale:g}; {units})"
