"""A run's programs as JAX lowers them, and its first state, kept between runs.

To trace the programs takes seconds of every start, under Python's lock. JAX's own cache keeps what XLA makes of them. A program
has the same form whether it was traced or read, so that JAX finds it there. The first state is a pure function of the run and its
seed; to clone an expert for it takes more than ten seconds on two cores.
"""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from jax import export

from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.learn import device_memory, machines
from mjx_nero.learn.learner import Learner, state_shape
from mjx_nero.runs import kept
from mjx_nero.runs.cfg import RunCfg

# What a program computes of its arguments: a tree whose form is known without tracing, and arrays by name.
Function = Callable[..., tuple[Any, dict[str, jax.Array]]]
_LARGEST = kept.ROOM / 10  # bytes of a first state; that of a lift with 8,192 environments has 12 MB, of clutter 30
# What ``export`` raises if it cannot serialize a program, or has not all that it needs for that.
_REFUSED = (ValueError, TypeError, NotImplementedError, ImportError)


class Programs:
    """The programs and first states of a run; None: nothing is kept.

    Nothing is kept of a run that draws pictures, takes several devices, or calls code from outside of the package.
    """

    def __init__(self, run: RunCfg | None, learner: Learner):
        env = learner.env.unwrapped
        self._shelf = None
        if run and learner.num_devices == 1 and not machines.several() and not env.cfg.scene.cameras:
            # A run's seed and outputs are no part of its programs.
            parts = type(learner), type(env), type(env.physics), env.impl, run.env, env.cfg, run.hyperparameters
            self._shelf = kept.Shelf("programs", *parts, run.num_envs, machines.versions(), _settings())

    def has_state(self, seed: int, names: tuple[str, ...]) -> bool:
        """True if an earlier run has made the first state of a seed. ``names``: see ``state``."""
        return self._shelf is not None and self._shelf.has(_state_name(seed, names))

    def state(self, learner: Learner, seed: int, names: tuple[str, ...]) -> Any:
        """Returns the first state that an earlier run has made from a seed; None if there is none.

        Args:
            names: what an expert gave for it.
        """
        read = self._shelf.read(_state_name(seed, names), lambda _: state_shape(learner)) if self._shelf else None
        return jax.device_put(read[0]) if read else None

    def keep(self, state: Any, seed: int, names: tuple[str, ...]) -> None:
        """Keeps a first state, unless it is too large."""
        if self._shelf and device_memory.size(state) <= _LARGEST:
            self._shelf.write(_state_name(seed, names), state, {})

    def lower(
        self,
        name: str,
        function: Function,
        args: tuple[Any, ...],
        tree: Any,
        env: ManipulationEnv,
        donate: tuple[int, ...] = (),
        options: Any = None,
    ) -> jax.stages.Lowered:
        """Lowers a program, or reads it if an earlier run has lowered it.

        Args:
            name: tells the program from others of this run.
            args: arrays or their shapes.
            tree: the first result of ``function``, or its shapes.
            env: the environment that the program steps.
            donate: see ``jax.jit``'s ``donate_argnums``.
            options: the compiler's.
        """
        whole = _kept(self._shelf, name, function, args, tree, env) if self._shelf else None
        return jax.jit(whole or function, donate_argnums=donate, compiler_options=options).lower(*args)


def _state_name(seed: int, names: tuple[str, ...]) -> str:
    return "-".join(("state", *names, str(seed)))


def _kept(
    shelf: kept.Shelf, name: str, function: Function, args: tuple[Any, ...], tree: Any, env: ManipulationEnv
) -> Function | None:
    """Returns ``function`` as a call of the lowered program; None if that cannot be kept."""
    form: Any = jax.tree.structure(tree)
    operations = getattr(env.physics, "operations", None)  # made here, so that the program finds them
    if operations is None:
        return None
    if read := shelf.read(name, lambda about: {"program": np.empty(about["bytes"], np.uint8)}):
        program, names = bytearray(read[0]["program"]), read[1]["names"]
    else:
        try:
            program, names = _exported(function, args, form, operations)
        except _REFUSED:
            return None
        shelf.write(name, {"program": np.frombuffer(program, np.uint8)}, {"bytes": len(program), "names": names})
    flat = export.deserialize(program)

    def whole(*args: Any) -> tuple[Any, dict[str, jax.Array]]:
        leaves = flat.call(*jax.tree.leaves(args))
        return form.unflatten(leaves[: form.num_leaves]), dict(zip(names, leaves[form.num_leaves :], strict=True))

    whole.__name__ = function.__name__
    return whole


def _exported(function: Function, args: tuple[Any, ...], form: Any, operations: Any) -> tuple[bytearray, list[str]]:
    """Traces, lowers and serializes a function; returns also the names of its second result.

    Its arguments and results are leaves, because types of trees cannot be serialized.

    Raises:
        ValueError, TypeError, NotImplementedError, ImportError: see ``_REFUSED``.
    """
    leaves, given = jax.tree.leaves(args), jax.tree.structure(args)
    names: list[str] = []

    def flat(*leaves: Any) -> list[Any]:
        state, named = function(*jax.tree.unflatten(given, leaves))
        if jax.tree.structure(state) != form:
            raise ValueError("the result has another form than foreseen")
        names[:] = sorted(named)
        return [*jax.tree.leaves(state), *(named[name] for name in names)]

    allowed = [export.DisabledSafetyCheck.custom_call(name) for name in operations]
    program = export.export(jax.jit(flat), disabled_checks=allowed)(*leaves)
    return program.serialize(), names


def _settings() -> dict[str, str]:
    """Returns JAX's settings, but for those of its cache."""
    return {name: str(value) for name, value in jax.config.values.items() if "cache" not in name}
