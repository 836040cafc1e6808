"""Term configs and the folds that apply them. A term is a function plus keyword parameters, checked when it is made.

The function is pure, or a class whose objects remember: ``Class(**params)`` has ``init(key, view) -> memory`` and
``step(memory, view) -> (memory, value)``. What terms remember of an episode is one dict, by their dotted names.
"""

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping
from typing import Annotated, Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_nero import config
from mjx_nero.config import bounds
from mjx_nero.config.bounds import NonNegative, OneOf, Past, Positive, Share, Steps
from mjx_nero.mdp.curriculum import toward
from mjx_nero.mdp.memory import Delay, History
from mjx_nero.types import LEVEL, Key, UserError, View


@dataclasses.dataclass(frozen=True)
class Term:
    """A function and its keyword parameters; those that have defaults may be left out.

    Raises:
        UserError: a parameter is missing or unknown; the message lists the valid names.
    """

    func: Callable
    params: Mapping[str, Any] = dataclasses.field(default_factory=dict, kw_only=True)

    def __post_init__(self):
        parameters = [p for p in inspect.signature(self.func).parameters.values() if p.kind is p.KEYWORD_ONLY]
        defaults = {p.name: p.default for p in parameters if p.default is not p.empty}
        wanted = [p.name for p in parameters]
        params = {**defaults, **self.params}
        if set(wanted) != set(params):
            given, valid = ", ".join(self.params) or "none", ", ".join(wanted) or "none"
            raise UserError(f"{self.name} takes the parameters {valid}; given: {given}")
        object.__setattr__(self, "params", {name: params[name] for name in wanted})
        config.freeze(self)

    @property
    def name(self) -> str:
        """Of the function."""
        return bounds.unwrapped(self.func).__name__

    @property
    def remembers(self) -> bool:
        """Whether it is a class whose objects have a memory."""
        return hasattr(bounds.unwrapped(self.func), "step")

    @functools.cached_property
    def made(self) -> Any:
        """Of a term that remembers."""
        return self.func(**self.params)

    def __call__(self, *args: Any) -> Any:
        """The function with its parameters."""
        return self.func(*args, **self.params)

    def hints(self) -> dict[str, Any]:
        """What ``bounds.check`` asks for: the parameters' annotations."""
        return {"params": bounds.parameter_hints(self.func)}


@dataclasses.dataclass(frozen=True)
class RewardTerm(Term):
    """``weight * func(view)`` per second of simulated time."""

    weight: float = dataclasses.field(kw_only=True)  # times the function, per second of simulated time


@dataclasses.dataclass(frozen=True)
class ObservationTerm(Term):
    """A part of an observation group.

    Attributes:
        noise: uniform in +-``noise`` while the group's corruption is on.
        delay: by how many control steps it is late, the least and the most (see ``memory.Delay``).
        hold: the chance that a step keeps the delay of the one before.
        history: so many last values in one.
    """

    noise: NonNegative = dataclasses.field(default=0.0, kw_only=True)
    delay: Steps = dataclasses.field(default=(0, 0), kw_only=True)
    hold: Share = dataclasses.field(default=1.0, kw_only=True)
    history: Past = dataclasses.field(default=1, kw_only=True)

    @property
    def lines(self) -> tuple[Delay | History, ...]:
        """What the value goes through before it is seen."""
        delay = (Delay(self.delay, self.hold),) if self.delay != (0, 0) else ()
        return delay + ((History(self.history),) if self.history > 1 else ())


@dataclasses.dataclass(frozen=True)
class ObservationGroup:
    """Terms that a policy, a critic or another reader gets together, by name.

    Attributes:
        terms: by name, in this order.
        corruption: adds the terms' noise: on to train, off to play.
        apart: the terms stay apart, a dict of arrays of any shape by name, instead of being concatenated.
        sensed: the terms read the world through the task's sensors; otherwise they read it as it is.
    """

    terms: Mapping[str, ObservationTerm]
    corruption: bool = True
    apart: bool = False
    sensed: bool = True

    def __post_init__(self):
        config.freeze(self)


def privileged(terms: Mapping[str, ObservationTerm], more: Mapping[str, ObservationTerm] | None = None) -> ObservationGroup:
    """What a critic may see: the same terms without noise, and ``more``, all of the world as it is."""
    exact = {name: dataclasses.replace(term, noise=0.0) for name, term in terms.items()}
    return ObservationGroup({**exact, **(more or {})}, sensed=False)


@dataclasses.dataclass(frozen=True)
class MetricTerm(Term):
    """A figure of an episode, and how those of many episodes become one.

    Attributes:
        at_end: 0 before the last step, so that their sum is the last one.
        over: what the episodes' figures become: their ``mean``, or the ``rate`` of the episodes in which they are above 0.
        where: another metric: the mean is that of the episodes in which it is above 0. Empty: of all.
        figure: what the result is called, with ``_mean`` or ``_rate`` behind; empty: as the metric is.
    """

    at_end: bool = dataclasses.field(default=True, kw_only=True)
    over: Annotated[str, OneOf("mean", "rate")] = dataclasses.field(default="mean", kw_only=True)
    where: str = dataclasses.field(default="", kw_only=True)
    figure: str = dataclasses.field(default="", kw_only=True)


@dataclasses.dataclass(frozen=True)
class DoneTerm(Term):
    """Ends the episode."""

    time_out: bool = dataclasses.field(default=False, kw_only=True)  # a truncation: to the learner no terminal state


ONCE = 1e6  # [s], as ``CommandTerm.resample_s``: longer than any episode, so the goal is drawn at the reset alone


