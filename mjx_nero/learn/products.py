"""Matrix products whose shapes several arms share.

To find a fast kernel, XLA compiles dozens of them for each shape of a product, and keeps its choice by shape. Arms differ by a
few observations and actions. With sides rounded up, a second arm's products have the first one's shapes, and are chosen already.
"""

import contextlib
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from flax import linen
from jaxtyping import Array, Float

SIDE = 16  # the least tile of a GPU's units for products, so a larger side than asked for costs little


def alike() -> contextlib.AbstractContextManager:
    """Within it, Flax's dense layers compute ``product`` on a GPU. A CPU chooses no kernels, so its layers stay as they are."""
    return linen.intercept_methods(dense) if jax.default_backend() == "gpu" else contextlib.nullcontext()


def dense(call: Callable[..., Any], args: Any, kwargs: Any, context: linen.module.InterceptorContext) -> Any:
    """Computes a dense layer by ``product``, and calls all other methods: an interceptor of Flax."""
    layer = context.module
    if type(layer) is not linen.Dense or context.method_name != "__call__" or layer.is_initializing():
        return call(*args, **kwargs)
    found = product(args[0], layer.get_variable("params", "kernel"))
    return found + layer.get_variable("params", "bias") if layer.use_bias else found


def product(x: Float[Array, "*batch inputs"], kernel: Float[Array, "inputs outputs"]) -> Float[Array, "*batch outputs"]:
    """Returns ``x @ kernel`` from a product whose sides are multiples of ``SIDE``. The rest of them is zeros.

    A single output stays single: it is a sum, for which no kernel is chosen.
    """
    inputs, outputs = kernel.shape
    more_in, more_out = -inputs % SIDE, -outputs % SIDE if outputs > 1 else 0
    # The barriers keep the compiler from taking the zeros back into the product, which would make its kernel another one.
    if more_in:
        x = jax.lax.optimization_barrier(jnp.pad(x, ((0, 0),) * (x.ndim - 1) + ((0, more_in),)))
    if more_in or more_out:
        kernel = jax.lax.optimization_barrier(jnp.pad(kernel, ((0, more_in), (0, more_out))))
    found = x @ kernel
    return jax.lax.optimization_barrier(found)[..., :outputs] if more_out else found
