"""The Cobotta Pro 900's MJCF with the RG6 gripper: against its published description, its stated masses and its gap formula."""

import model_checks as check
import mujoco
import numpy as np
import pytest

from mjx_nero.sim.scene import robot_model
from mjx_nero.tasks.arms.cobotta_pro_900 import COBOTTA_PRO_900

# Joints of the URDF: parent link, child link, origin (m), yaw (rad; roll and pitch are zero throughout), axis, limits.
# The last one is fixed.
URDF = {
    "joint_1": ("base_link", "J1", (0, 0, 0), 0, (0, 0, 1), 4.71238898038469),
    "joint_2": ("J1", "J2", (0, 0, 0.21), 0, (0, 1, 0), 2.61799387799149),
    "joint_3": ("J2", "J3", (0, 0, 0.51), 0, (0, 1, 0), 2.61799387799149),
    "joint_4": ("J3", "J4", (0, -0.03, -0.72), 0, (0, 0, 1), 4.71238898038469),
    "joint_5": ("J4", "J5", (0, 0.03, 1.11), 0, (0, 1, 0), 2.61799387799149),
    "joint_6": ("J5", "J6", (0, 0.12, 0.16), 0, (0, 0, 1), 6.28318530717959),
    "joint_tcp_fixed": ("J6", "onrobot_rg6_base_link", (0, 0, 0), 0, None, None),
    "finger_joint": ("onrobot_rg6_base_link", "left_outer_knuckle", (0, -0.024112, 0.136813), 0, (-1, 0, 0), 0.628319),
    "left_inner_finger_joint": ("left_outer_knuckle", "left_inner_finger", (0, -0.047335, 0.064495), 0, (1, 0, 0), 0.872665),
    "left_inner_knuckle_joint": ("onrobot_rg6_base_link", "left_inner_knuckle", (0, -0.01272, 0.1595), 0, (1, 0, 0), 0.628319),
    "right_outer_knuckle_joint": (
        "onrobot_rg6_base_link",
        "right_outer_knuckle",
        (0, 0.024112, 0.136813),
        np.pi,
        (1, 0, 0),
        0.628319,
    ),
    "right_inner_finger_joint": ("right_outer_knuckle", "right_inner_finger", (0, -0.047335, 0.064495), 0, (1, 0, 0), 0.872665),
    "right_inner_knuckle_joint": (
        "onrobot_rg6_base_link",
        "right_inner_knuckle",
        (0, 0.01272, 0.1595),
        -np.pi,
        (1, 0, 0),
        0.628319,
    ),
}
JOINTS = [name for name, row in URDF.items() if row[4] is not None]

# The URDF's mimic relations: multipliers of finger_joint.
MIMIC = {
    "left_inner_knuckle_joint": -1,
    "left_inner_finger_joint": 1,
    "right_outer_knuckle_joint": -1,
    "right_inner_knuckle_joint": -1,
    "right_inner_finger_joint": 1,
}

# Mass (kg) and the solid that the inertia is of: a cylinder's axis, radius and length, or a box's edges (m).
SOLIDS = {
    "base_link": (5.0, "z", 0.085, 0.08),
    "J1": (5.5, "z", 0.07, 0.21),
    "J2": (6.5, "z", 0.06, 0.63),
    "J3": (3.6, "y", 0.055, 0.22),
    "J4": (3.0, "z", 0.05, 0.32),
    "J5": (1.9, "y", 0.045, 0.17),
    "J6": (0.5, "z", 0.04, 0.04),
    "onrobot_rg6_base_link": (0.95, 0.075, 0.13, 0.16),
    "left_outer_knuckle": (0.05, 0.02, 0.02, 0.10),
    "left_inner_finger": (0.05, 0.025, 0.03, 0.07),
    "left_inner_knuckle": (0.05, 0.02, 0.012, 0.09),
    "right_outer_knuckle": (0.05, 0.02, 0.02, 0.10),
    "right_inner_finger": (0.05, 0.025, 0.03, 0.07),
    "right_inner_knuckle": (0.05, 0.02, 0.012, 0.09),
}