@dataclasses.dataclass(frozen=True)
class CommandTerm(Term):
    """Draws the goal at every reset, and now and then.

    Attributes:
        resample_s: time between draws [s].
        motion: moves the goal from where it was drawn: a path of ``mdp.commands``. None: the goal stays.
        targets: objects of which every episode commands one. The terms of a view call that one ``target``; an event says which it
            is (``Start.target``), else it is the first.
    """

    resample_s: Positive = dataclasses.field(default=5.0, kw_only=True)
    motion: Term | None = dataclasses.field(default=None, kw_only=True)
    targets: tuple[str, ...] = dataclasses.field(default=(), kw_only=True)


class Recall:
    """Calls the terms of one step: those that remember find their memory here, and leave what it becomes.

    Attributes:
        memory: by dotted name.
    """

    def __init__(self, memory: Mapping[str, Any]):
        self.memory = dict(memory)

    def __call__(self, name: str, term: Term, view: View) -> Any:
        """The term's value."""
        return self.through(name, term.made, view) if term.remembers else term(view)

    def through(self, name: str, step: Any, value: Any) -> Any:
        """What anything with a ``step`` and a memory makes of a value."""
        self.memory[name], value = step.step(self.memory[name], value)
        return value


def init(groups: Mapping[str, Mapping[str, Term]], key: Key, view: View) -> dict[str, Any]:
    """What terms remember at the start of an episode, as ``view`` shows it.

    Args:
        groups: the terms, by the dotted name of their group in the task.
    """
    memory: dict[str, Any] = {}
    for group, terms in groups.items():
        for name, term in terms.items():
            at = f"{group}.{name}"
            if term.remembers:
                memory[at] = term.made.init(_key(key, memory), view)
            if isinstance(term, ObservationTerm):
                for line in term.lines:
                    value = jnp.asarray(term.made.step(memory[at], view)[1] if term.remembers else term(view))
                    memory[f"{at}.{type(line).__name__.lower()}"] = line.init(_key(key, memory), value)
    return memory


def _key(key: Key, memory: Mapping[str, Any]) -> Key:
    return jax.random.fold_in(key, len(memory))


def rewards(
    terms: Mapping[str, RewardTerm], curriculum: Mapping[str, Term], view: View, count: Int[Array, ""], dt: float, recall: Recall
) -> dict[str, Float[Array, ""]]:
    """Weighted terms of one control step of ``dt`` seconds; their sum is the reward.

    Args:
        curriculum: by the name of the reward whose weight it changes.
        count: control steps that the environment has made in all.
    """
    out, level = {}, recall.memory.get(LEVEL)
    for name, term in terms.items():
        weight = curriculum[name](count, level, term.weight) if name in curriculum else term.weight
        out[name] = recall(f"rewards.{name}", term, view) * weight * dt
    return out


def by_name(group: Mapping[str, ObservationTerm], view: View, recall: Recall, name: str) -> dict[str, Array]:
    """The terms of the observation group ``name`` as they are now, without noise or delay."""
    return {term: recall(f"observations.{name}.{term}", group[term], view) for term in group}


def observe(
    groups: Mapping[str, ObservationGroup], view: View, sensed: View, key: Key, recall: Recall
) -> dict[str, Array | dict[str, Array]]:
    """Each group's terms, concatenated in the order of the config; of a group that stays ``apart``, a dict by name.

    Args:
        sensed: what the groups read that see through the task's sensors.
    """
    out: dict[str, Any] = {}
    for i, (name, group) in enumerate(groups.items()):
        values = _late(by_name(group.terms, sensed if group.sensed else view, recall, name), group.terms, recall, name)
        k_group = jax.random.fold_in(key, i) if group.corruption and any(term.noise for term in group.terms.values()) else None
        out[name] = (_apart if group.apart else _joined)(values, group.terms, k_group)
    return out


def _late(values: dict[str, Array], terms: Mapping[str, ObservationTerm], recall: Recall, group: str) -> dict[str, Array]:
    """The values after the terms' delays and histories."""
    level = recall.memory.get(LEVEL)
    for name, term in terms.items():
        for line in term.lines:
            passed = recall.through(f"observations.{group}.{name}.{type(line).__name__.lower()}", line, values[name])
            values[name] = toward(level, values[name], passed) if isinstance(line, Delay) else passed
    return values


def _apart(values: dict[str, Array], terms: Mapping[str, ObservationTerm], key: Key | None) -> dict[str, Array]:
    """The values by name; with a key, with their noise."""
    if key is None:
        return values
    keys = jax.random.split(key, len(terms))
    return {
        name: value + terms[name].noise * jax.random.uniform(k_term, value.shape, minval=-1.0, maxval=1.0)
        for (name, value), k_term in zip(values.items(), keys, strict=True)
    }


def _joined(values: dict[str, Array], terms: Mapping[str, ObservationTerm], key: Key | None) -> Array:
    """All values in one vector; with a key, with their noise."""
    joined = jnp.concatenate(list(values.values()))
    if key is None:
        return joined
    # One draw for the group: many small ones would cost more time than the terms themselves.
    noise = np.concatenate([np.full(values[name].shape, term.noise, np.float32) for name, term in terms.items()])
    return joined + noise * jax.random.uniform(key, noise.shape, minval=-1.0, maxval=1.0)


def terminations(terms: Mapping[str, DoneTerm], view: View, recall: Recall) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """``(terminated, truncated)``; a step that does both counts as terminated."""
    terminated = truncated = jnp.zeros((), bool)
    for name, term in terms.items():
        hit = recall(f"terminations.{name}", term, view)
        if term.time_out:
            truncated |= hit
        else:
            terminated |= hit
    return terminated, truncated & ~terminated
