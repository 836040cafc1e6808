"""The kernels of trees of joints against MuJoCo's C library. Without a GPU Warp runs the same sources on the CPU."""

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import make
from mjx_nero.sim.physics.warp import dynamics, kernels, newton
from mjx_nero.sim.scene import SimCfg
from mjx_nero.tasks import registry
from mjx_nero.types import Sim

wp = pytest.importorskip("warp")

# Every kind of joint, force and body that the kernels know, away from the places where terms vanish.
KINDS = """
<mujoco>
  <option timestep="0.004" integrator="implicitfast" iterations="50" ls_iterations="50" cone="elliptic"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <geom type="plane" size="1 1 1"/>
    <body name="mocap" mocap="true" pos="0.2 0.1 1.5" quat="1 1 0 0"><geom pos="0.1 0 0" size="0.05"/></body>
    <body pos="0 0 1" quat="1 0.2 0 0.1" gravcomp="1">
      <joint name="a" axis="0 1 0" pos="0.02 0.01 0" ref="0.3" armature="0.1" damping="0.4 0.3 0.2"/>
      <joint name="b" axis="1 0 1" stiffness="3 1 2" springref="0.2" actuatorfrcrange="-2 2"/>
      <geom type="capsule" fromto="0 0 0 0.3 0.1 0" size="0.02"/>
      <body pos="0.3 0 0">
        <joint name="c" type="slide" axis="0 0 1" damping="2"/>
        <geom type="box" size="0.05 0.02 0.03" pos="0.01 0 0.02" quat="1 0.3 0 0"/>
        <body pos="0.1 0 0" quat="1 0 0.5 0"><geom size="0.03" pos="0 0.1 0"/></body>
        <body name="left" pos="0 0.1 0" gravcomp="0.5">
          <joint name="d" axis="1 0 0" armature="0.01"/><geom size="0.03" pos="0 0 0.1"/>
        </body>
      </body>
      <body name="right" pos="0.2 -0.1 0">
        <joint name="e" axis="0 0 1" armature="0.01"/><geom size="0.03" pos="0.1 0 0"/>
      </body>
    </body>
    <body pos="1 0 1"><freejoint/><geom type="box" size="0.05 0.03 0.02"/></body>
    <body pos="2 0 1"><freejoint/><geom type="box" size="0.05 0.03 0.02" pos="0.1 0.05 0"/><geom size="0.04"/></body>
    <body pos="3 0 1">
      <freejoint/>
      <geom type="box" size="0.05 0.03 0.02"/>
      <body pos="0.1 0 0"><joint name="f" axis="0 1 0" damping="0.1"/><geom size="0.03" pos="0.05 0 0"/></body>
    </body>
  </worldbody>
  <equality>{links}</equality>
  <actuator>
    <position joint="a" kp="20" kv="2" ctrlrange="-0.5 0.5"/>
    <position joint="b" kp="30" kv="1" gear="2"/>
    <position joint="c" kp="400" kv="9" forcerange="-3 3"/>
    <motor joint="d" gear="0.5"/>
  </actuator>
</mujoco>
"""


def states(model, n, seed=0):
    """Configurations, velocities and targets all over the place."""
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(n):
        qpos = model.qpos0.copy()
        mujoco.mj_integratePos(model, qpos, rng.normal(size=model.nv), 0.4)
        found.append((qpos, 2 * rng.normal(size=model.nv), rng.normal(size=model.nu)))
    return found


def fill(data, states):
    for array, values in zip((data.qpos, data.qvel, data.ctrl), zip(*states, strict=True), strict=True):
        wp.copy(array, wp.array(np.array(values, np.float32), dtype=float))


