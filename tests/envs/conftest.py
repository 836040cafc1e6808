"""What the tests of tasks share."""

import jax
import pytest


@pytest.fixture(scope="module")
def functions(env):
    """``reset`` and ``finish`` of the module's environment, compiled once."""
    return jax.jit(env.reset), jax.jit(env.finish)
