"""What training needs of a device's memory, so that too many environments end in one line, before the memory does.

First the learner's estimate from the sizes of what it keeps, then what XLA says of the program that it has compiled. Warp's
buffers are outside XLA's memory, and counted apart.
"""

import contextlib
import dataclasses
import pathlib
from collections.abc import Iterator
from typing import Any

import jax

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.learn.learner import Learner

_SCRATCH = 1.25  # a step's own arrays, beside what a backend keeps outside JAX
_STATES = 3  # that a loop holds at once: the one before, the one after, and fresh starts


@dataclasses.dataclass(frozen=True)
class Pool:
    """One kind of memory on a device [bytes]: what there is of it, and what training takes."""

    limit: float
    fixed: float
    per_env: float  # for each environment on that device

    def check(self, learner: Learner) -> None:
        """Raises:
        UserError: it is not enough.
        """
        devices, n, parts = learner.num_devices, learner.num_envs, learner.divisor
        need = self.fixed + self.per_env * n / devices
        if need <= self.limit:
            return
        most = int(max(0.0, self.limit - self.fixed) / self.per_env) * devices // parts * parts
        text = f"{n} environments need about {need / 1e9:.1f} GB of memory on a device, and there are {self.limit / 1e9:.1f} GB"
        if not most:
            raise UserError(f"{text}: too little for {parts} even; free some, or make the networks or ppo.unroll_length smaller")
        raise UserError(f"{text}: pass --num-envs {most} or fewer")


def check(learner: Learner) -> None:
    """Before anything is compiled: does it fit by estimate?

    Raises:
        UserError: it does not.
    """
    Pool(_limit(learner.num_devices), *learner.footprint()).check(learner)
    physics = learner.env.unwrapped.physics.footprint(learner.num_devices)
    if physics.outside:
        Pool(physics.free, 0.0, _SCRATCH * physics.outside).check(learner)


def check_batch(env: ManipulationEnv, count: int, name: str, kept: float = 0.0) -> None:
    """Before anything of a batch is made: does it fit? Each number of a task may be within its bounds, and their product not.

    Args:
        count: environments side by side.
        name: what the user calls that number.
        kept: what a program keeps beside the environments themselves [bytes].

    Raises:
        UserError: it does not.
    """
    state = size(env.state_shape)
    physics = env.physics.footprint()
    for need, there in (
        (kept + count * (_STATES * state + physics.in_program), _limit(1)),
        (count * _SCRATCH * physics.outside, physics.free),
    ):
        if need > there:
            raise UserError(
                f"{name} {count:,} with {state / 1e3:,.0f} kB of state each, and {kept / 1e9:.1f} GB of records, needs about "
                f"{need / 1e9:,.1f} GB of memory, and there are {there / 1e9:.1f} GB: pass fewer, shorter episodes, or smaller "
                "histories and delays"
            )


def check_compiled(learner: Learner, program: Any) -> None:
    """Does the compiled ``Learner.run`` fit, by what XLA says?

    Raises:
        UserError: it does not.
    """
    used = program_bytes(program)
    if used is not None:
        fixed, _ = learner.footprint()
        per_env = (used - fixed) * learner.num_devices / learner.num_envs
        Pool(_limit(learner.num_devices), fixed, per_env).check(learner)


@contextlib.contextmanager
def out_of_memory_as_user_error(learner: Learner) -> Iterator[None]:
    """For what no estimate foresees, such as another program on the device: running out of memory is the user's to mend.

    Raises:
        UserError: in place of any error that says so.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not says_so(error):
            raise
        raise UserError(f"out of memory with {learner.num_envs} environments: pass a smaller --num-envs") from error


def says_so(error: BaseException) -> bool:
    """True of an error whose message tells that memory ran out."""
    text = str(error).lower()
    return any(sign in text for sign in ("resource_exhausted", "out of memory", "failed to allocate"))


def program_bytes(program: Any) -> int | None:
    """What a compiled program takes of XLA's memory on a device, arguments and results included; None if nobody knows."""
    use = program.memory_analysis()
    if use is None:
        return None
    return use.argument_size_in_bytes + use.output_size_in_bytes + use.temp_size_in_bytes - use.alias_size_in_bytes


def size(tree: Any) -> int:
    """Bytes of a tree of arrays, or of their shapes."""
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def _limit(num_devices: int) -> float:
    """What XLA may take of a device: of a CPU what is free of the machine's memory, shared among its devices."""
    stats = jax.local_devices()[0].memory_stats() or {}
    return stats.get("bytes_limit") or _free_of_machine() / num_devices


def _free_of_machine() -> float:
    lines = pathlib.Path("/proc/meminfo").read_text().splitlines() if pathlib.Path("/proc/meminfo").is_file() else []
    free = [1024 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    container = pathlib.Path("/sys/fs/cgroup/memory.max")
    if container.is_file() and container.read_text().strip().isdigit():
        free.append(float(container.read_text()))
    return min(free, default=float("inf"))
