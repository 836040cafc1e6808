"""Obstacles whose places are drawn, links that meet one another, and the force of it: the same on all three backends."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero.sim import readings, scene, touch
from mjx_nero.sim.obstacles import FIELDS, Obstacles
from mjx_nero.sim.physics.mjx import JaxPhysics
from mjx_nero.sim.physics.native import NativePhysics
from mjx_nero.sim.robot import DriveCfg, RobotCfg
from mjx_nero.sim.scene import ObstacleCfg, SceneCfg, SimCfg
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.types import ObstacleView, Sim

# Three links of 0.2 m in the plane of x and z; folded twice by 2.6 rad the third lies beside the first.
PLANAR = """
<mujoco>
  <compiler angle="radian"/>
  <worldbody>
    <body name="base_link">
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <body name="a">
        <joint name="a" axis="0 -1 0" range="-3 3" armature="0.05"/>
        <inertial pos="0.1 0 0" mass="0.2" diaginertia="0.001 0.001 0.001"/>
        <geom name="a" type="capsule" group="3" size="0.02" fromto="0 0 0 0.2 0 0" contype="0" conaffinity="8"/>
        <body name="b" pos="0.2 0 0">
          <joint name="b" axis="0 -1 0" range="-3 3" armature="0.05"/>
          <inertial pos="0.1 0 0" mass="0.2" diaginertia="0.001 0.001 0.001"/>
          <geom name="b" type="capsule" group="3" size="0.02" fromto="0 0 0 0.2 0 0" contype="0" conaffinity="8"/>
          <body name="c" pos="0.2 0 0">
            <joint name="c" axis="0 -1 0" range="-3 3" armature="0.05"/>
            <inertial pos="0.1 0 0" mass="0.2" diaginertia="0.001 0.001 0.001"/>
            <geom name="c" type="capsule" group="3" size="0.02" fromto="0 0 0 0.2 0 0" contype="0" conaffinity="8"/>
            <site name="ee" pos="0.2 0 0"/>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
ARM = DriveCfg(("a", "b", "c"), (100.0,) * 3, (10.0,) * 3, (20.0,) * 3, (1.0,) * 3, (0.0, 0.5, 0.0))
ROBOT = RobotCfg(name="planar", mjcf=PLANAR, arm=ARM, base_pos=(0.0, 0.0, 0.5), gravity_compensation=True)
SCENE = SceneCfg(objects={}, table=False, obstacles={"one": ObstacleCfg(), "two": ObstacleCfg()}, self_collision=True)
CFG = SimCfg(decimation=3)
FAR = ObstacleView(jnp.array([0.0, 0.0, -0.5]), jnp.array([1.0, 0, 0, 0]), jnp.array([0.05] * 3))
UPRIGHT = jnp.array([1.0, 0.0, 0.0, 0.0])


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return scene.build(ROBOT, SCENE, CFG, visuals=False, fuse=True)


@pytest.fixture(scope="module")
def worlds(model) -> tuple[Sim, jax.Array]:
    """Stretched out along x at z = 0.5, the radius 2 cm: nothing near; a box under the middle link, 1 mm into it; the same turned
    by a quarter; one that ends 1 mm beside it; a far smaller one than was compiled, in the way of a link that comes down; folded,
    the third link 3 mm into the first."""
    obstacles = Obstacles(model, SCENE.obstacles)

    def box(pos, size, quat=UPRIGHT):
        return ObstacleView(jnp.array(pos, jnp.float32), jnp.asarray(quat, jnp.float32), jnp.array(size, jnp.float32))

    quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    folded = [0.0, 1.99, 1.99]  # nearly an equilateral triangle: the end is 37 mm from the beginning
    cases = [
        ([0, 0, 0], {}),
        ([0, 0, 0], {"one": box([0.3, 0, 0.431], [0.04, 0.3, 0.1])}),
        ([0, 0, 0], {"two": box([0.3, 0, 0.431], [0.3, 0.04, 0.1], quarter)}),
        ([0, 0, 0], {"one": box([0.3, 0.071, 0.5], [0.1, 0.1, 0.3])}),
        ([0, 0.5, 0], {"two": box([0.3, 0, 0.4], [0.02, 0.02, 0.02])}),
        (folded, {}),
    ]
    qpos = jnp.array([case for case, _ in cases], jnp.float32)
    boxes = [{"one": FAR, "two": FAR, **drawn} for _, drawn in cases]
    fields = [obstacles.placed({}, each) for each in boxes]
    n = len(cases)
    sim = Sim(
        qpos=qpos,
        qvel=jnp.zeros((n, 3)),
        ctrl=qpos,
        warmstart=jnp.zeros((n, 3)),
        time=jnp.zeros(n),
        fields=jax.tree.map(lambda *x: jnp.stack(x), *fields),
        readings={"touch": jnp.zeros(n)},
    )
    return sim, qpos.at[4, 0].set(-0.8)


