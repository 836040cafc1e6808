"""A run's programs, compiled side by side: training iterations, and the evaluation of the policy."""

import concurrent.futures
import contextlib
import copy
import dataclasses
import functools
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.process import BaseProcess
from typing import Any

import jax

from mjx_nero.envs import wrappers
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.once import once
from mjx_nero.learn import device_memory, learner, machines, waiting
from mjx_nero.learn.learner import Learner, Metrics, state_shape
from mjx_nero.learn.play import rollout
from mjx_nero.runs import starts
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.runs.helpers import wait_for
from mjx_nero.runs.iteration import Lowered
from mjx_nero.runs.programs import Programs
from mjx_nero.runs.spans import Span, Spans

Trace = Callable[[concurrent.futures.Executor], Iterator[None]]  # see ``Fresh.trace``


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

    def __init__(self, run: RunCfg, learner: Learner, programs: Programs):
        self._run, self._seed, self._learner, self._programs = run, run.seed, learner, programs
        self._made: concurrent.futures.Future[tuple[ManipulationEnv, Any]]

    def of_seed(self, seed: int) -> "Evaluator":
        """Returns the same program with another seed's episodes."""
        other = copy.copy(self)
        other._seed = seed
        return other

    def begin(
        self, beside: concurrent.futures.Executor, first: concurrent.futures.Future, state: Any, spans: Spans
    ) -> concurrent.futures.Future:
        """Begins to make the environments and program after ``first``, given a state or its shapes. Evaluations wait for them."""
        self._made = beside.submit(_after, first, lambda: self._make(state, spans))
        return self._made

    def _make(self, state: Any, spans: Spans) -> tuple[ManipulationEnv, Any]:
        with spans.span("evaluation, lowered"):
            env, lowered = self._lowered(state)
        with spans.span("evaluation, compiled"):
            return env, lowered.compile()

    def _lowered(self, state: Any) -> tuple[ManipulationEnv, jax.stages.Lowered]:
        run, learner = self._run, self._learner
        impl, n = "warp" if learner.env.unwrapped.impl == "warp" else "native", run.eval_episodes
        env = ManipulationEnv(run.env.uncorrupted(), impl=impl, num_envs=n)
        play = rollout.player(env, lambda params, obs, _: learner.act(params, obs), n)

        def totals(*args: Any) -> tuple[Any, dict[str, jax.Array]]:
            return (), play(*args)[0]

        args = learner.policy(state), *rollout.keys_of(0, n)
        with machines.small():
            return env, self._programs.lower(f"evaluation-{n}", totals, args, (), env, options=machines.untuned())

    def __call__(self, state: Any) -> dict[str, Any]:
        """Plays the episodes."""
        env, program = self._made.result()
        keys = rollout.keys_of(self._seed, env.num_envs)
        _, totals = waiting.result_of(program, self._learner.policy(state), *keys)
        return rollout.totals_of(totals, env.cfg.metrics).summary()


def make_learner(run: RunCfg) -> Learner:
    """Makes a run's environments and learner.

    Raises:
        UserError: the number of environments or devices does not suit the learner.
    """
    env = ManipulationEnv(run.env, impl=run.impl, num_envs=run.num_envs)
    return learner.find(run.learner).make(wrappers.for_training(env), run.hyperparameters, run.num_devices)


class Fresh:
    """Makes a new run's state from a seed, by one program, with that seed's bank.

    Args:
        programs: where that program and the state are kept; None: nowhere.
    """

    def __init__(self, learner: Learner, bank: starts.Maker | None = None, programs: Programs | None = None):
        self.learner, self._bank, self._programs = learner, bank, programs
        self._jitted = jax.jit(self.init, compiler_options=machines.untuned())

    def trace(self, seed: int, beside: concurrent.futures.Executor) -> Iterator[None]:
        """Traces what a seed's state needs, a program at a time, unless an earlier run has kept the state. Begins to compile it.

        Two threads that trace at once are both late, so ``compile`` goes through this where it traces everything else.
        """
        if self._programs and self._programs.has_state(seed, _names(self._bank)):
            return
        self._lowered  # noqa: B018
        beside.submit(lambda: self._compiled)
        yield
        if self._bank:
            self._bank.trace(seed)

    def __call__(self, seed: int) -> Any:
        """Makes or reads the state."""
        learner, bank, programs = self.learner, self._bank, self._programs
        if programs and (kept := programs.state(learner, seed, _names(bank))) is not None:
            if bank:
                bank.say(f"the first state of seed {seed} is the one that an earlier run made")
            return kept
        with _threads() as beside:
            compiling = beside.submit(lambda: self._compiled)
            given = bank(seed) if bank else {}
            shapes, program = compiling.result()
        make = program if _shapes(given) == shapes else self._jitted
        state = make(jax.random.PRNGKey(seed), given)[0]  # not every learner takes what an expert gives
        if programs:
            programs.keep(state, seed, _names(bank))
        return state

    def placed(self, seed: int) -> Any:
        """Makes or reads the state, placed for ``learner.run``."""
        return self.learner.place(self(seed))

    def init(self, key: Any, given: Any) -> tuple[Any, dict[str, jax.Array]]:
        """Makes the state: what the program computes."""
        return self.learner.init(key, **given), {}

    @functools.cached_property
    def _lowered(self) -> tuple[Any, jax.stages.Lowered]:
        learner, bank = self.learner, self._bank
        given = bank.shapes() if bank else {}
        args = jax.eval_shape(lambda: jax.random.PRNGKey(0)), given
        if not self._programs:
            return _shapes(given), self._jitted.lower(*args)
        name, form, env = "-".join(("init", *_names(bank))), state_shape(learner), learner.env.unwrapped
        with machines.small():
            return _shapes(given), self._programs.lower(name, self.init, args, form, env, options=machines.untuned())

    @once
    def _compiled(self) -> tuple[Any, jax.stages.Compiled]:
        shapes, lowered = self._lowered
        return shapes, lowered.compile()