@pytest.mark.parametrize("links", ["", '<connect body1="left" body2="right" anchor="0 0.1 0.05"/>'])
def test_a_step_is_mujocos(links):
    from mujoco.mjx.third_party import mujoco_warp

    model = mujoco.MjModel.from_xml_string(KINDS.format(links=links))
    assert dynamics.missing(model) == []
    n = 8
    started = states(model, n)
    warp_model = mujoco_warp.put_model(model)
    data = mujoco_warp.make_data(model, n, naconmax=8 * n, njmax=16)
    fill(data, started)
    before, after = dynamics.make(model, warp_model, data)
    before()
    mujoco_warp.collision(warp_model, data)
    mujoco_warp.make_constraint(warp_model, data)
    newton.make(warp_model, data)()
    smooth, M = data.qfrc_smooth.numpy(), data.M.numpy()
    after()

    reference = mujoco.MjData(model)
    moves = model.geom_bodyid > 0
    for i, (qpos, qvel, ctrl) in enumerate(started):
        mujoco.mj_resetData(model, reference)
        reference.qpos[:], reference.qvel[:], reference.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_forward(model, reference)
        np.testing.assert_allclose(smooth[i], reference.qfrc_smooth, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(M[i], reference.M, rtol=1e-4, atol=1e-6)
        np.testing.assert_allclose(data.geom_xpos.numpy()[i][moves], reference.geom_xpos[moves], rtol=0, atol=1e-5)
        np.testing.assert_allclose(data.geom_xmat.numpy()[i][moves].reshape(-1, 9), reference.geom_xmat[moves], rtol=0, atol=1e-5)
        np.testing.assert_allclose(
            data.qacc_warmstart.numpy()[i], reference.qacc, rtol=0, atol=2e-3 * np.abs(reference.qacc).max()
        )
        mujoco.mj_step(model, reference)
        np.testing.assert_allclose(data.qvel.numpy()[i], reference.qvel, rtol=1e-3, atol=2e-3)
        np.testing.assert_allclose(data.qpos.numpy()[i], reference.qpos, rtol=0, atol=2e-5)
    assert not data.overflow.numpy().any()


def test_fields_may_differ_from_environment_to_environment():
    """Two environments, one with all masses, dampings and gains doubled: each moves as its own model."""
    from mjx_nero.sim.physics.warp.mujoco_warp import WarpPhysics

    names = ("body_mass", "body_inertia", "dof_damping", "actuator_gainprm", "actuator_biasprm")
    heavy = mujoco.MjModel.from_xml_string(KINDS.format(links=""))
    light = mujoco.MjModel.from_xml_string(KINDS.format(links=""))
    for name in names:
        getattr(heavy, name)[:] *= 2
    mujoco.mj_setConst(heavy, mujoco.MjData(heavy))
    physics = WarpPhysics(light, SimCfg(dt=0.004, decimation=1, iterations=50), names)
    (qpos, qvel, ctrl), *_ = states(light, 1)
    fields = {name: jnp.stack([jnp.asarray(getattr(m, name), jnp.float32) for m in (light, heavy)]) for name in names}
    two = lambda x: jnp.tile(jnp.asarray(x, jnp.float32), (2, 1))  # noqa: E731
    sim = Sim(qpos=two(qpos), qvel=two(qvel), ctrl=two(ctrl), warmstart=two(0 * qvel), time=jnp.zeros(2), fields=fields)
    after, lost = physics.step(sim, two(ctrl))
    assert not lost.any()
    for i, model in enumerate((light, heavy)):
        reference = mujoco.MjData(model)
        reference.qpos[:], reference.qvel[:], reference.ctrl[:] = qpos, qvel, ctrl
        mujoco.mj_step(model, reference)
        np.testing.assert_allclose(after.qvel[i], reference.qvel, rtol=1e-3, atol=2e-3)
    assert np.abs(after.qvel[0] - after.qvel[1]).max() > 0.1


def test_what_overflows_is_counted():
    from mujoco.mjx.third_party import mujoco_warp

    model = mujoco.MjModel.from_xml_string(KINDS.format(links=""))
    warp_model, data = mujoco_warp.put_model(model), mujoco_warp.make_data(model, 2, naconmax=4, njmax=8)
    _, after = dynamics.make(model, warp_model, data)
    wp.copy(data.nefc, wp.array([8, 9], dtype=int))
    after()
    assert data.overflow.numpy().tolist() == [0, 1]
    wp.copy(data.nacon, wp.array([5], dtype=int))
    after()
    assert (data.overflow.numpy() != [0, 1]).all()


@pytest.mark.parametrize(
    ("xml", "what"),
    [
        ("<option density='1.2'/>", "a fluid"),
        ("<option integrator='Euler'/>", "another integrator"),
        ("<option><flag gravity='disable'/></option>", "disabled forces"),
        ("<worldbody><body><joint type='ball'/><geom size='1'/></body></worldbody>", "ball joints"),
        (
            "<worldbody><body><joint name='a' actuatorgravcomp='true'/><geom size='1'/></body></worldbody>",
            "drives that carry weight",
        ),
    ],
)
def test_what_is_missing_is_named(xml, what):
    usual = "" if "integrator" in xml else "<option integrator='implicitfast'/>"
    assert dynamics.missing(mujoco.MjModel.from_xml_string(f"<mujoco>{usual}{xml}</mujoco>")) == [what]


@pytest.mark.parametrize("name", [name for name in registry.list_envs() if registry.robot_of(name)])
def test_no_environment_of_the_package_misses_anything(name):
    assert dynamics.missing(make(name, impl="native", num_envs=1).physics_model) == []


def test_loading_launches_nothing():
    x = wp.zeros(1, dtype=float)

    @wp.kernel
    def add(x: wp.array(dtype=float)):  # type: ignore
        x[0] = x[0] + 1.0

    def work():
        wp.launch(add, dim=1, inputs=[x])

    kernels.load(work)
    assert x.numpy()[0] == 0
    work()
    assert x.numpy()[0] == 1
