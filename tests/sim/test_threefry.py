"""Random bits: the reference's known answers, and programs without loops over rounds."""

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
def test_draws_of_many_environments_are_straight_lines(draw):
    text = jax.jit(jax.vmap(draw)).lower(jax.random.split(jax.random.PRNGKey(0), 3)).as_text()
    assert "stablehlo.xor" in text and "while" not in text
