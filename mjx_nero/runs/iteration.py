"""A learner's iterations as compiled programs: one for each part of an iteration, which compile side by side, or one for a whole
chunk of iterations if the learner has no parts.
"""

import concurrent.futures
import contextlib
import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax

from mjx_nero.learn import machines
from mjx_nero.learn.learner import PRECISION, Learner, Metrics, Part, state_shape
from mjx_nero.runs.programs import Programs
from mjx_nero.runs.spans import Spans


class Iterations:
    """Makes a number of iterations: takes the state, which it consumes, and returns the new one with the mean metrics.

    Args:
        programs: compiled, in order: (state, arrays by name) -> state and what the next one takes; the last gives metrics.
        times: how often they run for a call.
    """

    def __init__(self, programs: Sequence[Any], times: int):
        self.programs, self._times = programs, times

    def __call__(self, state: Any) -> tuple[Any, Metrics]:
        total: Metrics = {}
        for _ in range(self._times):
            given: dict[str, jax.Array] = {}
            for program in self.programs:
                state, given = program(state, given)
            total = _plus(total, given) if total else given
        return state, _divided(total, self._times) if self._times > 1 else total


class Lowered:
    """Lowers a learner's iterations.

    Args:
        chunk: iterations of a call.
        programs: where the programs are kept.
    """

    def __init__(self, learner: Learner, chunk: int, programs: Programs):
        self._learner, self._programs = learner, programs
        parts: tuple[Part, ...] = getattr(learner, "parts", tuple)()
        self._times = chunk if parts else 1
        self._parts = parts or (Part(f"run-{chunk}", lambda state, _: learner.run(state, chunk)),)
        self._takes: dict[int, Any] = {0: {}}  # shapes of what each part takes besides the state, as far as they are known

    def compiling(self, beside: concurrent.futures.Executor, spans: Spans) -> Callable[[], Iterations]:
        """Lowers one program after another, and begins to compile each at once. Returns the function that waits for them."""
        learner, env, form = self._learner, self._learner.env.unwrapped, state_shape(self._learner)
        given: dict[str, Any] = {}
        found = []
        state, options = learner.place(form), env.physics.compiler_options
        for i, part in enumerate(self._parts):
            with machines.small() if part.small else contextlib.nullcontext():
                own = {**options, **machines.plain()} if part.plain else options
                lowered = self._programs.lower(part.name, self._function(i), (state, given), form, env, donate=(0,), options=own)
            given = _shapes(lowered.out_info[1])
            found.append(beside.submit(spans.timed(f"{part.name}, compiled", lowered.compile)))
        return lambda: Iterations([each.result() for each in found], self._times)

    def _function(self, i: int) -> Callable[..., Any]:
        """Returns a part that takes and gives arrays by name, because a kept program knows no other types of trees."""
        part, last = self._parts[i], i == len(self._parts) - 1

        def function(state: Any, given: dict[str, jax.Array]) -> tuple[Any, dict[str, jax.Array]]:
            whole = jax.tree.unflatten(jax.tree.structure(self._given(i)), given.values())
            state, found = self._call(i, state, whole)
            if last:
                return state, found
            self._takes[i + 1] = _shapes(found)
            return state, {f"{n:05}": x for n, x in enumerate(jax.tree.leaves(found))}

        function.__name__ = part.name
        return function

    def _given(self, i: int) -> Any:
        if i not in self._takes:  # the part before was read, not traced
            before = functools.partial(self._call, i - 1)
            self._takes[i] = jax.eval_shape(before, state_shape(self._learner), self._given(i - 1))[1]
        return self._takes[i]

    def _call(self, i: int, state: Any, given: Any) -> tuple[Any, Any]:
        with jax.default_matmul_precision(PRECISION):
            return self._parts[i].function(state, given)


def _shapes(tree: Any) -> Any:
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), tree)


@jax.jit
def _plus(one: Metrics, other: Metrics) -> Metrics:
    return jax.tree.map(jax.numpy.add, one, other)


@jax.jit
def _divided(total: Metrics, count: int) -> Metrics:
    return jax.tree.map(lambda x: x / count, total)
