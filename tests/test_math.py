"""Quaternion helpers against values worked out by hand."""

import jax
import jax.numpy as jnp
import jaxtyping
import mujoco
import numpy as np
import pytest

from mjx_nero import math

H = 0.5**0.5
# Turns by +90 degrees.
X90, Y90, Z90 = (jnp.array(q) for q in ([H, H, 0.0, 0.0], [H, 0.0, H, 0.0], [H, 0.0, 0.0, H]))
I, J, K = (jnp.array(q) for q in ([0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]))


@pytest.mark.parametrize(("a", "b", "product"), [(I, J, K), (J, K, I), (K, I, J), (J, I, -K), (I, I, [-1.0, 0, 0, 0])])
def test_quat_mul_of_units(a, b, product):
    np.testing.assert_array_equal(math.quat_mul(a, b), product)


def test_quat_mul_of_numbers():
    product = math.quat_mul(jnp.array([1.0, 2.0, 3.0, 4.0]), jnp.array([5.0, 6.0, 7.0, 8.0]))
    # w = 5 - 12 - 21 - 32, x = 6 + 10 + 24 - 28, y = 7 - 16 + 15 + 24, z = 8 + 14 - 18 + 20
    np.testing.assert_array_equal(product, [-60.0, 12.0, 30.0, 24.0])


