"""A piece of work that is called again and again: its seconds, counts and memory."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.learn import device_memory
from mjx_nero.tools.benchmark.machine import Row


class Program:
    """Work on a state that goes on from call to call.

    Args:
        call: ``(state, key) -> (state, counts)``, the counts a dict of numbers.
        state: before the first call.
        work: env steps, resets or whatever else a call does.
    """

    def __init__(self, call: Callable[[Any, jax.Array], tuple[Any, dict[str, Any]]], state: Any, work: int):
        self.work, self._call, self._state, self._calls = work, call, state, 0
        self.counts: dict[str, float] = {}
        self.compile_s = 0.0
        self.memory_mb: float | None = None

    @classmethod
    def compiled(
        cls, function: Callable, make_state: Callable[[], Any], work: int, options: Mapping[str, Any] | None = None
    ) -> "Program":
        """Compiles ``function`` and calls it once, which also loads what the backend compiles at its first call."""
        begun = time.perf_counter()
        state = make_state()
        call = jax.jit(function, donate_argnums=0).lower(state, jax.random.PRNGKey(0)).compile(dict(options or {}))
        program = cls(call, state, work)
        program.warm_up(begun)
        size = device_memory.program_bytes(call)
        program.memory_mb = None if size is None else mb(size)
        return program

    def warm_up(self, begun: float) -> None:
        """A first call, which does not count; what it took, with all since ``begun``, is the time of compilation."""
        self.run()
        self.counts, self.compile_s = {}, time.perf_counter() - begun

    def run(self) -> float:
        """One call; gives its seconds."""
        key = jax.random.PRNGKey(self._calls)
        self._calls += 1
        begun = time.perf_counter()
        self._state, counts = jax.block_until_ready(self._call(self._state, key))
        seconds = time.perf_counter() - begun
        self.counts = {name: self.counts.get(name, 0.0) + float(value) for name, value in counts.items()}
        return seconds

    def rates(self, repeats: int) -> list[float]:
        """Work a second, of each of ``repeats`` calls."""
        return [self.work / self.run() for _ in range(repeats)]


def spread(name: str, values: list[float]) -> Row:
    """Median, least and most, whole numbers from 100 on."""
    found = {name: statistics.median(values), f"{name}_min": min(values), f"{name}_max": max(values)}
    return {key: round(value) if value >= 100 else round(value, 1) for key, value in found.items()}


def mb(size: float) -> float:
    """Bytes in MB of 2^20."""
    return round(size / 2**20, 2)


def device_peak_mb() -> float | None:
    """The most that JAX has ever held on the first device in this process; None where the backend does not count (CPU)."""
    stats = jax.local_devices()[0].memory_stats() or {}
    return mb(stats["peak_bytes_in_use"]) if "peak_bytes_in_use" in stats else None


def warp_mb(env: ManipulationEnv) -> float | None:
    """The backend's own buffers for all environments, which JAX does not know of; None where it has none."""
    outside = env.footprint().outside
    return mb(env.num_envs * outside) if outside else None
