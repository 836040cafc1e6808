"""Finds the resting poses of a thing on a table: candidates by geometry, then the physics decides."""

from typing import Any

import mujoco
import numpy as np
from jaxtyping import Float

from mjx_nero.sim import quats

LEAST_SHARE = 0.02  # least share of throws that end in a resting pose
MAX_RESTS = 8
ALIKE, MOST_ALIKE = 0.02, 2  # share by which the heights of alike poses may differ; how many alike poses are kept
FIRM = 0.1  # [rad] an object rests where it returns from this tilt
SETTLED = np.radians(4.0)  # a pose that the physics turns by more than this is not a rest
SECONDS = 1.0

Points = Float[np.ndarray, "n 3"]


def find(hull: Points, inertia: Float[np.ndarray, "3 3"]) -> tuple[Float[np.ndarray, "k 4"], Float[np.ndarray, " k"]]:
    """Orientations (wxyz) in which a thing rests, and the share of throws that end in each, the most frequent kinds first.

    Args:
        hull: corners about the centre of mass [m].
        inertia: inertia per kilogram [m2].
    """
    import trimesh

    poses, shares = trimesh.poses.compute_stable_poses(
        _simple(hull), center_mass=np.zeros(3), sigma=0.0, n_samples=1, threshold=0.0
    )
    ups = poses[:, 2, :3]
    heights, firm = _height(hull, ups), np.array([_firm(hull, up) for up in ups])
    if firm.any():
        poses, shares, heights = poses[firm], shares[firm], heights[firm]
    alike = np.unique(np.round(heights / (ALIKE * heights.max())), return_inverse=True)[1]
    together, rank = np.bincount(alike, shares)[alike], np.zeros(len(shares), int)  # a bottle lies on any of its many sides alike
    for k in np.argsort(-shares, kind="stable"):
        rank[k] = (rank[alike == alike[k]] > 0).sum() + 1
    keep = [k for k in np.lexsort((rank, -together)) if rank[k] <= MOST_ALIKE and together[k] >= LEAST_SHARE][:MAX_RESTS]
    keep = keep or [int(np.argmax(shares))]
    chances = np.array([together[k] / min(MOST_ALIKE, (alike == alike[k]).sum()) for k in keep])
    quats = np.array([trimesh.transformations.quaternion_from_matrix(poses[k]) for k in keep])
    settled = [_settled(hull, inertia, quat) for quat in quats]
    stays = np.array([turned < SETTLED for _, turned in settled])
    stays |= ~stays.any()
    return np.array([quat for quat, _ in settled])[stays], chances[stays] / chances[stays].sum()


def up(quat: Float[np.ndarray, "4"]) -> Float[np.ndarray, "3"]:
    """The vertical, in the frame of a thing with this orientation (wxyz)."""
    return quats.matrix(quat)[2]


def _settled(hull: Points, inertia: np.ndarray, quat: np.ndarray) -> tuple[np.ndarray, float]:
    """The orientation after a second on a table, and the angle by which it has turned [rad]."""
    size = float(np.ptp(hull, axis=0).max())
    spec = mujoco.MjSpec()
    spec.option.timestep, spec.option.integrator = 0.005, mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.add_mesh(name="hull").uservert = (hull / size * 0.1).ravel().tolist()  # scaled to 10 cm
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0, 0, 1])
    body = spec.worldbody.add_body(pos=[0, 0, float(_height(hull, up(quat)[None])[0]) / size * 0.1], quat=quat)
    body.add_freejoint()
    body.explicitinertial, body.mass, body.ipos = True, 0.1, [0, 0, 0]
    body.fullinertia = (0.1 * inertia * (0.1 / size) ** 2)[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]].tolist()
    body.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="hull")
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(round(SECONDS / model.opt.timestep)):
        mujoco.mj_step(model, data)
    found, cosine = data.qpos[3:7].copy(), float(np.clip(up(quat) @ up(data.qpos[3:7]), -1, 1))
    return found / np.linalg.norm(found), float(np.arccos(cosine))


def _height(points: Points, ups: np.ndarray) -> np.ndarray:
    """Height of the centre above a table, for each direction of up."""
    return -(points @ ups.T).min(axis=0)


def _firm(points: Points, up: np.ndarray) -> bool:
    """True if tilting the thing by ``FIRM`` in any direction lifts its centre."""
    aside = np.linalg.svd(up[None])[2][1:]
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    ways = np.cos(angles)[:, None] * aside[0] + np.sin(angles)[:, None] * aside[1]
    tilted = np.cos(FIRM) * up + np.sin(FIRM) * ways
    return bool((_height(points, tilted) >= _height(points, up[None])).all())


def _simple(hull: Points) -> Any:
    """The hull of rounded corners: parts share corners that differ only in the last digits."""
    import trimesh

    digits = max(0, 4 - int(np.floor(np.log10(float(np.ptp(hull, axis=0).max())))))
    return trimesh.PointCloud(np.unique(np.round(hull, digits), axis=0)).convex_hull