# conaffinity of every geom that collides; contype is 0 throughout.
COLLIDERS = {"left_pad": 2, "right_pad": 2, "left_tip": 1, "right_tip": 1, "palm": 3, "forearm": 1, "wrist": 1}
COLLIDERS |= {"column": 8, "upper_arm": 8, "elbow": 8}  # meet obstacles alone


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(COBOTTA_PRO_900.xml))


def rotation(axis, angle: float) -> np.ndarray:
    x, y, z = axis
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def transform(rotated: np.ndarray, pos=(0, 0, 0)) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotated, pos
    return pose


def urdf_poses(q: dict[str, float]) -> dict[str, np.ndarray]:
    """Pose of every link in the base's frame, from the table alone."""
    poses = {"base_link": np.eye(4)}
    for name, (parent, child, origin, yaw, axis, _) in URDF.items():
        pose = poses[parent] @ transform(rotation((0, 0, 1), yaw), origin)
        poses[child] = pose if axis is None else pose @ transform(rotation(axis, q[name]))
    return poses


def set_fingers(model: mujoco.MjModel, data: mujoco.MjData, q: float) -> None:
    data.joint("finger_joint").qpos = q
    for name, multiplier in MIMIC.items():
        data.joint(name).qpos = multiplier * q
    mujoco.mj_forward(model, data)


def in_gripper(data: mujoco.MjData) -> tuple[np.ndarray, np.ndarray]:
    """Origin and axes of the gripper's base in the world."""
    body = data.body("onrobot_rg6_base_link")
    return body.xpos, body.xmat.reshape(3, 3)


def test_poses_agree_with_urdf(model):
    data = mujoco.MjData(model)
    limits = np.array([URDF[name][5] for name in JOINTS])
    for q in np.random.default_rng(0).uniform(-limits, limits, (100, len(JOINTS))):
        for name, value in zip(JOINTS, q, strict=True):
            data.joint(name).qpos = value
        mujoco.mj_kinematics(model, data)
        poses = urdf_poses(dict(zip(JOINTS, q, strict=True)))
        assert len(poses) == model.nbody - 1
        for name, pose in poses.items():
            body = data.body(name)
            np.testing.assert_allclose(body.xpos, pose[:3, 3], rtol=0, atol=1e-6, err_msg=name)
            np.testing.assert_allclose(body.xmat.reshape(3, 3), pose[:3, :3], rtol=0, atol=1e-6, err_msg=name)


def test_sites(model):
    base = model.body("onrobot_rg6_base_link").id
    assert model.site("flange").bodyid[0] == base and model.site("ee").bodyid[0] == base
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    np.testing.assert_allclose(data.site("flange").xpos, [0, 0.12, 1.27], atol=1e-9)
    np.testing.assert_allclose(data.site("ee").xpos, [0, 0.12, 1.27 + 0.26], atol=1e-9)


def test_joints(model):
    check.joints_are(model, {name: (-URDF[name][5], URDF[name][5]) for name in JOINTS})
    assert (model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE).all()
    for name in JOINTS:
        assert tuple(model.joint(name).axis) == URDF[name][4]


def test_mimic_relations(model):
    assert model.neq == len(MIMIC)
    assert (model.eq_type == mujoco.mjtEq.mjEQ_JOINT).all() and model.eq_active0.all()
    found = {}
    for first, second, coefficients in zip(model.eq_obj1id, model.eq_obj2id, model.eq_data, strict=True):
        assert model.joint(second).name == "finger_joint"
        offset, multiplier, *rest = coefficients[:5]
        assert offset == 0 and not np.any(rest)
        found[model.joint(first).name] = multiplier
    assert found == MIMIC


def test_masses(model):
    assert [model.body(i).name for i in range(1, model.nbody)] == list(SOLIDS)
    assert model.body_subtreemass[model.body("base_link").id] == pytest.approx(26.0 + 1.25, abs=1e-9)
    assert model.body_subtreemass[model.body("onrobot_rg6_base_link").id] == pytest.approx(1.25, abs=1e-9)


