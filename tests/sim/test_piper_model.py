"""The Piper's MJCF against its published description, the contacts it is meant to make, and a scripted grasp."""

import model_checks as check
import mujoco
import numpy as np
import pytest
from scipy.optimize import least_squares

from mjx_nero.sim.scene import SceneCfg, SimCfg, build
from mjx_nero.tasks.arms.piper import PIPER

# Joint limits of the URDF: rad for the arm, m for the fingers.
RANGES = {
    "joint1": (-2.6179938, 2.6179938),
    "joint2": (0.0, 3.1415926),
    "joint3": (-2.9670597, 0.0),
    "joint4": (-1.7453292, 1.7453292),
    "joint5": (-1.2217304, 1.2217304),
    "joint6": (-2.0943951, 2.0943951),
    "gripper_joint1": (0.0, 0.05),
    "gripper_joint2": (-0.05, 0.0),
}

# Masses (kg) and centres of mass (m) of the URDF.
MASSES = {
    "base_link": (1.02, (-0.00473641164191482, 2.56829134630247e-05, 0.041451518036016)),
    "link1": (0.71, (0.00032, -0.00041, -0.00348)),
    "link2": (1.16, (0.21852, -0.00861, 0.00126)),
    "link3": (0.5, (-0.01999, -0.14808, -0.00053)),
    "link4": (0.38, (0.00013, -0.00076, -0.00394)),
    "link5": (0.383, (0.00018, -0.06104, -0.00227)),
    "link6": (0.007, (-0.00003, 0.00006, -0.002)),
    "gripper_base": (0.45, (-0.000183807162235591, 8.05033155577911e-05, 0.0321436689908876)),
    "gripper_link1": (0.025, (0.00065123185041968, -0.0491929869131989, 0.00972258769184025)),
    "gripper_link2": (0.025, (0.00065123185041968, -0.0491929869131989, 0.00972258769184025)),
}

# Tensors of the URDF (kg m2) about the links' frames: xx, yy, zz, xy, xz, yz. Signs of the products as assets/piper/README.md
# argues: reversed, but for link2's xy.
TENSORS = {
    "base_link": (0.00267433, 0.00282612, 0.00089624, 0.00000073, 0.00017389, -0.0000004),
    "link1": (0.00050027, 0.00040879, 0.00045802, -0.00000078, -0.00000626, -0.00000462),
    "link2": (0.00111915, 0.06763251, 0.067559, 0.00182916, -0.00019233, -0.00000767),
    "link3": (0.01347608, 0.00046377, 0.01363321, -0.00161034, -0.00000066, -0.00000162),
    "link4": (0.00017844, 0.00018914, 0.00014613, -0.00000062, -0.00000067, -0.00000408),
    "link5": (0.00172318, 0.00017936, 0.00171172, -0.00000259, -0.00000010, -0.00000990),
    "gripper_base": (0.00092934, 0.00071447, 0.00039442, -0.00000034, 0.00000738, -0.00000005),
    "gripper_link1": (0.00007371, 0.00000781, 0.0000747, 0.00000113, -0.00000021, 0.00001372),
    "gripper_link2": (0.00007371, 0.00000781, 0.0000747, 0.00000113, -0.00000021, 0.00001372),
}

# Extent (m) of each link along the axes of its own frame: lower and upper corner.
EXTENTS = {
    "base_link": ((-0.067, -0.042, 0.0), (0.040, 0.042, 0.0845)),
    "link1": ((-0.0385, -0.0385, -0.062), (0.0385, 0.0385, 0.033)),
    "link2": ((-0.034, -0.043, -0.0342), (0.317, 0.034, 0.0342)),
    "link3": ((-0.053, -0.203, -0.034), (0.033, 0.033, 0.034)),
    "link4": ((-0.0285, -0.0285, -0.052), (0.0285, 0.0285, 0.027)),
    "link5": ((-0.030, -0.087, -0.030), (0.030, 0.027, 0.030)),
    "link6": ((-0.0175, -0.0175, -0.0075), (0.0175, 0.0175, 0.0)),
    "gripper_base": ((-0.033, -0.0825, 0.0), (0.042, 0.0825, 0.065)),
    "gripper_link1": ((-0.028, -0.0765, 0.0), (0.028, 0.0, 0.0265)),
    "gripper_link2": ((-0.028, -0.0765, 0.0), (0.028, 0.0, 0.0265)),
}

# conaffinity of every geom that collides; contype is 0 throughout.
COLLIDERS = {"pad1": 2, "pad2": 2, "tip1": 1, "tip2": 1, "palm": 3, "forearm": 1, "wrist": 1}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(PIPER.xml))


@pytest.fixture(scope="module")
def scene() -> mujoco.MjModel:
    """Arm, table and a cube of 30 mm and 30 g, as the tasks simulate them."""
    return build(PIPER, SceneCfg(), SimCfg(), visuals=False)


def test_poses_agree_with_urdf(model):
    check.poses_agree(model, "piper", base="base_link")


def test_joints(model):
    check.joints_are(model, RANGES)


def test_bodies_and_masses(model):
    assert [model.body(i).name for i in range(1, model.nbody)] == list(MASSES)
    for name, (mass, center) in MASSES.items():
        assert model.body(name).mass[0] == mass
        np.testing.assert_allclose(model.body(name).ipos, center, rtol=0, atol=1e-12)
    assert model.body_mass.sum() == pytest.approx(4.66, abs=1e-9)


