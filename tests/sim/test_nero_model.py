"""The Nero's MJCF against its published description, and the contacts it is meant to make."""

from pathlib import Path

import model_checks as check
import mujoco
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[2]
MODEL = ROOT / "assets" / "nero" / "nero.xml"

# Joint limits of the URDF: rad for the arm, m for the fingers.
RANGES = {
    "joint1": (-2.70526, 2.70526),
    "joint2": (-1.74, 1.74),
    "joint3": (-2.75, 2.75),
    "joint4": (-1.01, 2.14),
    "joint5": (-2.75, 2.75),
    "joint6": (-0.73, 0.95),
    "joint7": (-1.5707963, 1.5707963),
    "gripper_joint1": (0.0, 0.05),
    "gripper_joint2": (-0.05, 0.0),
}

# Masses of the URDF, except link7's, which is a placeholder there.
MASSES = {
    "base_link": 1.06458435,
    "link1": 0.76710504,
    "link2": 0.69381908,
    "link3": 0.67246544,
    "link4": 0.48451414,
    "link5": 0.58368405,
    "link6": 0.3140406,
    "link7": 0.00627,
    "gripper_flange": 0.04771096,
    "gripper_base": 0.45,
    "gripper_link1": 0.025,
    "gripper_link2": 0.025,
}

# Extent (m) of each link along the axes of its own frame: lower and upper corner.
EXTENTS = {
    "base_link": ((-0.069, -0.040, 0.0), (0.040, 0.040, 0.086)),
    "link1": ((-0.036, -0.041, -0.057), (0.036, 0.037, 0.030)),
    "link2": ((-0.037, -0.229, -0.047), (0.043, 0.033, 0.047)),
    "link3": ((-0.031, -0.039, -0.206), (0.030, 0.039, 0.029)),
    "link4": ((-0.034, -0.104, -0.041), (0.034, 0.031, 0.041)),
    "link5": ((-0.035, -0.035, -0.177), (0.035, 0.035, 0.013)),
    "link6": ((-0.025, -0.028, -0.027), (0.023, 0.024, 0.027)),
    "link7": ((-0.014, -0.014, -0.010), (0.014, 0.014, 0.0001)),
    "gripper_flange": ((-0.023, -0.028, -0.049), (0.022, 0.028, 0.012)),
    "gripper_base": ((-0.033, -0.0825, 0.0), (0.042, 0.0825, 0.065)),
    "gripper_link1": ((-0.028, -0.0765, 0.0), (0.028, 0.0, 0.0265)),
    "gripper_link2": ((-0.028, -0.0765, 0.0), (0.028, 0.0, 0.0265)),
}

# conaffinity of every geom that collides; contype is 0 throughout.
COLLIDERS = {"pad1": 2, "pad2": 2, "tip1": 1, "tip2": 1, "palm": 3, "forearm": 1, "wrist": 1}
COLLIDERS |= {"base": 8, "upper_arm": 8, "elbow": 8}  # meet obstacles alone

KP = [200, 170, 120, 80, 50, 20, 10, 800, 800]
KV = [100, 60, 70, 24, 20, 10, 5, 20, 20]
FORCE = [25] * 7 + [22] * 2


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(MODEL))


def scene() -> mujoco.MjModel:
    """The robot with drives, a table and a cube of 30 mm and 30 g."""
    spec = mujoco.MjSpec.from_file(str(MODEL))
    spec.compiler.discardvisual = True
    spec.option.timestep = 0.01
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10
    spec.option.iterations = 10
    spec.option.ls_iterations = 20
    for body in spec.bodies[1:]:
        body.gravcomp = 1
    for joint, kp, kv, force in zip(spec.joints, KP, KV, FORCE, strict=True):
        drive = spec.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        drive.set_to_position(kp=kp, kv=kv)
        drive.forcerange = [-force, force]
    spec.worldbody.add_geom(name="table", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[1, 1, 0.1], contype=1, conaffinity=0)
    cube = spec.worldbody.add_body(name="cube")
    cube.add_freejoint()
    cube.add_geom(name="cube", type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.015] * 3, mass=0.03, contype=2, conaffinity=1)
    return spec.compile()


def test_poses_agree_with_urdf(model):
    check.poses_agree(model, "nero", base="base_link")


def test_joints(model):
    check.joints_are(model, RANGES)


def test_bodies_and_masses(model):
    assert [model.body(i).name for i in range(1, model.nbody)] == list(MASSES)
    for name, mass in MASSES.items():
        assert model.body(name).mass[0] == mass
    assert model.body_mass.sum() == pytest.approx(5.13419366, abs=1e-9)


@pytest.mark.parametrize("name", EXTENTS)
def test_inertia_is_physical(model, name):
    check.inertia_is_physical(model, name, *EXTENTS[name])


def test_geoms(model):
    check.geoms_are(model, COLLIDERS)


def test_contact_budget():
    model = scene()
    assert {model.geom(i).name for i in range(model.ngeom)} == {"table", "cube", *COLLIDERS}
    pairs, count = check.contacts(model)
    table = {"cube", "tip1", "tip2", "palm", "forearm", "wrist"}
    cube = {"pad1", "pad2", "palm"}
    assert pairs == {frozenset(("table", g)) for g in table} | {frozenset(("cube", g)) for g in cube}
    assert count == 29  # the budget is 30


def test_gripper_geometry(model):
    check.nero_gripper_opens(model, side=1)


def test_grasp_holds():
    """Closed fingers carry the cube for 5 s by friction alone, without creeping or sinking in."""
    model = scene()
    data = mujoco.MjData(model)
    data.joint("gripper_joint1").qpos, data.joint("gripper_joint2").qpos = 0.016, -0.016
    mujoco.mj_kinematics(model, data)
    ee, cube = data.site("ee"), data.body("cube")
    data.qpos[-7:-4] = ee.xpos
    mujoco.mju_mat2Quat(data.qpos[-4:], ee.xmat)
    data.ctrl[-2:] = 0.0, -0.001

    offset = []
    for _ in range(500):
        mujoco.mj_step(model, data)
        offset.append(ee.xmat.reshape(3, 3).T @ (cube.xpos - ee.xpos))
    assert data.contact.dist.min() > -1e-3
    assert np.linalg.norm(offset[-1]) < 2e-3
    assert np.linalg.norm(offset[-1] - offset[100]) / 4.0 < 1e-4
