"""The physics of the scene, on MJX and in MuJoCo's C library."""

import concurrent.futures
import dataclasses
import os
import subprocess
import sys
import time
import types

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import make
from mjx_nero.sim import physics
from mjx_nero.sim.physics.mjx import JaxPhysics
from mjx_nero.sim.physics.native import NativePhysics

CUBE = slice(9, 12)


@pytest.fixture(scope="session")
def native(env):
    """(sim, ctrl) -> sim."""
    step = jax.jit(env.physics.step)
    return lambda sim, ctrl: step(sim, jnp.asarray(ctrl))[0]


@pytest.fixture(scope="session")
def targets(env):
    return jax.jit(jax.vmap(env.targets))


def played(step, targets, state, actions):
    """The physics states of steps with ``actions`` [steps, 8, 8], the start before them."""
    sims = [state.pipeline_state]
    for action in actions:
        ctrl = targets(state.replace(pipeline_state=sims[-1]), action)
        sims.append(step(sims[-1], ctrl))
    return jax.tree.map(lambda *x: np.stack(x), *sims)


@pytest.fixture(scope="session")
def reach(batch, mjx_step, targets):
    """Three seconds of going to, then standing at, eight poses near home, the cubes lying on the table."""
    actions = jax.random.uniform(jax.random.PRNGKey(0), (8, 8), minval=-0.6, maxval=0.6)
    actions = actions.at[:, 1].set(-0.4).at[:, 3].set(-jnp.abs(actions[:, 3]))  # up, and away from joint4's limit
    return actions, played(mjx_step, targets, batch.reset(0), [actions] * 150)


@pytest.mark.parametrize("gripper", [1.0, -1.0])
def test_mjx_and_c_agree_without_contacts(batch, native, mjx_step, targets, gripper):
    """Single against double precision: arm and falling cube stay within 5e-6 (rad, m) for 0.4 s.

    The fingers agree to 0.1 mm at their limits, and once closed. In between they differ by up to 4 mm: the closing force
    saturates, and MJX's implicit integrator damps also with the force that the clamp cuts off, MuJoCo's does not.
    """
    state = batch.reset(1)
    sim = state.pipeline_state
    spin = jnp.array([0.1, -0.2, 0.0, 3.0, -2.0, 1.0])
    sim = sim.replace(qpos=sim.qpos.at[:, CUBE].add(jnp.array([0.0, 0.0, 2.0])), qvel=sim.qvel.at[:, 9:].set(spin))
    actions = jax.random.normal(jax.random.PRNGKey(0), (8, 8)).at[:, 7].set(gripper)
    mjx = played(mjx_step, targets, state.replace(pipeline_state=sim), [actions] * 20)
    rest = np.array([0, 1, 2, 3, 4, 5, 6, *range(9, 16)])
    for t in range(20):
        sim = native(sim, mjx.ctrl[t + 1])
        np.testing.assert_allclose(mjx.qpos[t + 1][:, rest], sim.qpos[:, rest], rtol=0, atol=5e-6)
        np.testing.assert_allclose(mjx.qvel[t + 1][:, rest[:-1]], sim.qvel[:, rest[:-1]], rtol=0, atol=5e-4)
        np.testing.assert_allclose(mjx.time[t + 1], sim.time, rtol=0, atol=1e-6)
        if gripper > 0 or t >= 10:
            np.testing.assert_allclose(mjx.qpos[t + 1][:, 7:9], sim.qpos[:, 7:9], rtol=0, atol=1e-4)
    assert np.abs(mjx.qpos[-1, :, :7] - mjx.qpos[0, :, :7]).max() > 0.1  # they did move
    np.testing.assert_allclose(mjx.qpos[-1, :, 11] - mjx.qpos[0, :, 11], -9.81 * 0.4**2 / 2, atol=0.03)


def robot_touches(model, qpos) -> bool:
    """Whether anything but the cube on the table meets, within the contacts' margin."""
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    return any({model.geom(g).name for g in pair} != {"table", "cube"} for pair in data.contact.geom)