@pytest.mark.parametrize("name", TENSORS)
def test_inertia_is_the_published_one_moved(model, name):
    """Parallel axes, back from the centre of mass to the link's frame."""
    mass, center = MASSES[name][0], np.array(MASSES[name][1])
    moved = check.inertia_in_link_frame(model, name) + mass * (center @ center * np.eye(3) - np.outer(center, center))
    xx, yy, zz, xy, xz, yz = TENSORS[name]
    np.testing.assert_allclose(moved, [[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]], rtol=0, atol=1e-4 * max(xx, yy, zz))


@pytest.mark.parametrize("name", EXTENTS)
def test_inertia_is_physical(model, name):
    check.inertia_is_physical(model, name, *EXTENTS[name])


def test_geoms(model):
    check.geoms_are(model, COLLIDERS)


def test_contact_budget(scene):
    assert {scene.geom(i).name for i in range(scene.ngeom)} == {"table", "cube", *COLLIDERS}
    pairs, count = check.contacts(scene)
    table = {"cube", "tip1", "tip2", "palm", "forearm", "wrist"}
    cube = {"pad1", "pad2", "palm"}
    assert pairs == {frozenset(("table", g)) for g in table} | {frozenset(("cube", g)) for g in cube}
    assert count == 29  # the budget is 30


def test_gripper_geometry(model):
    check.nero_gripper_opens(model, side=-1)


def test_zero_and_home(model):
    """Folded at zero, the gripper forward; at home in front of the arm, 25 degrees from straight down."""
    data = mujoco.MjData(model)
    ee = data.site("ee")
    # The gripper's pitch above the horizon: what the URDF's angles leave at zero, less what joints 2, 3 and 5 turn.
    zero = 1.7938494 - 0.1357866 - np.pi / 2
    for qpos, pos, pitch in (
        (np.zeros(8), (0.1807, 0.0, 0.2241), zero),
        (PIPER.home, (0.3, 0.0, 0.22), zero - (1.29 - 1.161) - 1.1),
    ):
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        np.testing.assert_allclose(ee.xpos, pos, atol=1e-3)
        x, y, z = ee.xmat.reshape(3, 3).T
        np.testing.assert_allclose(z, [np.cos(pitch), 0, np.sin(pitch)], atol=1e-6)
        np.testing.assert_allclose(y, [0, 1, 0], atol=1e-6)


def arm_pose(model: mujoco.MjModel, target, start: np.ndarray) -> np.ndarray:
    """Arm joints that put the grasp point at ``target``, the fingers moving along the world's y, as close to straight down as
    joint5 allows."""
    data, low, high = mujoco.MjData(model), *model.jnt_range[:6].T

    def error(q):
        data.qpos[:6] = q
        mujoco.mj_kinematics(model, data)
        x, y, z = data.site("ee").xmat.reshape(3, 3).T
        return np.concatenate([(data.site("ee").xpos - target) * 10, y[[0, 2]], [1e-2 * x[2]], 1e-4 * (q - start)])

    margin = 0.01  # from the joint limits
    found = least_squares(error, np.clip(start, low + margin, high - margin), bounds=(low + margin, high - margin))
    assert np.abs(found.fun[:3]).max() / 10 < 1e-3 and np.abs(found.fun[3:5]).max() < 1e-2, (target, found.fun)
    return found.x


@pytest.mark.parametrize("place", [(0.3, -0.1), (0.35, 0.05), (0.4, 0.2)])
def test_scripted_grasp_lifts_and_holds(scene, place):
    data, heights = mujoco.MjData(scene), (0.117, 0.08, 0.05, 0.017)
    poses = [np.array(PIPER.arm.home)]
    for z in heights:
        poses.append(arm_pose(scene, (*place, z), poses[-1]))
    data.qpos[:8] = data.ctrl[:] = (*poses[1], *PIPER.gripper.open)
    data.qpos[8:10] = place

    def follow(path, fingers, seconds):
        """Set-points along ``path`` for so long, then half a second of rest."""
        steps = round(seconds / scene.opt.timestep)
        for at in np.linspace(0, len(path) - 1, steps).tolist() + [len(path) - 1] * 50:
            i = min(int(at), max(len(path) - 2, 0))
            data.ctrl[:6] = path[i] + (at - i) * (path[min(i + 1, len(path) - 1)] - path[i])
            data.ctrl[6:] += np.clip(fingers - data.ctrl[6:], -0.015, 0.015)  # 1.5 m/s
            mujoco.mj_step(scene, data)

    follow(poses[1:], PIPER.gripper.open, 1.5)
    follow(poses[-1:], PIPER.gripper.close, 0.5)
    follow(poses[:0:-1], PIPER.gripper.close, 2.0)
    ee, cube, offsets = data.site("ee"), data.body("cube"), []
    for _ in range(200):
        mujoco.mj_step(scene, data)
        offsets.append(ee.xmat.reshape(3, 3).T @ (cube.xpos - ee.xpos))
        touching = {frozenset(scene.geom(g).name for g in pair) for pair in data.contact.geom}
        assert touching == {frozenset(("pad1", "cube")), frozenset(("pad2", "cube"))}
        assert data.contact.dist.min() > -1e-3
        assert cube.xpos[2] > 0.11
    assert np.linalg.norm(offsets[-1]) < 5e-3
    assert np.linalg.norm(offsets[-1] - offsets[0]) / 2.0 < 1e-3
