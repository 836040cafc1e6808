"""A run's programs, compiled side by side: training iterations, and the evaluation of the policy."""

import concurrent.futures
import contextlib
import copy
import dataclasses
import functools
import time
from collections.abc import Callable, Sequence
from typing import Any

import jax

from mjx_nero.envs import wrappers
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.learn import device_memory, learner, machines
from mjx_nero.learn.learner import Learner, Metrics, state_shape
from mjx_nero.learn.play import rollout
from mjx_nero.runs import starts
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.runs.spans import Span, Spans


@dataclasses.dataclass(frozen=True)
class Compiled:
    """A run's compiled programs and first state.

    Attributes:
        advance: makes ``chunk`` iterations; consumes the state.
        state: the state to start from.
        evaluate: evaluates the policy of a state.
        seconds: time that compilation took [s].
    """

    learner: Learner
    chunk: int
    advance: Callable[[Any], tuple[Any, Metrics]]
    state: Any
    evaluate: "Evaluator"
    seconds: float
    spans: Sequence[Span] = ()

    @property
    def steps(self) -> int:
        """Env steps of one ``advance``."""
        return self.chunk * self.learner.steps_per_iteration


class Evaluator:
    """Evaluates the deterministic policy in unseen episodes, without observation noise.

    It uses MuJoCo's C library, or Warp if training does.
    """

    def __init__(self, run: RunCfg, learner: Learner):
        impl = "warp" if learner.env.unwrapped.impl == "warp" else "native"
        env = ManipulationEnv(run.env.uncorrupted(), impl=impl, num_envs=run.eval_episodes)
        self._seed, self._policy = run.seed, learner.policy
        self._runner = rollout.runner(env, lambda params, obs, _: learner.act(params, obs), run.eval_episodes)

    def of_seed(self, seed: int) -> "Evaluator":
        """Returns the same program with another seed's episodes."""
        other = copy.copy(self)
        other._seed = seed
        return other

    def compiler(self, state: Any) -> Callable[[], None]:
        """Returns a call that compiles the program, given a state or its shapes: see ``rollout.Runner.compiler``."""
        return self._runner.compiler(self._policy(state))

    def __call__(self, state: Any) -> dict[str, Any]:
        return self._runner(self._policy(state), self._seed).summary()


def make_learner(run: RunCfg) -> Learner:
    """Makes a run's environments and learner.

    Raises:
        UserError: the number of environments or devices does not suit the learner.
    """
    env = ManipulationEnv(run.env, impl=run.impl, num_envs=run.num_envs)
    return learner.find(run.learner).make(wrappers.for_training(env), run.hyperparameters, run.num_devices)


def fresh(learner: Learner, bank: starts.Maker | None = None) -> Callable[[int], Any]:
    """Returns a function that makes a new run's state from a seed, by one program, with that seed's bank."""
    init = jax.jit(learner.init, compiler_options=machines.untuned())

    @functools.cache
    def expected() -> tuple[Any, Any]:  # compiled while an expert plays
        given = bank.shapes() if bank else {}
        key = jax.eval_shape(lambda: jax.random.PRNGKey(0))
        return _shapes(given), init.lower(key, **given).compile()

    def start(seed: int) -> Any:
        with _threads() as beside:
            compiling = beside.submit(expected)
            given = bank(seed) if bank else {}
            shapes, program = compiling.result()
        make = program if _shapes(given) == shapes else init
        return make(jax.random.PRNGKey(seed), **given)  # not every learner takes what an expert gives

    return start


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: (x.shape, str(x.dtype)), tree)


def starter(learner: Learner, bank: starts.Maker | None = None) -> Callable[[int], Any]:
    """Returns ``fresh``, with the state placed for ``learner.run``."""
    start = fresh(learner, bank)
    return lambda seed: learner.place(start(seed))


def compile(run: RunCfg, learner: Learner, chunk: int, start: Callable[[], Any]) -> Compiled:
    """Compiles a run's programs, and makes its first state meanwhile.

    Args:
        chunk: iterations per call.
        start: makes the first state, placed on the devices.

    Raises:
        UserError: the run does not fit into memory.
    """
    begun, env, spans = time.perf_counter(), learner.env.unwrapped, Spans()
    start = spans.timed("first state", start)

    def prepare() -> None:
        device_memory.check_outside(learner)
        env.prepare(run.num_envs // learner.num_devices, run.num_devices)

    with device_memory.out_of_memory_as_user_error(learner), _threads() as side_by_side:  # compilers release Python's lock
        physics = side_by_side.submit(spans.timed("physics", prepare))
        # A state with pictures draws them. Two threads may not use Warp at once: its streams belong to the process.
        starting = side_by_side.submit(_after, physics if env.cfg.scene.cameras else None, start)
        with spans.span("learner, traced"):
            shapes = state_shape(learner)
            program = jax.jit(learner.run, static_argnums=1, donate_argnums=0).lower(learner.place(shapes), chunk)
        compiling = side_by_side.submit(spans.timed("learner, compiled", program.compile), env.physics.compiler_options)
        if env.cfg.scene.cameras:
            starting.result()
        with spans.span("evaluation, traced"):
            evaluate = Evaluator(run, learner)
            compiler = evaluate.compiler(shapes)
        evaluating = side_by_side.submit(spans.timed("evaluation, compiled", compiler))
        physics.result()  # if memory is short, its error says how many environments fit
        state, advance = starting.result(), compiling.result()
        device_memory.check_compiled(learner, advance)
        evaluating.result()
    return Compiled(learner, chunk, advance, state, evaluate, time.perf_counter() - begun, spans.found)


def _after(first: concurrent.futures.Future | None, start: Callable[[], Any]) -> Any:
    """Calls ``start`` when ``first`` is done."""
    if first is not None:
        first.result()
    return start()


@contextlib.contextmanager
def _threads():
    """Opens an executor that lets errors and Ctrl-C through without waiting for its threads."""
    pool = concurrent.futures.ThreadPoolExecutor()
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
