"""Random bits: the reference's known answers, and a kernel of their own."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.random import threefry2x32_p

import mjx_nero.sim.threefry  # noqa: F401

# Key, counters and result, from the known answers of Random123 (``threefry2x32 20``).
KNOWN = [
    ((0, 0), (0, 0), (0x6B200159, 0x99BA4EFE)),
    ((0xFFFFFFFF, 0xFFFFFFFF), (0xFFFFFFFF, 0xFFFFFFFF), (0x1CB996FC, 0xBB002BE7)),
    ((0x13198A2E, 0x03707344), (0x243F6A88, 0x85A308D3), (0xC4923A9C, 0x483DF7A0)),
]


@pytest.mark.parametrize(("key", "counters", "result"), KNOWN)
def test_bits_are_those_of_the_reference(key, counters, result):
    given = [jnp.full(shape, x, jnp.uint32) for shape, x in zip([(1, 1), (2, 1), (1, 3), (2, 3)], (*key, *counters), strict=True)]
    x, y = jax.jit(threefry2x32_p.bind)(*given)
    np.testing.assert_array_equal(x, np.full((2, 3), result[0], np.uint32))
    np.testing.assert_array_equal(y, np.full((2, 3), result[1], np.uint32))


@pytest.mark.parametrize("draw", [jax.random.split, jax.random.uniform, jax.random.bits, lambda key: jax.random.fold_in(key, 5)])
def test_all_rounds_are_one_turn_that_stays_apart(draw):
    """JAX's own loop of five turns carries nine values. A loop that XLA took apart would not be there."""
    program = jax.jit(jax.vmap(draw)).lower(jax.random.split(jax.random.PRNGKey(0), 3))
    carried = re.findall(r"stablehlo.while\((.*?)\)", program.as_text())
    assert carried and all(values.count("=") <= 5 for values in carried)
    assert " while(" in program.compile().as_text()


def test_no_numbers_are_drawn_of_an_empty_batch():
    assert jax.jit(lambda key: jax.random.bits(key, (0, 3)))(jax.random.PRNGKey(0)).shape == (0, 3)
