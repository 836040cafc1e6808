"""Encoders by name. Each turns one observation term into features, in groups whose terms stay apart.

A policy's file says which encoder reads which term (``NetworkCfg.encoders``), so the policy can be rebuilt as it was trained.
"""

from collections.abc import Callable
from typing import Any, Protocol

import jax
from flax import linen

from mjx_nero.config.registry import Registry
from mjx_nero.learn.ppo.cfg import NetworkCfg
from mjx_nero.types import Key

FLAT = "flat"


class Encoder(Protocol):
    """Turns a normalised term into features. Any Flax module qualifies."""

    def init(self, key: Key, x: jax.Array, /) -> Any:
        """Makes new variables. ``x``: a term [batch, *shape]."""

    def apply(self, variables: Any, x: jax.Array, /) -> Any:
        """Computes features [..., n] from a term [..., *shape]."""


class Flat(linen.Module):
    """Flattens the term's numbers."""

    axes: int  # number of the term's axes

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        return x.reshape(*x.shape[: x.ndim - self.axes], -1)


class Mlp(linen.Module):
    """Feeds the flattened term through a multilayer perceptron.

    Attributes:
        axes: number of the term's axes.
        layers: layer widths.
        activation: activation of every layer, including the last.
    """

    axes: int
    layers: tuple[int, ...]
    activation: str

    @linen.compact
    def __call__(self, x: jax.Array) -> jax.Array:
        x = Flat(self.axes)(x)
        for size in self.layers:
            x = getattr(linen, self.activation)(linen.Dense(size, kernel_init=jax.nn.initializers.lecun_uniform())(x))
        return x


Make = Callable[[tuple[int, ...], NetworkCfg], Encoder]  # (shape of the term, config of the networks) -> encoder

# ``NetworkCfg.encoders`` names them.
ENCODERS: Registry[Make] = Registry(
    "encoder",
    {
        FLAT: lambda shape, cfg: Flat(len(shape)),
        "mlp": lambda shape, cfg: Mlp(len(shape), tuple(cfg.encoder_layers), cfg.activation),
    },
)


def make(name: str, shape: tuple[int, ...], cfg: NetworkCfg) -> Encoder:
    """Makes an encoder by name, for a term of the given shape.

    Raises:
        UserError: there is no such encoder.
    """
    return ENCODERS.find(name)(shape, cfg)
