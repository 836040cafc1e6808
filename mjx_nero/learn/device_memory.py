"""Memory checks: a run with too many environments ends in one clear line, before the device's memory does.

The first check uses the learner's estimate from the sizes of what it keeps, the second what XLA says of the compiled program.
Warp's buffers lie outside XLA's memory and are counted separately.
"""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any

import jax

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.learn.learner import Learner

_SCRATCH = 1.25  # factor for a step's own arrays, on top of what a backend keeps outside JAX
_STATES = 3  # states that a loop holds at once: before, after, and new starts


@dataclasses.dataclass(frozen=True)
class Pool:
    """One kind of memory on a device [bytes]: the total, and what training takes."""

    limit: float
    fixed: float
    per_env: float  # per environment on the device

    def check(self, learner: Learner) -> None:
        """Checks that the memory suffices.

        Raises:
            UserError: it does not.
        """
        devices, n, parts = learner.num_devices, learner.num_envs, learner.divisor
        need = self.fixed + self.per_env * n / devices
        if need <= self.limit:
            return
        most = int(max(0.0, self.limit - self.fixed) / self.per_env) * devices // parts * parts
        text = f"{n} environments need about {need / 1e9:.1f} GB of memory on a device, which has {self.limit / 1e9:.1f} GB"
        if not most:
            raise UserError(f"{text}: too little even for {parts}; free some, or reduce the networks or ppo.unroll_length")
        raise UserError(f"{text}: pass --num-envs {most} or fewer")


def check(learner: Learner) -> None:
    """Checks the learner's estimate before anything is compiled.

    Raises:
        UserError: the run does not fit.
    """
    Pool(_limit(learner.num_devices), *learner.footprint()).check(learner)


def check_outside(learner: Learner) -> None:
    """Checks what the physics and the renderer keep outside of JAX's memory. It imports them, which takes seconds.

    Raises:
        UserError: the run does not fit.
    """
    physics = learner.env.unwrapped.footprint(learner.num_devices)
    if physics.outside:
        Pool(physics.free, 0.0, _SCRATCH * physics.outside).check(learner)


def check_batch(env: ManipulationEnv, count: int, name: str, kept: float = 0.0) -> None:
    """Checks that a batch of environments fits, before it is made.

    Each number of a task may be within its bounds while their product is not.

    Args:
        count: number of environments side by side.
        name: the user's name for that number.
        kept: what the program keeps besides the environments [bytes].

    Raises:
        UserError: it does not.
    """
    state = size(env.state_shape)
    physics = env.footprint()
    for need, there in (
        (kept + count * (_STATES * state + physics.in_program), _limit(1)),
        (count * _SCRATCH * physics.outside, physics.free),
    ):
        if need > there:
            raise UserError(
                f"{name} {count:,} with {state / 1e3:,.0f} kB of state each, and {kept / 1e9:.1f} GB of records, needs about "
                f"{need / 1e9:,.1f} GB of memory, but {there / 1e9:.1f} GB are free: pass fewer, shorter episodes, or smaller "
                "histories and delays"
            )


def check_compiled(learner: Learner, programs: Iterable[Any]) -> None:
    """Checks that a learner's compiled programs fit, by what XLA says.

    Raises:
        UserError: they do not.
    """
    used = largest(programs)
    if used is not None:
        fixed, _ = learner.footprint()
        per_env = (used - fixed) * learner.num_devices / learner.num_envs
        Pool(_limit(learner.num_devices), fixed, per_env).check(learner)


@contextlib.contextmanager
def out_of_memory_as_user_error(learner: Learner) -> Iterator[None]:
    """Turns running out of memory into an error that the user can fix.

    No estimate foresees everything, such as another program on the device.

    Raises:
        UserError: replaces an error that says that memory ran out.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not says_so(error):
            raise
        raise UserError(f"out of memory with {learner.num_envs} environments: pass a smaller --num-envs") from error


def says_so(error: BaseException) -> bool:
    """Returns whether an error's message says that memory ran out."""
    text = str(error).lower()
    return any(sign in text for sign in ("resource_exhausted", "out of memory", "failed to allocate"))


def program_bytes(program: Any) -> int | None:
    """Returns the device memory that a compiled program takes from XLA [bytes], with arguments and results; None if unknown."""
    use = program.memory_analysis()
    if use is None:
        return None
    return use.argument_size_in_bytes + use.output_size_in_bytes + use.temp_size_in_bytes - use.alias_size_in_bytes


def largest(programs: Iterable[Any]) -> int | None:
    """Returns the device memory of that one of some programs which takes most [bytes]; None if unknown."""
    return max(filter(None, map(program_bytes, programs)), default=None)


def size(tree: Any) -> int:
    """Returns the bytes of a tree of arrays or of their shapes."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def _limit(num_devices: int) -> float:
    """Returns the memory that XLA may take on a device [bytes]. A CPU's devices share the machine's free memory."""
    stats = jax.local_devices()[0].memory_stats() or {}
    return stats.get("bytes_limit") or _free_of_machine() / num_devices


def _free_of_machine() -> float:
    lines = pathlib.Path("/proc/meminfo").read_text().splitlines() if pathlib.Path("/proc/meminfo").is_file() else []
    free = [1024 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    container = pathlib.Path("/sys/fs/cgroup/memory.max")
    if container.is_file() and container.read_text().strip().isdigit():
        free.append(float(container.read_text()))
    return min(free, default=float("inf"))