@pytest.mark.slow
def test_an_episode_agrees_until_the_robot_touches_something(env, batch, native, mjx_step, targets):
    """MJX-JAX beside MuJoCo's C library for whole episodes of the same random actions.

    Arms stay within 0.1 mrad (2e-5 measured), fingers within 5 mm (see above), a cube within 1 mm while it sinks into the
    table's soft contact and within 0.1 mm from then on.
    """
    state = batch.reset(2)
    steps = jax.random.normal(jax.random.PRNGKey(3), (25, 8, 8))
    actions = jnp.repeat(steps, 10, axis=0)  # ten steps each, which takes the arms some way
    mjx, c = (played(step, targets, state, actions) for step in (mjx_step, native))
    compared = 0
    for i in range(8):
        touch = next((t for t in range(251) if robot_touches(env.physics_model, c.qpos[t, i])), 251)
        compared += touch
        for part, atol in ((slice(0, 7), 1e-4), (slice(7, 9), 5e-3), (CUBE, 1e-3)):
            np.testing.assert_allclose(mjx.qpos[:touch, i, part], c.qpos[:touch, i, part], rtol=0, atol=atol)
        np.testing.assert_allclose(mjx.qpos[50:touch, i, CUBE], c.qpos[50:touch, i, CUBE], rtol=0, atol=1e-4)
    assert compared > 1000 and np.ptp(c.qpos[:, :, :7], axis=0).max() > 0.3


@pytest.mark.slow
def test_saturated_drives_agree_where_nothing_touches():
    """Steps of 0.15 rad push the arm's drives to their limits, where MJX-JAX by itself would go on damping: 12 mrad apart."""
    env = make("nero_reach", impl="native")
    start = jax.jit(jax.vmap(lambda key: env.sample(key)[0]))(jax.random.split(jax.random.PRNGKey(0), 4))
    mjx_step = jax.jit(jax.vmap(JaxPhysics(env.physics_model, env.cfg.sim).step))
    home = start.ctrl.at[:, 3].set(1.5)
    mjx = sim = start.replace(qpos=start.qpos.at[:, 3].set(1.5))  # away from joint4's limit
    for t in range(10):
        ctrl = home.at[:, :7].add(0.15 if t < 5 else -0.15)
        (mjx, _), (sim, _) = mjx_step(mjx, ctrl), env.physics.step(sim, ctrl)
        np.testing.assert_allclose(mjx.qpos, sim.qpos, rtol=0, atol=1e-3)
    assert np.abs(mjx.qpos[:, 0] - home[:, 0]).min() > 0.02


def pushed(env, n):
    """States of resting arms over cubes on the table, and drive targets that differ."""
    sim = jax.jit(jax.vmap(lambda key: env.sample(key)[0]))(jax.random.split(jax.random.PRNGKey(0), n))
    return sim, sim.ctrl.at[:, :7].add(jnp.linspace(-0.02, 0.02, n)[:, None])


def test_native_step_is_mujocos_own(env, native):
    """Batches on threads give what plain calls of ``mj_step`` give, all of them."""
    sim, ctrl = pushed(env, 40)
    after = native(sim, ctrl)
    for i in range(40):
        data = mujoco.MjData(env.physics_model)
        data.qpos[:], data.ctrl[:] = sim.qpos[i], ctrl[i]
        for _ in range(env.cfg.sim.decimation):
            mujoco.mj_step(env.physics_model, data)
        np.testing.assert_allclose(after.qpos[i], data.qpos, rtol=0, atol=1e-6)
        np.testing.assert_allclose(after.qvel[i], data.qvel, rtol=0, atol=1e-5)
        assert float(after.time[i]) == pytest.approx(0.02)


