"""Sensors and pushes, on a view made by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from views import blank

from mjx_nero.mdp import actions, pushes, sensors
from mjx_nero.types import FixtureView, ObjectView

ZERO, UP = jnp.zeros(3), jnp.array([1.0, 0.0, 0.0, 0.0])
KEYS = jax.random.split(jax.random.PRNGKey(0), 500)


def view(x=0.4, time=0.0, bias=None):
    cube = ObjectView(pos_w=jnp.array([x, 0.0, 0.1]), quat_w=UP, linvel_w=ZERO, angvel_local=ZERO)
    joints = dict.fromkeys(("joint_pos", "joint_vel", "default_joint_pos", "ctrl"), jnp.array([0.5, -0.5]))
    root = jnp.array([0.1, 0.0, 0.0])
    return blank(**joints, objects={"cube": cube}, root_pos_w=root, time=jnp.asarray(time), encoder_bias=bias, max_steps=100)


def seen(sensor, views, keys=KEYS):
    def episode(key):
        memory, out = sensor.init(key, views[0]), []
        for one in views:
            memory, there = sensor.step(memory, one)
            out.append(there.objects["cube"].pos_w)
        return jnp.stack(out)

    return np.asarray(jax.vmap(episode)(keys))


def test_an_offset_stays_for_an_episode_and_noise_does_not():
    pos = seen(sensors.ObjectPosition(offset=0.01), [view(), view(0.5)])
    off = pos - [[0.4, 0.0, 0.1], [0.5, 0.0, 0.1]]
    np.testing.assert_allclose(off[:, 0], off[:, 1], atol=1e-6)
    assert 0.0095 < np.abs(off).max() <= 0.01 + 1e-6 and np.abs(off.mean(axis=(0, 1))).max() < 1e-3
    noise = seen(sensors.ObjectPosition(noise=0.01), [view(), view()]) - [0.4, 0.0, 0.1]
    assert 0.0095 < np.abs(noise).max() <= 0.01 + 1e-6
    assert abs(np.corrcoef(noise[:, 0, 0], noise[:, 1, 0])[0, 1]) < 0.15


def test_an_object_is_seen_late():
    places = [view(x) for x in (0.1, 0.2, 0.3, 0.4)]
    np.testing.assert_allclose(seen(sensors.ObjectPosition(delay=(2, 2)), places)[0, :, 0], [0.1, 0.1, 0.1, 0.2], atol=1e-6)
    late = seen(sensors.ObjectPosition(delay=(0, 2)), places)[:, 3, 0]
    assert {round(float(x), 1) for x in late} == {0.2, 0.3, 0.4}


def test_a_base_elsewhere_moves_all_objects_about_it():
    """0.3 m before the base, a turn of 0.1 rad moves an object by 0.3 sin 0.1 = 0.02995 m to the side."""
    pos = seen(sensors.BasePose(turn=0.1), [view()])[:, 0]
    np.testing.assert_allclose(np.hypot(pos[:, 0] - 0.1, pos[:, 1]), 0.3, atol=1e-6)
    assert 0.029 < np.abs(pos[:, 1]).max() <= 0.02995 + 1e-5
    moved = seen(sensors.BasePose(offset=0.02), [view(), view()]) - [0.4, 0.0, 0.1]
    assert 0.019 < np.abs(moved).max() <= 0.02 + 1e-6
    np.testing.assert_array_equal(moved[:, 0], moved[:, 1])


def test_a_base_elsewhere_moves_fixtures_with_their_handles():
    one = {"door": jnp.zeros(())}
    fixture = FixtureView(jnp.array([1.1, 0.0, 0.0]), UP, one, one, {}, {"bar": jnp.array([1.1, 0.2, 0.3])}, {"bar": UP})
    moved = view().replace(fixtures={"door": fixture})
    sensor = sensors.BasePose(offset=0.0, turn=0.5)
    memory = jnp.array([0.0, 0.0, 0.1]), jnp.array(np.pi / 2)  # a quarter about the base at (0.1, 0), and 10 cm up
    there = sensor.step(memory, moved)[1].fixtures["door"]
    np.testing.assert_allclose(there.pos_w, [0.1, 1.0, 0.1], atol=1e-6)
    np.testing.assert_allclose(there.site_pos_w["bar"], [-0.1, 1.0, 0.4], atol=1e-6)
    np.testing.assert_allclose(there.site_quat_w["bar"], [0.5**0.5, 0, 0, 0.5**0.5], atol=1e-6)


def test_a_force_sensor_is_off_noisy_and_late():
    """10 N for two steps, then 20: off by at most 2 N and a tenth, the same all episode long; noise changes; one step late."""

    def told(sensor, key):
        memory, out = sensor.init(key, felt[0]), []
        for one in felt:
            memory, there = sensor.step(memory, one)
            out.append(there.readings["wrist"])
        return jnp.stack(out)

    felt = [view().replace(readings={"wrist": jnp.full(6, force)}) for force in (10.0, 10.0, 20.0)]
    off = np.array(jax.vmap(lambda key: told(sensors.Gauge(offset=(2.0,)), key))(KEYS)) - [[10.0], [10.0], [20.0]]
    np.testing.assert_allclose(off[:, 0], off[:, 2], atol=1e-5)
    assert 1.95 < np.abs(off).max() <= 2.0 + 1e-5 and np.ptp(off[0, 0]) > 0.1
    scaled = np.array(jax.vmap(lambda key: told(sensors.Gauge(scale=0.1), key))(KEYS))
    np.testing.assert_allclose(scaled[:, 2], 2 * scaled[:, 0], rtol=1e-5)
    assert 8.99 < scaled[:, 0].min() < 9.05 and 10.95 < scaled[:, 0].max() < 11.01
    np.testing.assert_allclose(told(sensors.Gauge(delay=(1, 1)), KEYS[0])[:, 0], [10, 10, 10])
    noise = np.array(told(sensors.Gauge(noise=(0.0, 0.0, 0.5, 0.0, 0.0, 0.0)), KEYS[0])) - [[10.0], [10.0], [20.0]]
    assert not noise[:, [0, 1, 3, 4, 5]].any() and len(set(noise[:, 2].tolist())) == 3 and np.abs(noise).max() <= 0.5


def test_encoders_read_beside_the_joints():
    _, there = sensors.Encoders().step((), view(bias=jnp.array([0.01, -0.02])))
    np.testing.assert_allclose(there.joint_pos, [0.51, -0.52])
    one = view()
    assert sensors.Encoders().step((), one)[1] is one


def test_pushes_come_in_their_interval_and_not_between():
    push = pushes.Push(speed=0.5, interval=(0.1, 0.2))
    times = np.arange(0.0, 1.0, 0.02)

    def episode(key):
        memory, out = push.init(key, view()), []
        for time in times:
            memory, speed = push.step(memory, view(time=time))
            out.append(speed)
        return jnp.stack(out)

    speeds = np.asarray(jax.vmap(episode)(KEYS[:50]))
    for hit in (np.abs(speeds) > 0).any(axis=2):
        at = times[hit]
        assert 0.09 < at[0] < 0.23 and (np.diff(at) > 0.09).all() and (np.diff(at) < 0.23).all()
    assert 0.45 < np.abs(speeds).max() <= 0.5


def test_command_noise_stays_within_its_amount_and_the_joints_ranges():
    high = np.array([1.0, 0.2], np.float32)
    zero = np.zeros(2, np.float32)
    arm = actions.Drives(zero, -high, high, high, zero, zero, zero, dt=0.02)
    none = actions.Drives(*(np.zeros(0, np.float32),) * 7, dt=0.02)
    noise = actions.Noise({"arm": arm, "gripper": none}, amount=0.1)
    act = actions.Act(jnp.zeros(2), {}, {}, {"arm": jnp.array([0.0, 0.2]), "gripper": jnp.zeros(0)})
    off = np.stack([noise.step(noise.init(key, act), jnp.zeros(0), act)[1].targets["arm"] for key in KEYS[:100]])
    assert 0.09 < np.abs(off[:, 0]).max() <= 0.1 and 0.1 <= off[:, 1].min() and off[:, 1].max() == pytest.approx(0.2)
