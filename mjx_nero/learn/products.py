"""Matrix products whose shapes several arms share.

To find a fast kernel, XLA compiles dozens of them for each shape of a product, and keeps its choice by shape. Arms differ by a
few observations and actions. With sides rounded up, a second arm's products have the first one's shapes, and are chosen already.

What is added is zeros: they stay zeros, and change no other number.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
from flax import linen
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float

SIDE = 16  # the least tile of a GPU's units for products, so a larger side than asked for costs little
Tree = TypeVar("Tree")


def scan(update: Callable[[Any, Any], tuple[Any, Any]], params: Tree, memory: Any, each: Any) -> tuple[tuple[Tree, Any], Any]:
    """Does what ``jax.lax.scan(update, (params, memory), each)`` does.

    On a GPU the sides of products are multiples of ``SIDE``. A CPU chooses no kernels, so its products stay as they are.

    Args:
        update: one update of Flax networks by an optimizer.
        params: a tree of networks. The kernels in a network's ``params`` are those of plain dense layers; what else a network
            has, such as encoders, stays as it is.
        memory: the optimizer's, in which a vector of all parameters is flat, as ``optax.flatten`` makes it.
    """
    if jax.default_backend() != "gpu":
        return jax.lax.scan(update, (params, memory), each)
    sides = _Sides(params)
    with linen.intercept_methods(_dense):
        made, found = jax.lax.scan(update, sides.wide(params, memory), each)
    return sides.narrow(*made), found


class _Sides:
    """Widens and narrows parameters and an optimizer's memory of them."""

    def __init__(self, params: Any):
        self._shapes = jax.tree.map(jnp.shape, params)
        (flat, self._apart), (wide, self._wide_apart) = ravel_pytree(params), ravel_pytree(_wide(params))
        self._size, self._wide_size = flat.shape, wide.shape

    def wide(self, params: Tree, memory: Any) -> tuple[Tree, Any]:
        return _wide(params), _changed(memory, self._size, lambda x: ravel_pytree(_wide(self._apart(x)))[0])

    def narrow(self, params: Tree, memory: Any) -> tuple[Tree, Any]:
        own = _changed(memory, self._wide_size, lambda x: ravel_pytree(self._narrow(self._wide_apart(x)))[0])
        return self._narrow(params), own

    def _narrow(self, params: Tree) -> Tree:
        return jax.tree.map(lambda x, shape: x[tuple(map(slice, shape))], params, self._shapes)


def _wide(params: Tree) -> Tree:
    def each(path: Any, x: Array) -> Array:
        names = [getattr(step, "key", None) for step in path]
        dense = names[1:2] == ["params"] and names[-1] == "kernel" and x.ndim == 2
        return jnp.pad(x, [(0, _more(n)) for n in x.shape]) if dense else x

    return jax.tree_util.tree_map_with_path(each, params)


def _more(side: int) -> int:
    """Returns what is added to a side. A single output stays single: it is a sum, for which no kernel is chosen."""
    return -side % SIDE if side > 1 else 0


def _changed(memory: Any, size: tuple[int, ...], change: Callable[[Array], Array]) -> Any:
    return jax.tree.map(lambda x: change(x) if x.shape == size else x, memory)


def _dense(call: Callable[..., Any], args: Any, kwargs: Any, context: linen.module.InterceptorContext) -> Any:
    layer = context.module
    if type(layer) is not linen.Dense or context.method_name != "__call__" or layer.is_initializing():
        return call(*args, **kwargs)
    (x,) = args
    kernel: Array = layer.get_variable("params", "kernel")
    if kernel.shape == (x.shape[-1], layer.features):
        return call(*args, **kwargs)
    found = product(x, kernel, layer.features)
    return found + layer.get_variable("params", "bias") if layer.use_bias else found


def product(x: Float[Array, "*batch inputs"], kernel: Float[Array, "rows columns"], outputs: int) -> Float[Array, "*batch n"]:
    """Returns the first ``outputs`` columns of ``x @ kernel``, for a kernel with more rows than ``x`` has columns."""
    # The barriers keep the compiler from taking the zeros back into the product, which would make its kernel another one.
    if more := kernel.shape[0] - x.shape[-1]:
        x = jax.lax.optimization_barrier(jnp.pad(x, [*((0, 0),) * (x.ndim - 1), (0, more)]))
    found = x @ kernel
    return jax.lax.optimization_barrier(found)[..., :outputs] if outputs < kernel.shape[1] else found