@pytest.mark.parametrize(
    ("quat", "vec", "turned"),
    [
        (X90, [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]),
        (Y90, [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]),
        (Z90, [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
        (Z90, [1.0, 2.0, 3.0], [-2.0, 1.0, 3.0]),
        (K, [1.0, 2.0, 3.0], [-1.0, -2.0, 3.0]),
        (jnp.array([0.5, 0.5, 0.5, 0.5]), [1.0, 2.0, 3.0], [3.0, 1.0, 2.0]),  # 120 degrees about (1, 1, 1)
    ],
)
def test_rotate(quat, vec, turned):
    np.testing.assert_allclose(math.rotate(quat, jnp.array(vec)), turned, atol=1e-6)


@pytest.mark.parametrize(
    ("angles", "vec", "turned"),
    [
        ((np.pi / 2, 0, 0), [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]),
        ((0, np.pi / 2, 0), [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]),  # level, along +x
        ((0, 0, np.pi / 2), [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
        ((np.pi / 2, 0, np.pi / 2), [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]),  # about x first: y -> z, which yaw leaves
        ((np.pi / 2, 0, np.pi / 2), [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]),
        ((np.pi, -np.pi / 6, 0), [0.0, 0.0, 1.0], [0.5, 0.0, -(3**0.5) / 2]),  # down, tilted forward by 30 degrees
    ],
)
def test_quat_from_euler(angles, vec, turned):
    quat = math.quat_from_euler(*(jnp.float32(a) for a in angles))
    np.testing.assert_allclose(math.rotate(quat, jnp.array(vec)), turned, atol=1e-6)


def test_product_turns_by_the_right_factor_first():
    # x -> Z90 -> y -> X90 -> z
    np.testing.assert_allclose(math.rotate(math.quat_mul(X90, Z90), jnp.array([1.0, 0.0, 0.0])), [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize(
    ("axis", "angle", "quat"),
    [
        ([0.0, 0.0, 1.0], np.pi / 2, [H, 0, 0, H]),
        ([1.0, 0.0, 0.0], -np.pi / 2, [H, -H, 0, 0]),
        ([0.0, 0.6, 0.8], np.pi, [0, 0, 0.6, 0.8]),
        ([0.0, 1.0, 0.0], 0.0, [1, 0, 0, 0]),
        ([0.0, 1.0, 0.0], np.pi / 3, [0.8660254, 0, 0.5, 0]),
    ],
)
def test_axis_angle(axis, angle, quat):
    np.testing.assert_allclose(math.axis_angle(jnp.array(axis), jnp.array(angle, jnp.float32)), quat, atol=1e-6)


def test_quat_conj_turns_back():
    np.testing.assert_array_equal(math.quat_conj(jnp.array([1.0, 2.0, 3.0, 4.0])), [1, -2, -3, -4])
    quat = jnp.array([0.5, -0.5, 0.1, 0.7])
    np.testing.assert_allclose(math.quat_mul(quat, math.quat_conj(quat)), [1, 0, 0, 0], atol=1e-6)


@pytest.mark.parametrize(
    ("quat", "vec"),
    [
        ([1.0, 0.0, 0.0, 0.0], [0, 0, 0]),
        ([H, H, 0.0, 0.0], [np.pi / 2, 0, 0]),
        ([H, 0.0, 0.0, -H], [0, 0, -np.pi / 2]),
        ([0.0, 0.0, 0.6, 0.8], [0, 0.6 * np.pi, 0.8 * np.pi]),
        ([0.5, 0.5, 0.5, 0.5], [2 * np.pi / 3 / 3**0.5] * 3),
        ([0.8660254, 0.0, 0.5, 0.0], [0, np.pi / 3, 0]),
        ([np.cos(1e-3), np.sin(1e-3), 0.0, 0.0], [2e-3, 0, 0]),
        ([1.0, 0.0, 1e-6, 0.0], [0, 2e-6, 0]),  # where the series takes over
    ],
)
def test_quat_log_of_known_turns(quat, vec):
    got = math.quat_log(jnp.array(quat))
    np.testing.assert_allclose(got, vec, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(jnp.abs(math.quat_log(-jnp.array(quat))), jnp.abs(got))  # the same rotation


def test_quat_log_takes_the_short_way():
    # 270 degrees about z are -90
    quat = math.axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(1.5 * np.pi, jnp.float32))
    np.testing.assert_allclose(math.quat_log(quat), [0, 0, -np.pi / 2], atol=1e-6)
    quats = np.random.default_rng(0).normal(size=(200, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    assert jnp.linalg.norm(jax.jit(jax.vmap(math.quat_log))(jnp.asarray(quats, jnp.float32)), axis=1).max() <= np.pi + 1e-6


def test_quat_log_undoes_axis_angle():
    rng = np.random.default_rng(1)
    for angle in (1e-5, 1e-4, 1e-3, 0.1, 1.0, 3.0):
        axis = rng.normal(size=3)
        axis /= np.linalg.norm(axis)
        quat = math.axis_angle(jnp.asarray(axis, jnp.float32), jnp.array(angle, jnp.float32))
        np.testing.assert_allclose(math.quat_log(quat), axis * angle, rtol=1e-4, atol=1e-9)


def test_quat_log_is_smooth_at_the_identity():
    derivative = jax.jacobian(math.quat_log)
    for sign in (1.0, -1.0):
        got = derivative(jnp.array([sign, 0.0, 0.0, 0.0]))
        np.testing.assert_allclose(got[:, 1:], 2 * sign * np.eye(3), atol=1e-6)
        assert jnp.isfinite(got).all()
    # The same on both sides of where the series takes over (|v| = 1e-4).
    for v in (0.99e-4, 1.01e-4):
        quat = jnp.array([1.0, v, 0.0, 0.0])
        np.testing.assert_allclose(derivative(quat)[:, 1:], 2 * np.eye(3), atol=1e-3)


def test_rotation_matrix_is_mujocos():
    want, quats = np.empty(9), np.random.default_rng(2).normal(size=(50, 4))
    for quat in quats / np.linalg.norm(quats, axis=1, keepdims=True):
        mujoco.mju_quat2Mat(want, quat)
        got = math.rotation_matrix(jnp.asarray(quat, jnp.float32))
        np.testing.assert_allclose(got, want.reshape(3, 3), atol=1e-6)
        vec = jnp.array([1.0, -2.0, 3.0])
        np.testing.assert_allclose(got @ vec, math.rotate(jnp.asarray(quat, jnp.float32), vec), atol=1e-5)


def test_annotations_are_checked_at_run_time():
    """The suite's import hook is in force: a wrong shape is an error."""
    with pytest.raises(jaxtyping.TypeCheckError, match="quat"):
        math.rotate(jnp.zeros(3), jnp.zeros(3))