def step(physics, sim: Sim, ctrl, times: int) -> tuple[Sim, np.ndarray]:
    forward, forces = jax.jit(jax.vmap(physics.step)), []
    for _ in range(times):
        sim, lost = forward(sim, ctrl)
        assert not np.any(lost)
        forces.append(np.asarray(sim.readings["touch"]))
    return sim, np.array(forces)


@pytest.fixture(scope="module")
def native(model, worlds) -> tuple[Sim, np.ndarray]:
    return step(NativePhysics(model, CFG, FIELDS), *worlds, times=25)


def test_what_touches_is_felt_and_nothing_else(native, worlds):
    sim, forces = native
    assert not forces[:, [0, 3]].any()
    assert (forces[0, [1, 2, 5]] > 0.5).all()
    # The same box, turned and given by its other edges.
    np.testing.assert_allclose(forces[-1, 1], forces[-1, 2], rtol=0.01)
    # The link that comes down meets the small box after a while, and rests on it.
    falls = forces[:, 4]
    assert not falls[:3].any() and falls[-1] > 1.0
    assert sim.qpos[4, 0] > -0.7


def test_a_resting_arm_presses_with_what_its_drive_gives(native, worlds):
    """About the first joint: the drive's torque at rest is the contacts' force times its lever, from the axis to the box. A
    capsule touches a box in up to two places."""
    sim, forces = native
    torque = 100.0 * float(sim.qpos[4, 0] - worlds[1][4, 0])
    total = torque / np.hypot(0.3, 0.1)
    assert 0.45 * total < forces[-1, 4] < 1.05 * total


@pytest.mark.slow
@pytest.mark.parametrize("backend", ["jax", "warp"])
def test_backends_agree(backend, model, worlds, native):
    """MJX-JAX has the capsule rest on the small box in two other points: a hundredth of a radian, and the load is
    shared otherwise."""
    if backend == "warp":
        pytest.importorskip("warp")
        from mjx_nero.sim.physics.warp.mujoco_warp import WarpPhysics

        sim, forces = step(WarpPhysics(model, CFG, FIELDS), *worlds, times=25)
    else:
        sim, forces = step(JaxPhysics(model, CFG, FIELDS), *worlds, times=25)
    np.testing.assert_allclose(sim.qpos, native[0].qpos, atol=2e-3 if backend == "warp" else 1e-2)
    np.testing.assert_array_equal(forces[0] > 0, native[1][0] > 0)
    np.testing.assert_array_equal(forces.max(0) > 0, native[1].max(0) > 0)
    there = [0, 1, 2, 3, 5]
    np.testing.assert_allclose(forces[-1, there], native[1][-1, there], rtol=0.01, atol=1e-3)
    assert forces[-1, 4] == pytest.approx(native[1][-1, 4], rel=0.01 if backend == "warp" else 0.2)


def test_what_the_robot_presses_an_object_with_is_read_and_nothing_else():
    """A cube on the table, an arm's length away; the same on the inside of a finger."""
    model = scene.build(NERO, SceneCfg(sensors=("hand",)), SimCfg(), visuals=False, fuse=True)
    plain = scene.build(NERO, SceneCfg(), SimCfg(), visuals=False, fuse=True)
    (name, reader), data = next(iter(readings.of(model).items())), mujoco.MjData(model)
    assert name == touch.HAND and len(readings.of(model)) == 1 and not readings.of(plain)
    for joint, at in zip(NERO.joints, NERO.home, strict=True):
        data.joint(joint).qpos = at
    data.joint("cube").qpos = [0.3, 0.3, 0.0149, 1, 0, 0, 0]
    mujoco.mj_forward(model, data)
    assert data.ncon and reader(data.sensordata) == 0
    pad = data.geom("pad1")
    data.joint("cube").qpos[:3] = pad.xpos + 0.015 * (data.site("ee").xpos - pad.xpos) / 0.05
    mujoco.mj_forward(model, data)
    assert reader(data.sensordata) > 0.1
    np.testing.assert_array_equal(model.geom_contype, plain.geom_contype)