def test_targets_go_evenly_within_a_control_step(env):
    """With ``ramp`` the second of two physics steps has the new targets, and the first half of the way to them."""
    sim, ctrl = pushed(env, 3)
    ramped = NativePhysics(env.physics_model, dataclasses.replace(env.cfg.sim, ramp=True))
    after = jax.jit(ramped.step)(sim, ctrl)[0]
    np.testing.assert_array_equal(after.ctrl, ctrl)
    for i in range(3):
        data = mujoco.MjData(env.physics_model)
        data.qpos[:] = sim.qpos[i]
        for share in (0.5, 1.0):
            data.ctrl[:] = sim.ctrl[i] + share * (ctrl[i] - sim.ctrl[i])
            mujoco.mj_step(env.physics_model, data)
        np.testing.assert_allclose(after.qpos[i], data.qpos, rtol=0, atol=1e-6)
        np.testing.assert_allclose(after.qvel[i], data.qvel, rtol=0, atol=1e-5)


def test_native_takes_any_batch(env):
    """Leading axes, vmaps in vmaps, one environment alone, eagerly or compiled: the same numbers, to the last bit."""
    sim, ctrl = pushed(env, 6)
    step = env.physics.step
    after, lost = step(sim, ctrl)
    assert lost.shape == (6,) and not lost.any()

    def grid(x):
        return x.reshape(2, 3, *x.shape[1:])

    singles = [jax.tree.map(lambda x, i=i: x[i], (sim, ctrl)) for i in range(6)]
    ways = {
        "vmapped": jax.vmap(step)(sim, ctrl)[0],
        "compiled": jax.jit(step)(sim, ctrl)[0],
        "two axes": jax.tree.map(lambda x: x.reshape(6, *x.shape[2:]), step(jax.tree.map(grid, sim), grid(ctrl))[0]),
        "nested": jax.tree.map(
            lambda x: x.reshape(6, *x.shape[2:]), jax.jit(jax.vmap(jax.vmap(step)))(jax.tree.map(grid, sim), grid(ctrl))[0]
        ),
        "looped": jax.lax.map(lambda x: step(*x)[0], (sim, ctrl)),
        "alone": jax.tree.map(lambda *x: jnp.stack(x), *[step(*one)[0] for one in singles]),
    }
    for name, other in ways.items():
        jax.tree.map(lambda a, b, name=name: np.testing.assert_array_equal(a, b, name), after, other)
    # One target for all of a batch.
    jax.tree.map(np.testing.assert_array_equal, jax.vmap(step, (0, None))(sim, ctrl[0]), step(sim, jnp.tile(ctrl[:1], (6, 1))))


ONE_PROCESSOR = """
import os
os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
from mjx_nero import env_cfg
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.learn.play import rollout
import jax

env = ManipulationEnv(env_cfg("nero_lift", "sim2real"), impl="native", num_envs=64)
play = rollout.runner(env, lambda params, obs, key: jax.random.uniform(key, (64, env.action_size), minval=-1), 64)
print([len(play(None, seed).returns) for seed in range(8)])
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "sched_setaffinity"), reason="only Linux ties a process to one processor")
def test_on_one_processor_physics_does_not_wait_for_itself():
    found = subprocess.run([sys.executable, "-c", ONE_PROCESSOR], capture_output=True, text=True, timeout=400)
    assert found.stdout == f"{[64] * 8}\n", found.stderr[-2000:]


def test_native_is_a_function_of_the_state(env):
    """Steps before do not show: what a thread's data keep from them must not matter to the next."""
    step = jax.jit(env.physics.step)
    sim, ctrl = pushed(env, 16)
    first = step(sim, ctrl)
    for _ in range(3):
        sim_later = step(first[0], ctrl + 0.01)[0]
    jax.tree.map(np.testing.assert_array_equal, step(sim, ctrl), first)
    assert (sim_later.qpos != first[0].qpos).any()


