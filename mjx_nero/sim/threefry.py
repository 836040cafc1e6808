"""Random bits on a CPU: the same as JAX's, in programs that compile faster.

JAX draws with Threefry (Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", 2011). For CPUs it lowers the hash to a
loop over five groups of rounds. LLVM unrolls the loop's kernels over short rows of numbers, and they were two thirds of the code
of an evaluation. Here the rounds are one small kernel, as on a GPU. All of it is integers, so no bit can change.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.random import threefry2x32_p
from jax.interpreters import mlir

_ROTATIONS = (13, 15, 26, 6), (17, 29, 16, 24)
_PARITY = np.uint32(0x1BD11BDA)


def bits(key1: jax.Array, key2: jax.Array, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Hashes two counters with a key of two numbers. All are uint32, of shapes that broadcast."""
    keys = key1, key2, key1 ^ key2 ^ _PARITY
    x, y = x + key1, y + key2
    for group in range(5):
        for turn in _ROTATIONS[group % 2]:
            x += y
            y = (y << np.uint32(turn) | y >> np.uint32(32 - turn)) ^ x
        x += keys[(group + 1) % 3]
        y += keys[(group + 2) % 3] + np.uint32(group + 1)
    return x, y


def apart(key1: jax.Array, key2: jax.Array, x: jax.Array, y: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Computes ``bits`` in a kernel of its own.

    Otherwise XLA fuses the rounds with the numbers made of them, and these then depend in their last bits on the size of a batch.
    XLA drops barriers before it fuses, so this is a loop of one turn whose end it cannot foresee.
    """
    shape = jnp.broadcast_shapes(*map(jnp.shape, (key1, key2, x, y)))
    if 0 in shape:
        return bits(key1, key2, x, y)
    going = jnp.ravel(key1)[0] | np.uint32(1)
    first = (going, jnp.broadcast_to(x, shape), jnp.broadcast_to(y, shape))
    _, x, y = jax.lax.while_loop(lambda c: c[0] != 0, lambda c: (jnp.zeros_like(c[0]), *bits(key1, key2, *c[1:])), first)
    return x, y


mlir.register_lowering(threefry2x32_p, mlir.lower_fun(apart, multiple_results=True), platform="cpu")