@pytest.mark.parametrize("name", SOLIDS)
def test_inertia_is_the_stated_solids(model, name):
    mass, *shape = SOLIDS[name]
    if isinstance(shape[0], str):
        axis, radius, length = shape
        expected = np.full(3, mass * (3 * radius**2 + length**2) / 12)
        expected["xyz".index(axis)] = mass * radius**2 / 2
    else:
        squares = np.square(shape)
        expected = mass * (squares.sum() - squares) / 12
    assert model.body(name).mass[0] == mass
    # Along the axes of the link: MuJoCo sorts the principal ones and turns the frame.
    tensor = check.inertia_in_link_frame(model, name)
    np.testing.assert_allclose(tensor, np.diag(expected), rtol=1e-3, atol=1e-3 * expected.min())
    check.obeys_triangle_inequality(model, name)


def test_geoms(model):
    check.geoms_are(model, COLLIDERS)


def test_contact_budget():
    spec = mujoco.MjSpec.from_file(str(COBOTTA_PRO_900.xml))
    spec.compiler.discardvisual = True
    world = spec.worldbody
    world.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], contype=1, conaffinity=0)
    cube = world.add_body(name="cube", pos=[0.5, 0, 0.1])
    cube.add_freejoint()
    cube.add_geom(name="cube", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.02575] * 3, mass=0.1, contype=2, conaffinity=1)
    model = spec.compile()
    assert {model.geom(i).name for i in range(model.ngeom)} == {"table", "cube", *COLLIDERS}
    pairs, count = check.contacts(model)
    table = {"cube", "left_tip", "right_tip", "palm", "forearm", "wrist"}
    cube = {"left_pad", "right_pad", "palm"}
    assert pairs == {frozenset(("table", g)) for g in table} | {frozenset(("cube", g)) for g in cube}
    assert count == 30


@pytest.mark.parametrize("q", np.linspace(-0.628, 0.628, 9))
def test_gap(model, q):
    """The gap formula and its inverse, and pads that stay parallel, flat and opposite one another."""
    data = mujoco.MjData(model)
    set_fingers(model, data, q)
    origin, axes = in_gripper(data)
    faces = {}
    for side, normal in (("left", 1), ("right", -1)):
        pad, half = data.geom(f"{side}_pad"), model.geom(f"{side}_pad").size
        assert model.geom(f"{side}_pad").type[0] == mujoco.mjtGeom.mjGEOM_BOX
        np.testing.assert_allclose(half, [0.0125, 0.004, 0.0185])
        turned = axes.T @ pad.xmat.reshape(3, 3)
        np.testing.assert_allclose(turned, np.diag([normal, normal, 1]), atol=1e-9)
        faces[side] = axes.T @ (pad.xpos - origin) + turned @ [0, half[1], 0]
        np.testing.assert_allclose(faces[side][2], 0.136813 + 0.08 * np.cos(0.6331 - q) + 0.0479, atol=1e-5)
    gap = faces["right"] - faces["left"]
    assert gap[1] == pytest.approx(2 * (0.08 * np.sin(0.6331 - q) - 0.000488), abs=1e-5)
    assert 0.6331 - np.arcsin((gap[1] / 2 + 0.000488) / 0.08) == pytest.approx(q, abs=3e-4)
    np.testing.assert_allclose(gap[[0, 2]], 0, atol=1e-9)


def test_fingers_look_like_their_pads(model):
    """No finger's looks reach past the inner face of its pad: closed fingers touch, and never show through one another."""
    for side in ("left", "right"):
        body, pad = model.body(f"{side}_inner_finger").id, model.geom(f"{side}_pad")
        face = pad.pos[1] + pad.size[1]
        reach = []
        for i in np.flatnonzero((model.geom_bodyid == body) & (model.geom_group == 2)):
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[i])
            reach.append(model.geom_pos[i, 1] + np.abs(turn.reshape(3, 3)[1]) @ model.geom_size[i])
        assert max(reach) == pytest.approx(face, abs=1e-9)


def test_gravity_is_compensated():
    model = robot_model(COBOTTA_PRO_900)
    data = mujoco.MjData(model)
    data.qpos[: len(COBOTTA_PRO_900.arm.home)] = COBOTTA_PRO_900.arm.home
    mujoco.mj_forward(model, data)
    assert (model.body_gravcomp[1:] == 1).all()
    np.testing.assert_allclose(data.qfrc_bias - data.qfrc_gravcomp, 0, atol=1e-9)