@pytest.mark.parametrize("decimation", [1, 2])
def test_where_mujoco_gives_up_the_state_is_nan_and_the_neighbours_go_on(tmp_path, monkeypatch, capfd, decimation):
    monkeypatch.chdir(tmp_path)
    env = make("nero_lift", impl="native", **{"sim.decimation": decimation})
    sim, ctrl = pushed(env, 8)
    good, _ = env.physics.step(sim, ctrl)
    sick = sim.replace(
        qpos=sim.qpos.at[1, 2].set(jnp.nan),
        qvel=sim.qvel.at[3, 0].set(jnp.inf).at[4, 9].set(1e20).at[6, 0].set(3e9),
    )
    after, _ = jax.jit(jax.vmap(env.physics.step))(sick, ctrl)
    bad = np.array([1, 3, 4, 6])
    assert np.isnan(after.qpos[bad]).all() and np.isnan(after.qvel[bad]).all()
    well = np.setdiff1d(np.arange(8), bad)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[well], b[well]), after, good)
    assert not list(tmp_path.iterdir()) and capfd.readouterr() == ("", "")  # MuJoCo would write MUJOCO_LOG.TXT and to stderr
    assert mujoco.get_mju_user_warning() is None


def test_a_diverged_environment_starts_anew_and_its_neighbours_go_on(batch):
    state = batch.reset(0)
    actions = jnp.zeros((8, 8))
    well = batch.step(state, actions)
    sick = state.replace(pipeline_state=state.pipeline_state.replace(qvel=state.pipeline_state.qvel.at[2, 1].set(1e30)))
    after = batch.step(sick, actions)
    np.testing.assert_array_equal(after.metrics["nan"], np.arange(8) == 2)
    np.testing.assert_array_equal(after.done, np.arange(8) == 2)
    assert int(after.info["carry"].step[2]) == 0 and not after.pipeline_state.qvel[2].any()  # a fresh episode
    others = np.delete(np.arange(8), 2)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a[others], b[others]), after, well)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves((after.obs, after.reward, after.pipeline_state, after.metrics)))


def test_auto_is_native_without_a_gpu():
    chosen = make("nero_lift")
    if jax.default_backend() == "cpu":
        assert chosen.impl == physics.resolve_impl("auto") == "native" and isinstance(chosen.physics, NativePhysics)
    else:
        assert chosen.impl in ("warp", "jax")


def test_the_robot_never_touches_itself(env):
    model, data = env.physics_model, mujoco.MjData(env.physics_model)
    low, high = model.jnt_range[:9].T
    touched = set()
    for qpos in np.random.default_rng(0).uniform(low, high, (2000, 9)):
        data.qpos[:9] = qpos
        mujoco.mj_forward(model, data)
        touched |= {frozenset(model.geom(g).name for g in pair) for pair in data.contact.geom}
    assert touched and all(pair & {"table", "cube"} for pair in touched)
    assert {frozenset(("table", "palm")), frozenset(("table", "tip1"))} <= touched  # the test sees contacts where there are any


def drift(qpos) -> tuple[float, float]:
    """Most that any cube has moved [m] and turned [rad]."""
    moved = np.linalg.norm(np.asarray(qpos)[:, :, 9:11] - np.asarray(qpos)[:1, :, 9:11], axis=-1)
    return moved.max(), 2 * np.linalg.norm(np.asarray(qpos)[:, :, 13:], axis=-1).max()


def test_a_cube_at_rest_stays(env, native, reach):
    """For three seconds. In single precision it turns and creeps a little while it settles."""
    _, sims = reach
    moved, turned = drift(sims.qpos)
    assert moved < 5e-4 and turned < 0.03
    sunk = 0.015 - sims.qpos[:, :, 11]
    assert 0 < sunk[1:].min() and sunk.max() < 1e-3 and sunk[-1].max() < 2e-4  # by the softness of the contact
    assert np.abs(sims.qpos[-1, :, 11] - sims.qpos[-50, :, 11]).max() < 1e-6

    sim, frames = jax.tree.map(lambda x: x[0], sims), []
    for t in range(150):
        frames.append(np.asarray(sim.qpos))
        sim = native(sim, sims.ctrl[t + 1])
    moved, turned = drift(np.stack(frames))
    assert moved < 1e-5 and turned < 1e-3


