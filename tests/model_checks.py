"""What the tests of the robots' models have in common. The figures stand in the tests, one file a robot."""

from collections.abc import Collection, Mapping
from itertools import combinations
from pathlib import Path

import mujoco
import numpy as np
import pytest

DATA = Path(__file__).parent / "data"
PLANE, SPHERE, CAPSULE, BOX = (int(getattr(mujoco.mjtGeom, f"mjGEOM_{k}")) for k in ("PLANE", "SPHERE", "CAPSULE", "BOX"))

# Most contacts that one pair of shapes can make.
MOST_CONTACTS = {
    frozenset((PLANE, BOX)): 4,
    frozenset((PLANE, SPHERE)): 1,
    frozenset((PLANE, CAPSULE)): 2,
    frozenset((SPHERE, BOX)): 1,
    frozenset((CAPSULE, BOX)): 2,
    frozenset((BOX,)): 8,
}


def cobotta_down(x, y, z, psi=0.0) -> np.ndarray:
    """The Cobotta's joints with its flange at places [m], straight down: closed form, the last axis the joints.

    Its links have 0.51 and 0.39 m, the shoulder is 0.05 m up, and 0.12 m lie between the planes of arm and flange.

    Args:
        psi: turn of the flange about the vertical [rad].
    """
    rho = np.hypot(x, y)
    r, h = np.sqrt(rho**2 - 0.12**2), z - 0.05
    q1 = np.arctan2(y, x) - np.arcsin(0.12 / rho)
    q3 = np.arccos((r**2 + h**2 - 0.51**2 - 0.39**2) / (2 * 0.51 * 0.39))
    q2 = np.arctan2(r, h) - np.arctan2(0.39 * np.sin(q3), 0.51 + 0.39 * np.cos(q3))
    return np.stack([q1, q2, q3, np.zeros_like(q1), np.pi - q2 - q3, q1 - psi], axis=-1)


def poses_agree(model: mujoco.MjModel, robot: str, base: str, sites: Collection[str] = ()) -> None:
    """Every link has the pose that ``data/make_fk.py`` computed from the URDF.

    Args:
        robot: its name, as of the file in ``data``.
        base: the link that poses are relative to.
        sites: links of the URDF that are sites of the model.
    """
    with np.load(DATA / f"{robot}_fk.npz") as file:
        reference = dict(file)
    assert reference["qpos"].shape == (100, model.nq)
    assert set(reference["joints"]) == {model.joint(i).name for i in range(model.njnt)}
    assert set(reference["links"]) - set(sites) == {model.body(i).name for i in range(1, model.nbody)} - {base}
    assert np.array_equal(model.body(base).pos, np.zeros(3)) and np.array_equal(model.body(base).quat, [1, 0, 0, 0])

    data = mujoco.MjData(model)
    joints = [model.joint(name).qposadr[0] for name in reference["joints"]]
    frames = {name: data.site(name) if name in sites else data.body(name) for name in reference["links"]}
    quat, inverse, difference = np.empty(4), np.empty(4), np.empty(4)
    for q, places, turns in zip(reference["qpos"], reference["pos"], reference["quat"], strict=True):
        data.qpos[joints] = q
        mujoco.mj_kinematics(model, data)
        for (name, frame), place, turn in zip(frames.items(), places, turns, strict=True):
            np.testing.assert_allclose(frame.xpos, place, rtol=0, atol=1e-6, err_msg=name)
            mujoco.mju_mat2Quat(quat, frame.xmat)
            mujoco.mju_negQuat(inverse, turn)
            mujoco.mju_mulQuat(difference, inverse, quat)
            # The vector part keeps full precision near zero, where the arc cosine of the scalar part would not.
            angle = 2 * np.arcsin(min(1.0, np.linalg.norm(difference[1:])))
            assert angle < 1e-6, (name, angle)


def joints_are(
    model: mujoco.MjModel, ranges: Mapping[str, tuple[float, float]], damping: float | list = 0.0, friction: float | list = 0.0
) -> None:
    """These joints in this order, limited, with so much damping and friction; and no drives, keyframes, lights or cameras."""
    assert [model.joint(i).name for i in range(model.njnt)] == list(ranges)
    assert model.jnt_limited.all()
    for name, limits in ranges.items():
        assert tuple(model.joint(name).range) == limits
    assert (model.dof_armature > 0).all()
    assert (model.dof_damping == damping).all() and (model.dof_frictionloss == friction).all()
    assert model.nu == 0 and model.nkey == 0 and model.nlight == 0 and model.ncam == 0


