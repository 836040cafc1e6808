"""The GPU's solver and physics step against MuJoCo's C library. Without a GPU Warp runs the same source on the CPU, slowly."""

import dataclasses
import sys

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import make
from mjx_nero.learn import policy
from mjx_nero.tasks import registry

wp = pytest.importorskip("warp")

# Every kind of row: joints that are coupled, rub, and are at a limit; a box that slides on a plane, one that sticks to it or
# leaves, another that falls; condim 1, 3 and 6.
KINDS = """
<mujoco>
  <option timestep="0.01" cone="{cone}" impratio="3" iterations="50" ls_iterations="50" jacobian="{jacobian}"/>
  <worldbody>
    <geom type="plane" size="0 0 1" condim="1"/>
    <body pos="0 0 1">
      <joint name="a" axis="0 1 0" frictionloss="0.3" armature="0.1"/>
      <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
      <body pos="0.3 0 0">
        <joint name="b" axis="0 1 0" range="-0.1 0.1" limited="true" frictionloss="5" armature="0.1"/>
        <geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/>
        <body pos="0.3 0 0"><joint name="c" axis="1 0 0" armature="0.1"/><geom size="0.03"/></body>
      </body>
    </body>
    <body pos="1 0 0.05"><freejoint/><geom type="box" size="0.05 0.05 0.05" condim="3" friction="0.3"/></body>
    <body pos="2 0 0.0495"><freejoint/><geom type="box" size="0.05 0.05 0.05" condim="6" friction="2 0.1 0.1"/></body>
    <body pos="3 0 0.5"><freejoint/><geom type="box" size="0.05 0.05 0.05"/></body>
    <body pos="4 0 0.049"><freejoint/><geom size="0.05" condim="1"/></body>
  </worldbody>
  <equality><joint joint1="a" joint2="c" polycoef="0.1 2 0 0 0"/></equality>
</mujoco>
"""


def to_be_solved(model, states, njmax):
    """MuJoCo Warp's model, and its data of states (qpos, qvel) with all that precedes the solver."""
    from mujoco.mjx.third_party import mujoco_warp

    warp_model, n = mujoco_warp.put_model(model), len(states)
    data = mujoco_warp.make_data(model, n, naconmax=20 * n, njmax=njmax)
    for array, values in zip((data.qpos, data.qvel), zip(*states, strict=True), strict=True):
        wp.copy(array, wp.array(np.array(values, np.float32), dtype=float))
    mujoco_warp.fwd_position(warp_model, data, factorize=False)
    mujoco_warp.fwd_velocity(warp_model, data)
    mujoco_warp.fwd_actuation(warp_model, data)
    mujoco_warp.fwd_acceleration(warp_model, data, factorize=True)
    return warp_model, data


@pytest.mark.slow
# The Jacobian in shared memory, or too large for it; buffers whose sizes are multiples of 16 bytes or not.
@pytest.mark.parametrize(("room", "njmax"), [(None, 96), (8, 90), (None, 85)])
@pytest.mark.parametrize("cone", ["elliptic", "pyramidal"])
@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_accelerations_are_mujocos(cone, jacobian, room, njmax, monkeypatch):
    from mujoco.mjx.third_party import mujoco_warp

    from mjx_nero.sim.physics.warp import newton

    if room:
        monkeypatch.setattr(newton, "near", lambda njmax, dense: room)
    model = mujoco.MjModel.from_xml_string(KINDS.format(cone=cone, jacobian=jacobian))
    reference, n = mujoco.MjData(model), 8
    rng, states, expected = np.random.default_rng(0), [], []
    for i in range(n):
        mujoco.mj_resetData(model, reference)
        reference.qpos[:3] = [0.2, 0.15, 0.1]  # b beyond its limit
        reference.qvel[:] = 0.1 * rng.normal(size=model.nv)
        reference.qvel[3:5] = [2.0, -1.0]  # the first box slides
        reference.qvel[11] = 0.5 * (i % 2)  # the second stays, or leaves
        reference.qpos[5] -= 0.001 * i  # ... ever deeper in the plane
        mujoco.mj_forward(model, reference)
        states.append((reference.qpos.copy(), reference.qvel.copy()))
        expected.append((reference.qacc.copy(), reference.efc_state.copy()))
    kinds = {int(s) for _, found in expected for s in found}
    wanted = {mujoco.mjtConstraintState.mjCNSTRSTATE_QUADRATIC, mujoco.mjtConstraintState.mjCNSTRSTATE_SATISFIED}
    wanted |= {mujoco.mjtConstraintState.mjCNSTRSTATE_LINEARNEG, mujoco.mjtConstraintState.mjCNSTRSTATE_LINEARPOS}
    wanted |= {mujoco.mjtConstraintState.mjCNSTRSTATE_CONE} if cone == "elliptic" else set()
    assert {int(x) for x in wanted} <= kinds  # the states have what this is about

    warp_model, data = to_be_solved(model, states, njmax)
    data.qacc.zero_()
    newton.make(warp_model, data)()
    accelerations = np.array([qacc for qacc, _ in expected])
    scale = 1 + np.abs(accelerations).max(axis=1, keepdims=True)
    np.testing.assert_allclose(data.qacc.numpy() / scale, accelerations / scale, rtol=0, atol=1e-3)
    assert 1 <= data.solver_niter.numpy().min() and data.solver_niter.numpy().max() < 20
    # What integrators read: M qacc.
    mujoco_warp.mul_m(warp_model, data, (product := wp.zeros_like(data.qacc)), data.qacc)
    np.testing.assert_allclose(data.efc.Ma.numpy(), product.numpy(), rtol=0, atol=2e-3 * np.abs(product.numpy()).max())


