"""Force and torque at the wrist and forces at the pads: statics by hand, and motion, the same on other backends."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import slides

from mjx_nero import UserError
from mjx_nero.sim import readings, scene
from mjx_nero.sim.physics.mjx import JaxPhysics
from mjx_nero.sim.physics.native import NativePhysics
from mjx_nero.sim.scene import ObjectCfg, SceneCfg, SimCfg
from mjx_nero.tasks.arms.cobotta_pro_900 import COBOTTA_PRO_900
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.types import Sim

# A plate of half a kilogram on a lift. Its flange is turned by a quarter about x, so that its y points up.
LIFT = """
<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
<body name="flange" pos="0 0 0.1" quat="0.70710678 0.70710678 0 0">
  <geom name="pad" type="box" size="0.1 0.01 0.1" pos="0 0.04 0" mass="0.5" contype="0" conaffinity="2" condim="4"/>
  <site name="ee"/>
</body>
"""
ROBOT = slides.robot("lift", "z", LIFT, 5000.0, 200.0, 500.0)
BALL = ObjectCfg(shape="sphere", size=(0.02,), mass=0.2, condim=6, friction=(1.0, 0.01, 0.01))
SCENE = SceneCfg(objects={"ball": BALL}, table=False, goal="none", sensors=("wrist", "fingers"))
CFG = SimCfg(dt=0.002, decimation=5, iterations=50)
G = 9.81


@pytest.fixture(scope="module")
def model():
    return scene.build(ROBOT, SCENE, CFG, visuals=False, fuse=True)


def play(physics, steps=40, fingers=True) -> tuple[Sim, dict]:
    """Two worlds: the ball lies on the plate, 3 cm beside its middle, while the lift stands; the ball is far away, and the lift
    starts to rise."""
    above = 0.5 + 0.1 + 0.05 + 0.02
    ball = jnp.array([[0.03, 0.0, above, 1, 0, 0, 0], [5.0, 0.0, above, 1, 0, 0, 0]])
    qpos = jnp.concatenate([jnp.zeros((2, 1)), ball], axis=1)
    blank = {"wrist": jnp.zeros((2, 6)), **({"fingers": jnp.zeros((2, 1))} if fingers else {})}
    ctrl = jnp.array([[0.0], [0.2]])
    sim = Sim(qpos, jnp.zeros((2, 7)), ctrl, jnp.zeros((2, 7)), jnp.zeros(2), readings=blank)
    step, found = jax.jit(jax.vmap(physics.step)), []
    for _ in range(steps):
        sim, lost = step(sim, ctrl)
        assert not np.any(lost)
        found.append(jax.device_get(sim.readings))
    return sim, jax.tree.map(lambda *x: np.stack(x), *found)


@pytest.fixture(scope="module")
def native(model):
    return play(NativePhysics(model, CFG))[1]


def _statics(found):
    """The flange carries the plate and the ball, up along its y; the ball, 3 cm out along x, turns it about z. The pad feels the
    ball alone; where there is none, nothing."""
    np.testing.assert_allclose(found["wrist"][-1, 0], [0, 0.7 * G, 0, 0, 0, 0.03 * 0.2 * G], atol=0.02)
    np.testing.assert_allclose(found["fingers"][-1, :, 0], [0.2 * G, 0.0], atol=0.02)


def test_a_weight_by_hand(native):
    _statics(native)


def test_the_inertia_of_the_hand_is_felt(native):
    """While the lift rises faster and faster, the flange pushes more than the weight; then it stands again."""
    up = native["wrist"][:, 1, 1]
    assert up.max() > 1.5 * 0.5 * G and up[-1] == pytest.approx(0.5 * G, abs=0.1)


@pytest.mark.slow
def test_warp_agrees(model, native):
    pytest.importorskip("warp")
    from mjx_nero.sim.physics.warp.mujoco_warp import WarpPhysics

    _, found = play(WarpPhysics(model, CFG))
    _statics(found)
    np.testing.assert_allclose(found["wrist"][:, 1], native["wrist"][:, 1], rtol=0.02, atol=0.1)


@pytest.mark.slow
def test_mjx_weighs_the_same_at_the_wrist(native):
    """Only at rest: a drive at its limit damps otherwise there."""
    model = scene.build(ROBOT, dataclasses.replace(SCENE, sensors=("wrist",)), CFG, visuals=False, fuse=True)
    _, found = play(JaxPhysics(model, CFG), fingers=False)
    np.testing.assert_allclose(found["wrist"][-1], native["wrist"][-1], atol=0.05)


def test_mjx_says_that_it_has_no_net_forces(model):
    with pytest.raises(UserError, match="MJX-JAX cannot compute this scene: .*netforce"):
        JaxPhysics(model, CFG)


@pytest.mark.parametrize(("robot", "hand", "pads"), [(NERO, "gripper_flange", 2), (COBOTTA_PRO_900, None, 2)])
def test_the_wrist_is_where_the_hand_is_mounted(robot, hand, pads):
    """Beyond the last joint of the arm, which no drive of the gripper moves."""
    model = scene.build(robot, SceneCfg(sensors=("wrist", "fingers")), SimCfg(), visuals=False, fuse=True)
    body, last = model.site_bodyid[model.site("wrist").id], model.joint(robot.arm.joints[-1]).bodyid[0]
    assert model.body_parentid[body] == last and (hand is None or model.body(body).name == hand)
    found = readings.of(model)
    assert found["wrist"].size == 6 and found["fingers"].size == pads


def test_a_scene_without_them_has_none():
    model = scene.build(NERO, SceneCfg(), SimCfg(), visuals=False, fuse=True)
    assert readings.of(model) == {} and model.nsensor == 0


def test_a_robot_without_pads_is_told():
    bare = dataclasses.replace(ROBOT, name="bare", mjcf=ROBOT.mjcf.replace('name="pad"', 'name="plate"'))
    with pytest.raises(UserError, match="the sensor 'fingers' measures at shapes with 'pad' in their names, but bare has none"):
        scene.build(bare, SceneCfg(sensors=("fingers",)), SimCfg(), visuals=False)