def test_the_arm_reaches_its_targets_but_for_the_sag(env, reach):
    """A drive without integral part lags by the load over its stiffness: gravity alone once the arm stands still."""
    actions, sims = reach
    arm = env.cfg.robot.arm
    target = np.array(arm.home) + 0.5 * np.asarray(actions[:, :7])
    np.testing.assert_allclose(sims.ctrl[-1, :, :7], target, atol=1e-6)
    data = mujoco.MjData(env.physics_model)
    for i in range(8):
        data.qpos[:] = sims.qpos[-1, i]
        mujoco.mj_forward(env.physics_model, data)
        sag = data.qfrc_bias[:7] / np.array(arm.stiffness)
        np.testing.assert_allclose(target[i] - sims.qpos[-1, i, :7], sag, atol=2e-3)
        assert np.abs(sag).max() < 0.15
    assert np.abs(sims.qvel[-1, :, :7]).max() < 0.02


def test_joints_keep_to_the_speed_limit(reach):
    """Only the target is limited; the damped joint follows it without overtaking it."""
    _, sims = reach
    assert np.abs(np.diff(sims.ctrl, axis=0)).max() <= 0.03 + 1e-6
    assert 0.2 < np.abs(sims.qvel[:, :, :7]).max() < 1.5
    assert np.abs(sims.qvel[:, :, 7:9]).max() < 1.5


def test_fingers_open_and_close_fully(env, native):
    sim = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 1)).pipeline_state
    for fingers in ([0.0, -0.001], [0.05, -0.05]):
        ctrl = np.array(sim.ctrl)
        ctrl[:, 7:] = fingers
        for _ in range(50):
            sim = native(sim, ctrl)
        np.testing.assert_allclose(sim.qpos[0, 7:9], fingers, atol=1e-3)


