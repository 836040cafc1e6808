"""The way over obstacles by hand, and experts that go it without a touch."""

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero.control.detour import Way

STILL = jnp.zeros(0)  # no arm
UP = Way.through(STILL, *(jnp.array(p, jnp.float32) for p in ([0, 0, 0], [0, 0, 0.1], [0.4, 0, 0.1], [0.4, 0, 0.05])))


@pytest.mark.parametrize(
    ("travelled", "at"),
    [
        (0.0, [0, 0, 0]),
        (0.06, [0, 0, 0.06]),
        (0.1, [0, 0, 0.1]),
        (0.3, [0.2, 0, 0.1]),
        (0.52, [0.4, 0, 0.08]),
        (0.6, [0.4, 0, 0.05]),
    ],
)
def test_a_target_goes_from_corner_to_corner(travelled, at):
    assert float(UP.length) == pytest.approx(0.55)
    np.testing.assert_allclose(UP.on(travelled).target(), at, atol=1e-6)
    assert float(UP.on(0.6).travelled) == pytest.approx(0.55)


def test_a_leg_without_length_is_passed_over():
    way = Way.through(STILL, *(jnp.array(p, jnp.float32) for p in ([0, 0, 0.1], [0, 0, 0.1], [0.4, 0, 0.1], [0.4, 0, 0])))
    np.testing.assert_allclose(way.on(0.1).target(), [0.1, 0, 0.1], atol=1e-6)
