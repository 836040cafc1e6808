"""How late an arm is, found while it moves."""

import numpy as np
import pytest

from mjx_nero.deploy.lateness import MOST, Lateness

TIMES = np.arange(200) * 0.02


def found(late, noise=0.0, sag=0.0, amplitude=0.3):
    """Readings that follow commands so many steps later; the third joint is a gripper's, which something blocks."""
    rng, lateness = np.random.default_rng(0), Lateness(np.array([True, True, False]))
    told = np.stack([np.sin(3 * TIMES), np.cos(2 * TIMES), np.sign(np.sin(5 * TIMES))], axis=1) * amplitude
    for k in range(len(told)):
        read = told[max(k - late, 0)] + sag + rng.normal(0, noise, 3)
        read[2] = 0.1
        lateness(read, told[k])
    return lateness.steps


@pytest.mark.parametrize("late", range(MOST + 1))
def test_whole_steps_are_found_through_noise_and_sag(late):
    assert found(late, noise=1.5e-3, sag=0.05) == late


def test_an_arm_that_hardly_moves_tells_nothing():
    assert found(4, noise=1.5e-3, amplitude=0.003) == 0
