"""The protocol of controllers."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float

from mjx_nero.types import View

Memory = Any  # a pytree; the controller's state between control steps


@runtime_checkable  # for the tests' type checks
class Controller(Protocol):
    """A controller of one environment. It is pure: ``jax.vmap`` makes thousands."""

    def init(self, view: View) -> Memory:
        """Returns the memory at the start of an episode."""

    def step(self, memory: Memory, view: View) -> tuple[Memory, Float[Array, " nu"]]:
        """Computes the position targets of all drives from a view, arm first [rad or m]."""

    def warning(self, memory: Memory) -> str:
        """Returns a warning about the episodes of a batch of memories; empty if there is none."""