def _names(bank: starts.Maker | None) -> tuple[str, ...]:
    """Returns the names of what an expert gives a first state, which with the run and its seed decide what state that is."""
    return bank.names if bank else ()


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: (x.shape, str(x.dtype)), tree)


def compile(
    run: RunCfg,
    learner: Learner,
    chunk: int,
    start: Callable[[], Any],
    programs: Programs,
    trace: Trace | None = None,
    kernels: BaseProcess | None = None,
) -> Compiled:
    """Compiles a run's programs, and makes its first state meanwhile. The evaluation's is still in the making when it returns.

    This thread traces what training waits for, and first what takes longest to compile, because one thread at a time runs Python.
    Compilers, kernels and the expert's episodes run beside it, and then the evaluation is traced.

    Args:
        chunk: iterations per call.
        start: makes the first state, placed on the devices.
        programs: where the run's programs are kept.
        trace: traces what ``start`` needs, a program at a time: see ``Fresh.trace``. None: ``start`` traces it itself.
        kernels: the process that builds the kernels of the physics (see ``apart``); None: there is none.

    Raises:
        UserError: the run does not fit into memory.
    """
    begun, env, spans = time.perf_counter(), learner.env.unwrapped, Spans()
    start = spans.timed("first state", start)

    def prepare() -> None:
        if kernels is not None:
            env.footprint(learner.num_devices).outside  # noqa: B018 (takes a second the first time, which need not wait)
            wait_for(kernels)  # before the next line, because it takes memory of the GPU's
        device_memory.check_outside(learner)
        env.prepare(run.num_envs // learner.num_devices, run.num_devices)

    with device_memory.out_of_memory_as_user_error(learner), _threads() as side_by_side:
        with spans.span("learner, lowered"):
            advance = Lowered(learner, chunk, programs).compiling(side_by_side, spans)
        tracing = trace(side_by_side) if trace else iter(())
        with spans.span("first state, lowered"):
            next(tracing, None)
        # Before the expert is traced: on a new machine these kernels take as long as the learner's program.
        physics = side_by_side.submit(spans.timed("physics", prepare))
        with spans.span("expert, lowered"):
            next(tracing, None)
        # A state with pictures draws them. Two threads may not use Warp at once: its streams belong to the process.
        starting = side_by_side.submit(_after, physics if env.cfg.scene.cameras else None, start)
        if env.cfg.scene.cameras:
            starting.result()
        # Last, because training begins without it, unless it draws pictures.
        evaluate = Evaluator(run, learner, programs)
        evaluating = evaluate.begin(side_by_side, physics, state_shape(learner), spans)
        if env.cfg.scene.cameras:
            evaluating.result()
        physics.result()  # if memory is short, its error says how many environments fit
        state, made = starting.result(), advance()
        device_memory.check_compiled(learner, made.programs)
    return Compiled(learner, chunk, made, state, evaluate, time.perf_counter() - begun, spans.found)


def _after(first: concurrent.futures.Future | None, start: Callable[[], Any]) -> Any:
    """Calls ``start`` when ``first`` is done."""
    if first is not None:
        first.result()
    return start()


@contextlib.contextmanager
def _threads():
    """Opens an executor that lets errors and Ctrl-C through without waiting for its threads."""
    pool = concurrent.futures.ThreadPoolExecutor(max_workers=10)  # nothing waits for a place
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)