@pytest.mark.slow
@pytest.mark.parametrize("jacobian", ["dense", "sparse"])
def test_nothing_holds_what_falls(jacobian):
    """Without any constraint accelerations are the smooth ones, whatever the last step's were."""
    from mjx_nero.sim.physics.warp import newton

    xml = f"""
    <mujoco>
      <option cone="elliptic" jacobian="{jacobian}"/>
      <worldbody>
        <body><joint axis="0 1 0" armature="0.1"/><geom type="capsule" fromto="0 0 0 0.3 0 0" size="0.02"/></body>
        <body pos="1 0 1"><freejoint/><geom type="box" size="0.05 0.05 0.05"/></body>
      </worldbody>
    </mujoco>"""
    model, n = mujoco.MjModel.from_xml_string(xml), 4
    reference = mujoco.MjData(model)
    reference.qvel[:] = np.linspace(-1, 1, model.nv)
    mujoco.mj_forward(model, reference)
    assert reference.nefc == 0
    warp_model, data = to_be_solved(model, [(reference.qpos, reference.qvel)] * n, 16)
    data.qacc_warmstart.fill_(7.0)
    newton.make(warp_model, data)()
    np.testing.assert_allclose(data.qacc.numpy(), np.tile(reference.qacc, (n, 1)), rtol=0, atol=1e-3)


