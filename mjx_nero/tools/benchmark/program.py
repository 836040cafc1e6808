"""A program that is called repeatedly, with its seconds, counts and memory."""

import statistics
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.learn import device_memory
from mjx_nero.tools.benchmark.machine import Row


class Program:
    """A function that is called repeatedly on the state that its last call returned.

    Args:
        call: ``(state, key) -> (state, counts)``, where counts is a dict of numbers.
        state: before the first call.
        work: number of env steps, resets or other units that one call does.
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
        """Compiles ``function`` and calls it once, because some backends compile more at their first call."""
        begun = time.perf_counter()
        state = make_state()
        call = jax.jit(function, donate_argnums=0).lower(state, jax.random.PRNGKey(0)).compile(dict(options or {}))
        program = cls(call, state, work)
        program.warm_up(begun)
        size = device_memory.program_bytes(call)
        program.memory_mb = None if size is None else mb(size)
        return program

    def warm_up(self, begun: float) -> None:
        """Makes a first call, which is not measured. All time since ``begun`` counts as compilation."""
        self.run()
        self.counts, self.compile_s = {}, time.perf_counter() - begun

    def run(self) -> float:
        """Makes one call and returns its seconds."""
        key = jax.random.PRNGKey(self._calls)
        self._calls += 1
        begun = time.perf_counter()
        self._state, counts = jax.block_until_ready(self._call(self._state, key))
        seconds = time.perf_counter() - begun
        self.counts = {name: self.counts.get(name, 0.0) + float(value) for name, value in counts.items()}
        return seconds

    def rates(self, repeats: int) -> list[float]:
        """Returns the work per second of each of ``repeats`` calls."""
        return [self.work / self.run() for _ in range(repeats)]


def spread(name: str, values: list[float]) -> Row:
    """Returns median, minimum and maximum; values from 100 on are rounded to whole numbers."""
    found = {name: statistics.median(values), f"{name}_min": min(values), f"{name}_max": max(values)}
    return {key: round(value) if value >= 100 else round(value, 1) for key, value in found.items()}


def mb(size: float) -> float:
    """Converts bytes to MB of 2^20 bytes."""
    return round(size / 2**20, 2)


def device_peak_mb() -> float | None:
    """Returns the peak memory of JAX on the first device in this process; None if the backend does not count it (CPU)."""
    stats = jax.local_devices()[0].memory_stats() or {}
    return mb(stats["peak_bytes_in_use"]) if "peak_bytes_in_use" in stats else None


def warp_mb(env: ManipulationEnv) -> float | None:
    """Returns the size of the physics' own buffers for all environments, which JAX does not count; None if there are none."""
    outside = env.footprint().outside
    return mb(env.num_envs * outside) if outside else None