def inertia_in_link_frame(model: mujoco.MjModel, name: str) -> np.ndarray:
    """Inertia tensor about the centre of mass, along the axes of the link."""
    body, rotation = model.body(name), np.empty(9)
    mujoco.mju_quat2Mat(rotation, body.iquat)
    rotation = rotation.reshape(3, 3)
    return rotation @ np.diag(body.inertia) @ rotation.T


def obeys_triangle_inequality(model: mujoco.MjModel, name: str) -> None:
    small, middle, large = np.sort(model.body(name).inertia)
    assert small > 0 and small + middle >= large, name


def inertia_is_physical(model: mujoco.MjModel, name: str, lower, upper) -> None:
    """No mass distribution inside the link's extent exceeds the bound on the second moment along each axis.

    Args:
        lower, upper: corners of the extent along the axes of the link's own frame [m].
    """
    obeys_triangle_inequality(model, name)
    body, tensor = model.body(name), inertia_in_link_frame(model, name)
    second_moments = np.trace(tensor) / 2 - np.diag(tensor)
    lower, upper = np.array(lower), np.array(upper)
    assert (lower <= body.ipos).all() and (body.ipos <= upper).all(), name
    assert (second_moments > 0).all(), name
    assert (second_moments <= body.mass[0] * (upper - body.ipos) * (body.ipos - lower)).all(), name


def geoms_are(model: mujoco.MjModel, colliders: Mapping[str, int]) -> None:
    """Primitives alone; those that collide have this conaffinity and group 3, the others are looks, in group 2.

    Args:
        colliders: conaffinity of every geom that collides; contype is 0 throughout.
    """
    assert model.nmesh == 0
    for i in range(model.ngeom):
        geom = model.geom(i)
        assert geom.type[0] not in (mujoco.mjtGeom.mjGEOM_MESH, mujoco.mjtGeom.mjGEOM_HFIELD)
        assert geom.contype[0] == 0
        assert geom.conaffinity[0] == colliders.get(geom.name, 0)
        assert geom.group[0] == (3 if geom.name in colliders else 2)
    assert {model.geom(i).name for i in range(model.ngeom)} >= set(colliders)


def contacts(model: mujoco.MjModel) -> tuple[set[frozenset[str]], int]:
    """The pairs of geoms that may touch, and the most contacts that they can make together."""
    pairs, count = set(), 0
    for a, b in combinations(range(model.ngeom), 2):
        if model.geom_contype[a] & model.geom_conaffinity[b] or model.geom_contype[b] & model.geom_conaffinity[a]:
            pairs.add(frozenset((model.geom(a).name, model.geom(b).name)))
            count += MOST_CONTACTS[frozenset((int(model.geom_type[a]), int(model.geom_type[b])))]
    return pairs, count


def nero_gripper_opens(model: mujoco.MjModel, side: int) -> None:
    """The pads' faces are where the Nero's finger joints say, and the grasp point lies between them.

    Args:
        side: sign of y, in the gripper's frame, on which ``gripper_joint1`` opens.
    """
    data = mujoco.MjData(model)
    base, pads = model.body("gripper_base").id, [model.geom("pad1").id, model.geom("pad2").id]
    q1, q2 = (model.joint(name).qposadr[0] for name in ("gripper_joint1", "gripper_joint2"))
    for opening in ((0.0, 0.0), (0.05, -0.05), (0.01, -0.03)):
        data.qpos[[q1, q2]] = opening
        mujoco.mj_kinematics(model, data)
        rotation = data.xmat[base].reshape(3, 3)
        centres = (data.geom_xpos[pads] - data.xpos[base]) @ rotation
        thickness, length = model.geom_size[pads[0], 2], model.geom_size[pads[0], 1]
        faces = side * centres[:, 1] + np.array([-thickness, thickness])
        assert faces[0] - faces[1] == pytest.approx(opening[0] - opening[1], abs=1e-7)
        np.testing.assert_allclose(faces, opening, atol=1e-7)
        np.testing.assert_allclose(centres[:, 2] + length, 0.1358, atol=1e-7)

    np.testing.assert_allclose((data.site("ee").xpos - data.xpos[base]) @ rotation, [0, 0, 0.125], atol=1e-12)
    assert model.site("ee").bodyid[0] == base
