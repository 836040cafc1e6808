"""The picture: each body of the model as a mesh in the browser, with one instance per environment."""

from collections.abc import Callable, Iterator
from typing import cast

import jax
import mujoco
import numpy as np
import trimesh

from mjx_nero.sim import quats
from mjx_nero.sim.touch import OBSTACLE
from mjx_nero.tools.view.hand import Hand
from mjx_nero.tools.view.orders import Orders
from mjx_nero.tools.view.session import Frame, Session, free_joints

HIDDEN = 3  # first of the hidden geom groups, which are collision shapes
SHAPE = "/drawn/"  # part of the name of a geom that draws one of an object's possible shapes (``sim.meshes.body``)
APART = 1.5  # minimum distance between environments [m]


class Scene:
    """Shows frames, and turns drags of goals and objects into orders to the session.

    Args:
        server: a ``viser.ViserServer``.
        model: model with visual shapes (``ManipulationEnv.mj_model``).
        orders: thread that carries out drags.
        hand: moved when the user drags the robot's hand; None: it cannot be dragged.
    """

    def __init__(self, server, session: Session, model: mujoco.MjModel, orders: Orders, hand: Hand | None = None):
        self._orders, self._hand = orders, hand
        own = model.site_bodyid[model.site(session.env.cfg.robot.ee_site).id]
        self._hands = [model.body(b).name for b in range(model.nbody) if hand and own in _above(model, b)]
        self._server, self._session, self._model, self._data = server, session, model, mujoco.MjData(model)
        across, apart = int(np.ceil(np.sqrt(session.size))), max(APART, *session.env.cfg.scene.table_size)
        self._corners = np.array([(i // across * apart, i % across * apart, 0.0) for i in range(session.size)])
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(hdri=None)  # viser's maps are loaded from the internet
        server.scene.configure_default_lights(cast_shadow=False)  # shadows are slow in a browser that draws in software
        server.scene.add_light_hemisphere("/light", sky_color=(255, 255, 255), ground_color=(170, 160, 150), intensity=1.5)
        middle = self._corners.mean(0)
        camera = model.camera("front")
        # One environment is shown as in the package's pictures, several from farther away.
        server.initial_camera.look_at = tuple(middle + model.stat.center)
        server.initial_camera.position = tuple(middle + model.stat.center + (camera.pos - model.stat.center) * across)
        server.initial_camera.fov = float(np.radians(camera.fovy[0]))
        positions, quats = self._poses(session.frame)
        self._stand: list[np.ndarray] = []
        self._place(session.frame)
        self._bodies = []
        for body, name, mesh, rgba in meshes(model):
            handle = server.scene.add_batched_meshes_simple(
                name,
                mesh.vertices.astype(np.float32),
                mesh.faces,
                batched_positions=self._shown(positions[body], model.geom(name[1:]).id if SHAPE in name else -1, session.frame),
                batched_wxyzs=quats[body],
                batched_colors=tuple(int(255 * c) for c in rgba[:3]),
                opacity=float(rgba[3]) if rgba[3] < 1 else None,
                lod="off",
            )
            self._bodies.append((body, handle, model.geom(name[1:]).id if SHAPE in name else -1))
            self._draggable(handle, model.body(body).name)

    def show(self, frame: Frame) -> None:
        """Moves the bodies."""
        positions, quats = self._poses(frame)
        with self._server.atomic():
            for body, handle, geom in self._bodies:
                if body:  # the world does not move
                    handle.batched_positions, handle.batched_wxyzs = self._shown(positions[body], geom, frame), quats[body]
            self._place(frame)

    @staticmethod
    def _shown(positions: np.ndarray, geom: int, frame: Frame) -> np.ndarray:
        """Returns the positions of a body's mesh [n, 3]: far below where an environment has another shape of the object."""
        if geom < 0 or "geom_rgba" not in frame.scenery.look:
            return positions
        there = np.asarray(frame.scenery.look["geom_rgba"])[:, geom, 3] > 0
        return np.where(there[:, None], positions, positions - [0.0, 0.0, 100.0]).astype(np.float32)

    def _place(self, frame: Frame) -> None:
        """Draws the obstacles again if an episode has different ones (see ``ManipulationEnv.scenery``)."""
        boxes = frame.scenery.obstacles
        drawn = jax.tree.leaves(boxes)
        if len(drawn) == len(self._stand) and all(map(np.array_equal, drawn, self._stand)):
            return
        self._stand = drawn
        for name, box in boxes.items():
            color = tuple(int(255 * c) for c in self._model.geom(name).rgba[:3])
            for i, corner in enumerate(self._corners):
                pose = {"position": box.pos_w[i] + corner, "wxyz": box.quat_w[i]}
                self._server.scene.add_box(f"/obstacles/{i}/{name}", color, dimensions=box.size[i], **pose)

    def _poses(self, frame: Frame) -> tuple[np.ndarray, np.ndarray]:
        """Returns positions [bodies, n, 3] and orientations [bodies, n, 4] of all bodies."""
        model, data, n = self._model, self._data, len(frame.qpos)
        positions, quats = np.empty((model.nbody, n, 3), np.float32), np.empty((model.nbody, n, 4), np.float32)
        moved = {field: values for field, values in frame.scenery.look.items() if field.startswith("body_")}
        for i in range(n):
            data.qpos[:] = frame.qpos[i]
            for field, values in moved.items():
                getattr(model, field)[:] = values[i]
            data.mocap_pos[0], data.mocap_quat[0] = frame.scenery.goal_pos_w[i], frame.scenery.goal_quat_w[i]
            mujoco.mj_kinematics(model, data)
            positions[:, i], quats[:, i] = data.xpos + self._corners[i], data.xquat
        return positions, quats

    def _draggable(self, handle, body: str) -> None:
        things = free_joints(self._model)
        hand = self._hand if body in self._hands else None
        if body not in things and body != "goal" and not hand:
            return

        grabbed: dict[int, np.ndarray] = {}  # by browser: vector from the grabbed point to the object's center

        @handle.on_drag
        async def _(event) -> None:  # a coroutine: viser calls only coroutines in order
            i = event.instance_index or 0
            if event.phase == "start":  # later the browser's picture lags behind
                middle = hand.pos + self._corners[i] if hand else np.asarray(handle.batched_positions[i])
                grabbed[event.client_id] = middle - event.start_position
            if event.client_id not in grabbed:
                return
            to = event.end_position + grabbed[event.client_id] - self._corners[i]
            if event.phase == "end":
                del grabbed[event.client_id]
            if hand:
                self._orders.give(("hand", 0), lambda: hand.move(to))
            elif body == "goal":
                self._orders.give((body, i), lambda: self._session.move_goal(i, to))
            else:
                self._orders.give((body, i), lambda: self._session.move_object(i, things[body], to))


def _above(model: mujoco.MjModel, body: int) -> list[int]:
    """Returns a body and its ancestors."""
    return [body, *(_above(model, int(model.body_parentid[body])) if body else [])]


def meshes(model: mujoco.MjModel) -> Iterator[tuple[int, str, trimesh.Trimesh, tuple[float, ...]]]:
    """Yields (body, name, mesh in the body's frame, colour), with all visible geoms of a body and colour in one mesh."""
    for body in range(model.nbody):
        found: dict[tuple[str, tuple[float, ...]], list[trimesh.Trimesh]] = {}
        for geom in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group < HIDDEN)):
            if model.geom_contype[geom] & OBSTACLE:  # obstacles differ between environments
                continue
            material = model.geom_matid[geom]
            rgba = tuple(float(x) for x in (model.mat_rgba[material] if material >= 0 else model.geom_rgba[geom]))
            make = _SHAPES.get(int(model.geom_type[geom]))
            shape = model.geom(geom).name if SHAPE in model.geom(geom).name else ""
            if make is None or rgba[3] == 0 and not shape:
                continue
            rgba = (*rgba[:3], 1.0) if shape else rgba
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = quats.matrix(model.geom_quat[geom]), model.geom_pos[geom]
            found.setdefault((shape, rgba), []).append(make(model, int(geom)).apply_transform(pose))
        for i, ((shape, rgba), meshes) in enumerate(found.items()):
            yield (
                body,
                f"/{shape or '/'.join((model.body(body).name or 'body', str(i)))}",
                cast(trimesh.Trimesh, trimesh.util.concatenate(meshes)),
                rgba,
            )


def _flat(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    mesh.unmerge_vertices()  # edges stay sharp
    return mesh


def _mesh(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    of = model.mesh(model.geom_dataid[geom])
    vertices = model.mesh_vert[of.vertadr[0] :][: of.vertnum[0]]
    return trimesh.Trimesh(vertices, model.mesh_face[of.faceadr[0] :][: of.facenum[0]], process=False)


_Shape = Callable[[mujoco.MjModel, int], trimesh.Trimesh]
_SHAPES: dict[int, _Shape] = {
    int(mujoco.mjtGeom.mjGEOM_BOX): lambda m, g: _flat(trimesh.creation.box(2 * m.geom_size[g])),
    int(mujoco.mjtGeom.mjGEOM_SPHERE): lambda m, g: trimesh.creation.icosphere(3, m.geom_size[g][0]),
    int(mujoco.mjtGeom.mjGEOM_ELLIPSOID): lambda m, g: trimesh.creation.icosphere(3).apply_scale(m.geom_size[g]),
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): lambda m, g: trimesh.creation.capsule(2 * m.geom_size[g][1], m.geom_size[g][0]),
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): lambda m, g: _flat(
        trimesh.creation.cylinder(m.geom_size[g][0], 2 * m.geom_size[g][1], sections=32)
    ),
    int(mujoco.mjtGeom.mjGEOM_MESH): _mesh,
}