def test_only_mjx_jax_does_without_the_fusion(monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_use_fusion_emitters=false")  # as the package sets it for an old JAX
    nero = {impl: make("nero_reach", impl=impl).physics for impl in ("native", "jax")}
    assert nero["native"].compiler_options == physics.fusion() == {"xla_cpu_use_fusion_emitters": True}
    assert nero["jax"].compiler_options == {}
    monkeypatch.delenv("XLA_FLAGS")
    assert nero["native"].compiler_options == {}


def test_backend_is_made_when_first_stepped():
    env = make("nero_lift", impl="jax")
    jax.jit(env.reset)(jax.random.PRNGKey(0))
    assert "physics" not in vars(env)
    assert isinstance(env.physics, JaxPhysics) and env.physics is env.physics


def test_warp_physics_is_made_without_a_change_of_device(env, monkeypatch):
    """Warp's device is the process's: another thread may be loading kernels, which a change would send to the wrong one."""
    warp, mujoco_warp = pytest.importorskip("warp"), pytest.importorskip("mjx_nero.sim.physics.warp.mujoco_warp")

    def refuse(device):
        raise AssertionError(f"changed to {device}")

    monkeypatch.setattr(warp, "ScopedDevice", refuse)
    mujoco_warp.WarpPhysics(env.physics_model, env.cfg.sim)


def test_nothing_of_warp_is_loaded_while_jax_traces(env, monkeypatch):
    """Another thread may be adding kernels to the module that would be loaded."""
    warp, mujoco_warp = pytest.importorskip("warp"), pytest.importorskip("mjx_nero.sim.physics.warp.mujoco_warp")
    made, loads = mujoco_warp.WarpPhysics(env.physics_model, env.cfg.sim), []
    sim = jax.eval_shape(env.reset, jax.random.PRNGKey(0)).pipeline_state
    monkeypatch.setattr(warp.Module, "load", lambda module, *args: loads.append(module.name))
    text = jax.jit(made.step).lower(sim, sim.ctrl).as_text()
    assert "custom_call" in text and not loads


def test_warp_memory_of_a_second_environment_waits_for_no_kernels(env):
    """An evaluation's, while its training's kernels load, which takes seconds."""
    pytest.importorskip("warp"), pytest.importorskip("mjx_nero.sim.physics.warp.mujoco_warp")
    from mjx_nero.sim.physics.warp import kernels, mujoco_warp

    first, second = (mujoco_warp.WarpPhysics(env.physics_model, env.cfg.sim) for _ in range(2))
    need = first.footprint().outside
    with kernels.WARP, concurrent.futures.ThreadPoolExecutor() as pool:
        assert pool.submit(lambda: second.footprint().outside).result(timeout=20) == need > 1000
    more = dataclasses.replace(env.cfg.sim, contacts_per_env=2 * env.cfg.sim.contacts_per_env)
    assert mujoco_warp.WarpPhysics(env.physics_model, more).footprint().outside > need


def test_warp_memory_is_measured_once_and_only_when_it_is_asked_for(env, monkeypatch):
    """MuJoCo Warp takes a second to import, and a training's kernels hold what measures for longer."""
    mujoco_warp = pytest.importorskip("mjx_nero.sim.physics.warp.mujoco_warp")
    measured: list[int] = []

    def measure(*_):
        time.sleep(0.2)
        measured.append(7000)
        return 7000

    monkeypatch.setattr(mujoco_warp, "_BYTES", {})
    monkeypatch.setattr(mujoco_warp, "_data_bytes", measure)
    made = [mujoco_warp.WarpPhysics(env.physics_model, env.cfg.sim) for _ in range(2)]
    assert [one.footprint().in_program for one in made] == [0.0, 0.0] and not measured
    with concurrent.futures.ThreadPoolExecutor() as pool:
        assert list(pool.map(lambda one: one.footprint().outside, made)) == [7000, 7000] and measured == [7000]


def test_warp_memory_is_that_of_this_process_devices(env, monkeypatch):
    """A run of four devices on two machines: two are here."""
    warp, mujoco_warp = pytest.importorskip("warp"), pytest.importorskip("mjx_nero.sim.physics.warp.mujoco_warp")
    made = mujoco_warp.WarpPhysics(env.physics_model, env.cfg.sim)
    assert made.footprint().outside  # makes what it counts, before devices are not what they are
    monkeypatch.setattr(warp, "get_cuda_devices", lambda: [types.SimpleNamespace(free_memory=free) for free in (5e9, 3e9, 1e9)])
    assert made.footprint(2).free == 3e9 and made.footprint(4).free == 1e9 and made.footprint().outside > 1000


@pytest.mark.gpu
@pytest.mark.parametrize("ramp", [False, True])
def test_warp_and_c_agree_without_contacts(ramp):
    env = make("nero_lift", impl="warp", num_envs=8, **{"sim.ramp": ramp})
    native = jax.jit(NativePhysics(env.physics_model, env.cfg.sim).step)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(1), 8))
    sim = state.pipeline_state
    sim = sim.replace(qpos=sim.qpos.at[:, CUBE].add(jnp.array([0.0, 0.0, 2.0])))
    step = jax.jit(jax.vmap(env.physics.step))
    reference, ctrl = sim, sim.ctrl.at[:, :7].add(0.02)
    for _ in range(20):
        sim, lost = step(sim, ctrl)
        reference, _ = native(reference, ctrl)
        assert not lost.any()
        np.testing.assert_allclose(sim.qpos, reference.qpos, rtol=0, atol=1e-4)
        np.testing.assert_allclose(sim.qvel, reference.qvel, rtol=0, atol=2e-3)


def test_the_c_library_reads_no_clock():
    """Its timers, which take a twentieth of a step, stay at zero."""
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert data.timer[mujoco.mjtTimer.mjTIMER_STEP].number == 1 and data.timer[mujoco.mjtTimer.mjTIMER_STEP].duration == 0
