"""Quaternion helpers against values worked out by hand."""

import jax.numpy as jnp
import jaxtyping
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


def test_annotations_are_checked_at_run_time():
    """The suite's import hook is in force: a wrong shape is an error."""
    with pytest.raises(jaxtyping.TypeCheckError, match="quat"):
        math.rotate(jnp.zeros(3), jnp.zeros(3))
