"""Kinematics and clearances in numpy against MuJoCo's."""

import json

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero.deploy import body as bodies
from mjx_nero.interop import description
from mjx_nero.sim import kinematics, linkage, scene
from mjx_nero.tasks import registry

ROBOTS = registry.list_robots()


@pytest.fixture(scope="module", params=ROBOTS)
def posed(request):
    """A robot's model, its data, its numpy body, and a function that takes a posture to both: shapes' frames."""
    robot = registry.robot(request.param)
    model = scene.robot_model(robot, whole=True)
    data = mujoco.MjData(model)
    body = bodies.Body(json.loads(json.dumps(description.body(robot))), robot.joints, robot.base_pos)
    ids = [model.joint(j).qposadr[0] for j in robot.joints]

    def pose(q):
        data.qpos[:], data.qpos[ids] = model.qpos0, q
        for c in linkage.couplings(model):
            data.qpos[c.follower] = c.position(data.qpos)
        mujoco.mj_kinematics(model, data)
        return body.shapes(q)

    low, high = np.array([model.joint(j).range for j in robot.joints]).T
    postures = np.random.default_rng(0).uniform(low, high, (30, len(low)))
    return robot, model, data, body, pose, postures


def solid(model):
    return [g for g in range(model.ngeom) if model.geom_conaffinity[g] or model.geom_group[g] == 3]


def test_poses_are_the_simulators(posed):
    robot, model, data, body, pose, postures = posed
    site = model.site(robot.ee_site).id
    for q in postures[:10]:
        frames = pose(q)[0, : body.solid]
        np.testing.assert_allclose(frames[:, :3, 3], data.geom_xpos[solid(model)], atol=1e-12)
        np.testing.assert_allclose(frames[:, :3, :3].reshape(-1, 9), data.geom_xmat[solid(model)], atol=1e-12)
        position, quat = body.ee(q)
        np.testing.assert_allclose(position, data.site_xpos[site], atol=1e-12)
        np.testing.assert_allclose(bodies.matrix(quat).ravel(), data.site_xmat[site], atol=1e-12)
        learnt = kinematics.site_pose_fn(model, robot.ee_site)(jnp.asarray(data.qpos))[1]
        assert quat @ np.asarray(learnt) > 0.999  # of the two quaternions of a turn the one that policies have seen


def test_many_postures_are_as_one(posed):
    *_, body, _, postures = posed
    np.testing.assert_allclose(body.shapes(postures), np.concatenate([body.shapes(q) for q in postures]), atol=1e-14)


def test_bounds_hold_the_shapes_and_no_more(posed):
    """A plane that slides down onto a shape meets it where the bound says: MuJoCo's distance is zero there."""
    _, model, data, body, pose, postures = posed
    for q in postures[:5]:
        low, high = (bound[0, : body.solid] for bound in body.bounds(pose(q)))
        for i, g in enumerate(solid(model)):
            size, turn, at = model.geom_size[g], data.geom_xmat[g].reshape(3, 3), data.geom_xpos[g]
            if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX:
                corners = at + np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * size @ turn.T
            else:
                half = size[1] if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_CAPSULE else 0.0
                ends = at + np.array([[0, 0, -half], [0, 0, half]]) @ turn.T
                corners = np.concatenate([ends - size[0], ends + size[0]])
            np.testing.assert_allclose([low[i], high[i]], [corners.min(0), corners.max(0)], atol=1e-12)


def test_distances_are_mujocos_for_spheres_and_capsules_and_less_for_boxes(posed):
    _, model, data, body, pose, postures = posed
    geoms = solid(model)
    pairs = np.array([(i, j) for i in range(len(geoms)) for j in range(i)])
    exact = np.array([not {model.geom_type[geoms[i]], model.geom_type[geoms[j]]} & {mujoco.mjtGeom.mjGEOM_BOX} for i, j in pairs])
    for q in postures[:10]:
        ours = body.apart(pose(q), pairs)[0]
        theirs = np.array([mujoco.mj_geomDistance(model, data, geoms[i], geoms[j], 10.0, None) for i, j in pairs])
        apart = theirs > 1e-3
        np.testing.assert_allclose(ours[apart & exact], theirs[apart & exact], atol=1e-9)
        assert (ours[apart] <= theirs[apart] + 1e-6).all()


def test_shapes_of_other_kinds_have_a_box_about_them():
    xml = """<mujoco><worldbody><body name="a"><joint name="j" axis="0 0 1"/><geom name="e" type="ellipsoid" size="0.1 0.2 0.3"/>
    <geom name="c" type="cylinder" size="0.1 0.3" quat="0.9 0.1 0.3 -0.2"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    shapes = [description._shape(model, g) for g in range(2)]
    assert (shapes[0]["type"], shapes[0]["size"]) == ("box", pytest.approx([0.1, 0.2, 0.3]))
    own = {"bodies": [description._body(model, 1)], "ee": {"body": "a", "pos": [0, 0, 0], "quat": [1, 0, 0, 0]}}
    body = bodies.Body({**own, "couplings": [], "shapes": shapes}, ["j"])
    low, high = body.bounds(body.shapes(np.array([0.4])))
    data = mujoco.MjData(model)
    data.qpos[:] = 0.4
    mujoco.mj_kinematics(model, data)
    around = np.linspace(0, 2 * np.pi, 3000)
    rim = np.stack([0.1 * np.cos(around), 0.1 * np.sin(around)], axis=1)
    points = np.concatenate([np.c_[rim, np.full(3000, z)] for z in (-0.3, 0.3)]) @ data.geom_xmat[1].reshape(3, 3).T
    np.testing.assert_allclose([low[0, 1], high[0, 1]], [points.min(0), points.max(0)], atol=1e-5)