@pytest.mark.slow
def test_a_control_step_is_mujocos_while_cubes_are_held():
    """From states of the shipped policy, cubes in the grip or on the table, in single precision."""
    from mjx_nero.sim.physics.warp.mujoco_warp import WarpPhysics

    n = 8
    env = make("nero_lift", impl="native", num_envs=n, corruption=False)
    trained = policy.load_for(env, "nero_lift", None)
    step = jax.jit(jax.vmap(env.step))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), n))
    warp = WarpPhysics(env.physics_model, env.cfg.sim)
    warp.prepare(n)
    loaded = dict(warp._get._made)
    warp_step, targets = jax.jit(jax.vmap(warp.step)), jax.jit(jax.vmap(env.targets))
    for t in range(100):
        action = trained.act(state.obs)
        if t % 33 == 32:  # not at the start, where cubes touch the table to the last digit, and rounding decides whether they do
            sim, ctrl = state.pipeline_state, targets(state, action)
            (ours, lost), (reference, _) = warp_step(sim, ctrl), env.physics.step(sim, ctrl)
            assert not lost.any()
            np.testing.assert_allclose(ours.qpos[:, :12], reference.qpos[:, :12], rtol=0, atol=1e-5)
            np.testing.assert_allclose(ours.qpos[:, 12:], reference.qpos[:, 12:], rtol=0, atol=5e-4)  # orientation of the cube
            np.testing.assert_allclose(ours.qvel[:, :12], reference.qvel[:, :12], rtol=0, atol=2e-3)
            np.testing.assert_allclose(ours.qvel[:, 12:], reference.qvel[:, 12:], rtol=0, atol=0.05)
            np.testing.assert_allclose(ours.time, sim.time + 0.02, atol=1e-6)
        state = step(state, action)
    assert (state.pipeline_state.qpos[:, 11] > 0.05).sum() >= n // 2  # most cubes are in the air
    assert warp._get._made == loaded and len(loaded) == 1  # the steps have taken what was loaded before them

    # The same without a batch, and with two batch axes.
    one = jax.tree.map(lambda x: x[0], (sim, ctrl))
    np.testing.assert_allclose(warp.step(*one)[0].qpos, ours.qpos[0], rtol=0, atol=1e-6)
    twice = jax.tree.map(lambda x: x.reshape(2, n // 2, *x.shape[1:]), (sim, ctrl))
    after, _ = jax.vmap(jax.vmap(warp.step))(*twice)
    np.testing.assert_allclose(after.qpos.reshape(n, -1), ours.qpos, rtol=0, atol=1e-6)
    assert jnp.isfinite(after.qvel).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nero_lift", "nero_lift_obstacles"])
def test_the_engines_own_solver_steps_alike(name):
    """``sim.solver`` chooses who solves, not what comes of it: objects that lie, are let fall or thrown, arms that lean on boxes.

    On the GPU where there is one, else on the CPU.
    """
    from mjx_nero.sim.physics.warp.mujoco_warp import WarpPhysics

    n = 8
    env = make(name, impl="native", num_envs=n)
    step = jax.jit(jax.vmap(env.step))
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), n))
    fields = tuple(state.pipeline_state.fields)
    solvers = ("newton", "mujoco_warp")
    cfgs = {solver: dataclasses.replace(env.cfg.sim, solver=solver, iterations=50) for solver in solvers}
    steps = {solver: jax.jit(jax.vmap(WarpPhysics(env.physics_model, cfg, fields).step)) for solver, cfg in cfgs.items()}
    targets, moved = jax.jit(jax.vmap(env.targets)), 0.0
    for t, key in enumerate(jax.random.split(jax.random.PRNGKey(1), 40)):
        action = jax.random.normal(key, (n, env.action_size))
        if t % 13 == 12:
            sim, ctrl = state.pipeline_state, targets(state, action)
            (ours, lost), (theirs, _) = (steps[solver](sim, ctrl) for solver in solvers)
            assert not lost.any()
            np.testing.assert_allclose(ours.qpos, theirs.qpos, rtol=0, atol=2e-5)
            np.testing.assert_allclose(ours.qvel, theirs.qvel, rtol=0, atol=2e-3)
            for reading, value in ours.readings.items():
                np.testing.assert_allclose(value, theirs.readings[reading], rtol=1e-2, atol=0.05)
            moved = max(moved, float(jnp.abs(ours.qpos - sim.qpos).max()))
        state = step(state, action)
    assert moved > 1e-2


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "darwin", reason="Warp has no CUDA compiler there")
@pytest.mark.parametrize("arch", [75, 90])  # the oldest that Warp supports, where some instructions are missing, and an H100
@pytest.mark.parametrize("name", ["nero_lift", "cobotta_stack", "nero_clutter"])
def test_kernels_compile_for_gpus_and_keep_arrays_in_registers(name, arch, tmp_path, monkeypatch):
    from mjx_nero.sim.physics.warp import contact_rows, dynamics, engine, newton

    env, kernels = make(name, impl="native", num_envs=1), []
    model, sim = env.physics_model, env.cfg.sim
    warp_model = engine.put_model(model)
    data = engine.make_data(model, 1, naconmax=sim.contacts_per_env, njmax=sim.constraints_per_env)
    rows = contact_rows.make(model, warp_model, data)
    steps = newton.make(warp_model, data), rows, *dynamics.make(model, warp_model, data)
    with monkeypatch.context() as patched:
        patched.setattr(engine, "make_constraint", lambda *_: None)
        patched.setattr(wp, "launch", lambda kernel, **_: kernels.append(kernel))
        for step in steps:
            step()
    assert len(kernels) == 4 + warp_model.is_sparse
    for kernel in kernels:
        (path,) = wp.compile_aot_module(kernel.module, arch=arch, module_dir=tmp_path, use_ptx=True)
        text = path.read_bytes()
        assert b".entry" in text
        if kernel not in kernels[-2:]:  # an array in a thread's own memory would be slow
            assert b".local .align" not in text


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in registry.list_envs() if registry.robot_of(name)])
def test_no_environment_of_the_package_is_too_large(name):
    from mjx_nero.sim.physics.warp import newton

    env = make(name, impl="native", num_envs=1)
    nv = env.physics_model.nv
    assert newton.floats(nv, env.cfg.sim.constraints_per_env, dense=nv <= 32)
