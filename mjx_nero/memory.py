"""What training needs of a device's memory, so that too many environments end in one line, before the memory does.

First an estimate from the sizes of what is kept, its factors measured on compiled programs (tests/test_memory.py), then what XLA
says of the program that it has compiled. Warp's buffers are outside XLA's memory, and counted apart.
"""

import contextlib
import dataclasses
import itertools
import pathlib
from collections.abc import Iterator
from typing import Any

import jax

from mjx_nero.physics import Physics
from mjx_nero.ppo import Learner
from mjx_nero.types import UserError

# A rollout keeps every step's observations and the like; its end takes two layers of the critic for all of them; an update copies
# a minibatch, and keeps what all of its networks' neurons gave, for the gradient. MJX-JAX takes a few times its data.
_BATCH, _NEURONS, _MJX_DATA = 1.1, 1.75, 2.5
_WARP_DATA = 1.25  # a step's scratch arrays


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
        devices, n = learner.num_devices, learner.cfg.num_envs
        need = self.fixed + self.per_env * n / devices
        if need <= self.limit:
            return
        parts = devices * learner.cfg.num_minibatches
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
    fixed, per_env = estimate(learner)
    Pool(_limit(learner), fixed, per_env).check(learner)
    if learner.env.unwrapped.impl == "warp":
        import warp as wp

        free = min(wp.get_cuda_device(i).free_memory for i in range(learner.num_devices))
        Pool(free, 0.0, _WARP_DATA * _data(learner.env.unwrapped.physics)).check(learner)


def check_compiled(learner: Learner, program: Any) -> None:
    """Does the compiled ``Learner.run`` fit, by what XLA says?

    Raises:
        UserError: it does not.
    """
    used = program_bytes(program)
    if used is not None:
        fixed, _ = estimate(learner)
        per_env = (used - fixed) * learner.num_devices / learner.cfg.num_envs
        Pool(_limit(learner), fixed, per_env).check(learner)


@contextlib.contextmanager
def in_one_line(learner: Learner) -> Iterator[None]:
    """For what no estimate foresees, such as another program on the device: running out of memory is the user's to mend.

    Raises:
        UserError: in place of any error that says so.
    """
    try:
        yield
    except (RuntimeError, MemoryError) as error:
        if not says_so(error):
            raise
        raise UserError(f"out of memory with {learner.cfg.num_envs} environments: pass a smaller --num-envs") from error


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


def estimate(learner: Learner) -> tuple[float, float]:
    """What ``Learner.run`` will take of XLA's memory on a device [bytes]: in any case, and for each environment there."""
    cfg, env = learner.cfg, learner.env.unwrapped
    state = jax.eval_shape(learner.init, jax.random.PRNGKey(0))
    own = _bytes(state.env_state)
    # Observations; actions, their means and deviations; log-probability, value, return, advantage, reward and two ends.
    obs = 4 * sum(sum(size) for size in learner.sizes.values())
    step = obs + 4 * (3 * env.action_size + 7)
    neurons = 4 * (sum(cfg.network.actor) + sum(cfg.network.critic))
    layers = 4 * max(a + b for a, b in itertools.pairwise((*cfg.network.critic, 1)))
    physics = _MJX_DATA * _data(env.physics) if env.impl == "jax" else 0.0
    rollout = max(physics, cfg.unroll_length * (obs + layers))
    update = cfg.unroll_length * (step + _NEURONS * neurons) / cfg.num_minibatches
    per_env = own / cfg.num_envs + _BATCH * cfg.unroll_length * step + max(rollout, update)
    return 2.0 * (_bytes(state) - own), per_env


def _data(physics: Physics) -> float:
    """Bytes of the backend's own data of an environment."""
    return float(getattr(physics, "bytes_per_env", lambda: 0)())


def _bytes(tree: Any) -> int:
    return sum(x.size * x.dtype.itemsize for x in jax.tree.leaves(tree))


def _limit(learner: Learner) -> float:
    """What XLA may take of a device: of a CPU what is free of the machine's memory, shared among its devices."""
    stats = jax.local_devices()[0].memory_stats() or {}
    return stats.get("bytes_limit") or _free_of_machine() / learner.num_devices


def _free_of_machine() -> float:
    lines = pathlib.Path("/proc/meminfo").read_text().splitlines() if pathlib.Path("/proc/meminfo").is_file() else []
    free = [1024 * float(line.split()[1]) for line in lines if line.startswith("MemAvailable:")]
    container = pathlib.Path("/sys/fs/cgroup/memory.max")
    if container.is_file() and container.read_text().strip().isdigit():
        free.append(float(container.read_text()))
    return min(free, default=float("inf"))
