"""What a controller is."""

from typing import Any, Protocol, runtime_checkable

from jaxtyping import Array, Float

from mjx_nero.types import View

Memory = Any  # a pytree; the controller's state between control steps


@runtime_checkable  # the tests' type checks ask
class Controller(Protocol):
    """A controller of one environment: pure, so that ``jax.vmap`` makes thousands."""

    def init(self, view: View) -> Memory:
        """The memory at the start of an episode."""

    def step(self, memory: Memory, view: View) -> tuple[Memory, Float[Array, " nu"]]:
        """One control step: what it sees -> position targets of all drives, arm first [rad or m]."""

    def warning(self, memory: Memory) -> str:
        """What its user should know after the episodes of a batch of memories; empty if there is nothing."""
