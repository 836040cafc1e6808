"""An arm's set-point: how its joints share a way."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero.control import setpoint

SPEED, DT = jnp.array([1.0, 2.0]), 0.02


def way(straight: bool) -> np.ndarray:
    """Set-points of two joints on their way from 0 to 1 and to 0.25 rad."""

    def step(state, _):
        state = setpoint.follow(*state, jnp.array([1.0, 0.25]), SPEED, DT, straight=straight)
        return state, state[0]

    rest = jnp.zeros(2)
    return np.asarray(jax.jit(lambda: jax.lax.scan(step, (rest, rest), None, length=200)[1])())


def test_joints_that_go_straight_are_on_their_way_for_as_long():
    """Halfway of one, the other is halfway; if each hurries by itself, the one with a quarter to go is nearly there."""
    straight, apart = way(True), way(False)
    halves = [float(np.interp(0.5, q[:, 0], q[:, 1])) for q in (straight, apart)]
    assert halves[0] == pytest.approx(0.125, abs=0.04) and halves[1] > 0.2


@pytest.mark.parametrize("straight", [False, True])
def test_it_comes_to_rest_at_the_target_within_its_limits(straight):
    q = way(straight)
    np.testing.assert_allclose(q[-1], [1.0, 0.25], atol=1e-3)
    speeds = np.diff(q, axis=0) / DT
    assert (np.abs(speeds) <= np.asarray(SPEED) + 1e-4).all() and q[:, 0].max() < 1.001
