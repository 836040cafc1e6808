"""Term configs, and the functions that apply them. A term is a function with keyword parameters, checked when the term is made.

The function is pure, or it is a class whose objects have a memory: ``Class(**params)`` has ``init(key, view) -> memory`` and
``step(memory, view) -> (memory, value)``. One dict, keyed by dotted name, holds the memory of all terms in an episode.
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
from mjx_nero.config.values import short
from mjx_nero.mdp.curriculum import toward
from mjx_nero.mdp.memory import Delay, History, delay
from mjx_nero.types import LEVEL, Key, UserError, View

ROBOT = "robot"  # any term may take this parameter besides its function's own: the robot whose arm and hand it sees


@dataclasses.dataclass(frozen=True)
class Term:
    """A function and its keyword parameters; parameters with defaults may be omitted.

    In a scene of several robots, the parameter ``robot`` of a term that reads a view names the one that it sees
    (``View.of``). Without it, the hand is the first robot's, and the joints are all robots'.

    Raises:
        UserError: a parameter is missing or unknown; the message lists the valid names.
    """

    func: Callable
    params: Mapping[str, Any] = dataclasses.field(default_factory=dict, kw_only=True)

    def __post_init__(self):
        parameters = [p for p in inspect.signature(self.func).parameters.values() if p.kind is p.KEYWORD_ONLY]
        defaults = {p.name: p.default for p in parameters if p.default is not p.empty}
        wanted = [p.name for p in parameters] + [ROBOT] * (ROBOT in self.params)
        params = {**defaults, **self.params}
        if set(wanted) != set(params):
            given, valid = ", ".join(self.params) or "none", ", ".join(wanted) or "none"
            raise UserError(f"{self.name} takes the parameters {valid}; given: {given}")
        object.__setattr__(self, "params", {name: params[name] for name in wanted})
        config.freeze(self)

    @property
    def name(self) -> str:
        """The function's name."""
        return bounds.unwrapped(self.func).__name__

    @property
    def remembers(self) -> bool:
        """True if the function is a class whose objects have a memory."""
        return hasattr(bounds.unwrapped(self.func), "step")

    @functools.cached_property
    def made(self) -> Any:
        """The instance of a term that has a memory."""
        return self.func(**self._own)

    @property
    def _own(self) -> dict[str, Any]:
        return {name: value for name, value in self.params.items() if name != ROBOT}

    def seen(self, view: View) -> View:
        """Returns the part of a view that the term sees: all of it, or what concerns its robot."""
        return view.of(self.params[ROBOT]) if ROBOT in self.params else view

    def __call__(self, *args: Any) -> Any:
        """Calls the function with its parameters."""
        return self.func(*args, **self._own)

    def hints(self) -> dict[str, Any]:
        """The annotations of the parameters, for ``bounds.check``."""
        return {"params": bounds.parameter_hints(self.func)}


@dataclasses.dataclass(frozen=True)
class RewardTerm(Term):
    """A term worth ``weight * func(view)`` per second of simulated time."""

    weight: float = dataclasses.field(kw_only=True)  # multiplies the function, per second of simulated time


@dataclasses.dataclass(frozen=True)
class ObservationTerm(Term):
    """One part of an observation group.

    Attributes:
        noise: half-width of the uniform noise added while the group's corruption is on.
        delay: least and greatest delay [control steps] (see ``memory.Delay``).
        hold: probability that a step keeps the previous step's delay.
        history: number of latest values to stack.
    """

    noise: NonNegative = dataclasses.field(default=0.0, kw_only=True)
    delay: Steps = dataclasses.field(default=(0, 0), kw_only=True)
    hold: Share = dataclasses.field(default=1.0, kw_only=True)
    history: Past = dataclasses.field(default=1, kw_only=True)

    @property
    def lines(self) -> tuple[Delay | History, ...]:
        """The delay and the history that the value passes through before it is seen."""
        late = delay(self.delay, self.hold)
        return ((late,) if late else ()) + ((History(self.history),) if self.history > 1 else ())


@dataclasses.dataclass(frozen=True)
class ObservationGroup:
    """Named terms for one reader, such as the policy or the critic.

    Attributes:
        terms: the terms by name, in the order of the vector.
        corruption: adds the terms' noise. On for training, off for play.
        apart: keeps the terms as a dict of arrays of any shape, instead of concatenating them.
        sensed: the terms read the world through the task's sensors. Otherwise they read the true state.
    """

    terms: Mapping[str, ObservationTerm]
    corruption: bool = True
    apart: bool = False
    sensed: bool = True

    def __post_init__(self):
        config.freeze(self)


def privileged(terms: Mapping[str, ObservationTerm], more: Mapping[str, ObservationTerm] | None = None) -> ObservationGroup:
    """Makes a critic's group: the same terms without noise, plus ``more``, all read from the true state."""
    exact = {name: dataclasses.replace(term, noise=0.0) for name, term in terms.items()}
    return ObservationGroup({**exact, **(more or {})}, sensed=False)


Groups = dict[str, ObservationGroup]  # by name


def groups(terms: Mapping[str, ObservationTerm], more: Mapping[str, ObservationTerm] | None = None) -> Groups:
    """Makes the usual two groups: ``state`` for a policy, and ``privileged_state`` for its critic (see ``privileged``)."""
    return {"state": ObservationGroup(terms), "privileged_state": privileged(terms, more)}


@dataclasses.dataclass(frozen=True)
class MetricTerm(Term):
    """One number per episode, and how to combine the numbers of many episodes.

    Attributes:
        at_end: 0 before the last step, so that the sum over the episode is the final value.
        over: how episodes combine: their ``mean``, or the ``rate`` of episodes whose number is above 0.
        where: another metric; the mean covers only episodes where that metric is above 0. Empty: all episodes.
        figure: name of the result, before the suffix ``_mean`` or ``_rate``. Empty: the metric's own name.
        milestone: the metric marks that the hard part of the task is done, such as the grasp. Its memory stays true from then on,
            and expert starts lie around that moment (``runs.starts``).
    """

    at_end: bool = dataclasses.field(default=True, kw_only=True)
    over: Annotated[str, OneOf("mean", "rate")] = dataclasses.field(default="mean", kw_only=True)
    where: str = dataclasses.field(default="", kw_only=True)
    figure: str = dataclasses.field(default="", kw_only=True)
    milestone: bool = dataclasses.field(default=False, kw_only=True)


@dataclasses.dataclass(frozen=True)
class DoneTerm(Term):
    """A condition that ends the episode."""

    time_out: bool = dataclasses.field(default=False, kw_only=True)  # truncates the episode: the learner sees no terminal state


ONCE = 1e6  # [s] for ``CommandTerm.resample_s``: longer than any episode, so the goal is drawn only at the reset


@dataclasses.dataclass(frozen=True)
class CommandTerm(Term):
    """Draws the goal at every reset, and then at a fixed interval.

    Attributes:
        resample_s: interval between draws [s].
        motion: a path of ``mdp.commands`` that moves the goal from where it was drawn. None: the goal stays.
        targets: candidate objects; each episode commands one of them, which terms find as ``target``. An event picks it
            (``Start.target``); otherwise it is the first.
    """

    resample_s: Positive = dataclasses.field(default=5.0, kw_only=True)
    motion: Term | None = dataclasses.field(default=None, kw_only=True)
    targets: tuple[str, ...] = dataclasses.field(default=(), kw_only=True)


class Recall:
    """Calls the terms of one step, and reads and updates the memory of those that remember.

    Attributes:
        memory: the terms' memory by dotted name.
    """

    def __init__(self, memory: Mapping[str, Any]):
        self.memory = dict(memory)

    def __call__(self, name: str, term: Term, view: View, number: bool = False) -> Any:
        """Computes the term's value; whatever goes wrong in it is told with the term's name.

        Args:
            number: the value must be a single number.
        """
        view = term.seen(view)
        try:
            value = self.through(name, term.made, view) if term.remembers else term(view)
        except Exception as error:
            error.add_note(f"in the term {name}")
            raise
        return _shaped(name, value, 0) if number else value

    def through(self, name: str, step: Any, value: Any) -> Any:
        """Passes a value through anything that has a ``step`` and a memory."""
        self.memory[name], value = step.step(self.memory[name], value)
        return value


def _shaped(name: str, value: Any, ndim: int) -> Any:
    """Returns the value of a term if it is a number, or a vector."""
    if getattr(value, "ndim", 0 if isinstance(value, int | float) else None) != ndim:
        got = f"an array of shape {value.shape}" if hasattr(value, "shape") else short(value)
        raise UserError(f"{name} must return {('a number', 'a vector')[ndim]} for one environment, got {got}")
    return value


def init(groups: Mapping[str, Mapping[str, Term]], key: Key, view: View) -> dict[str, Any]:
    """Builds the memory of all terms at the start of an episode, from its first ``view``.

    Args:
        groups: the terms of each group, by the group's dotted name in the task.
    """
    memory: dict[str, Any] = {}
    for group, terms in groups.items():
        for name, term in terms.items():
            at, seen = f"{group}.{name}", term.seen(view)
            if term.remembers:
                memory[at] = term.made.init(_key(key, memory), seen)
            if isinstance(term, ObservationTerm):
                for line in term.lines:
                    value = jnp.asarray(term.made.step(memory[at], seen)[1] if term.remembers else term(seen))
                    memory[f"{at}.{type(line).__name__.lower()}"] = line.init(_key(key, memory), value)
    return memory


def _key(key: Key, memory: Mapping[str, Any]) -> Key:
    return jax.random.fold_in(key, len(memory))


def rewards(
    terms: Mapping[str, RewardTerm], curriculum: Mapping[str, Term], view: View, count: Int[Array, ""], dt: float, recall: Recall
) -> dict[str, Float[Array, ""]]:
    """Computes the weighted terms of one control step of ``dt`` seconds; their sum is the reward.

    Args:
        curriculum: terms that change a reward's weight, by the reward's name.
        count: total control steps of the environment so far.
    """
    out, level = {}, recall.memory.get(LEVEL)
    for name, term in terms.items():
        weight = curriculum[name](count, level, term.weight) if name in curriculum else term.weight
        out[name] = recall(f"rewards.{name}", term, view, number=True) * weight * dt
    return out


def by_name(group: Mapping[str, ObservationTerm], view: View, recall: Recall, name: str) -> dict[str, Array]:
    """Evaluates the terms of the observation group ``name``, without noise or delay."""
    return {term: recall(f"observations.{name}.{term}", group[term], view) for term in group}


def observe(
    groups: Mapping[str, ObservationGroup], view: View, sensed: View, key: Key, recall: Recall
) -> dict[str, Array | dict[str, Array]]:
    """Evaluates every group: its terms concatenated in the order of the config, or a dict by name if the group is ``apart``.

    Args:
        sensed: the view after the task's sensors, for groups that read it.
    """
    out: dict[str, Any] = {}
    for i, (name, group) in enumerate(groups.items()):
        values = _late(by_name(group.terms, sensed if group.sensed else view, recall, name), group.terms, recall, name)
        k_group = jax.random.fold_in(key, i) if group.corruption and any(term.noise for term in group.terms.values()) else None
        out[name] = (_apart if group.apart else _joined)(values, group.terms, k_group)
    return out


def _late(values: dict[str, Array], terms: Mapping[str, ObservationTerm], recall: Recall, group: str) -> dict[str, Array]:
    """Passes the values through the terms' delays and histories."""
    level = recall.memory.get(LEVEL)
    for name, term in terms.items():
        for line in term.lines:
            passed = recall.through(f"observations.{group}.{name}.{type(line).__name__.lower()}", line, values[name])
            values[name] = toward(level, values[name], passed) if isinstance(line, Delay) else passed
    return values


def _apart(values: dict[str, Array], terms: Mapping[str, ObservationTerm], key: Key | None) -> dict[str, Array]:
    """Keeps the values by name; with a key, adds their noise."""
    if key is None:
        return values
    keys = jax.random.split(key, len(terms))
    return {
        name: value + terms[name].noise * jax.random.uniform(k_term, value.shape, minval=-1.0, maxval=1.0)
        for (name, value), k_term in zip(values.items(), keys, strict=True)
    }


def _joined(values: dict[str, Array], terms: Mapping[str, ObservationTerm], key: Key | None) -> Array:
    """Concatenates all values to one vector; with a key, adds their noise."""
    joined = jnp.concatenate([_shaped(f"the observation {name}", value, 1) for name, value in values.items()])
    if key is None:
        return joined
    # One draw for the whole group: many small draws would take longer than the terms themselves.
    noise = np.concatenate([np.full(values[name].shape, term.noise, np.float32) for name, term in terms.items()])
    return joined + noise * jax.random.uniform(key, noise.shape, minval=-1.0, maxval=1.0)


def terminations(terms: Mapping[str, DoneTerm], view: View, recall: Recall) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """Computes ``(terminated, truncated)``; a step that does both counts as terminated."""
    terminated = truncated = jnp.zeros((), bool)
    for name, term in terms.items():
        hit = recall(f"terminations.{name}", term, view, number=True)
        if term.time_out:
            truncated |= hit
        else:
            terminated |= hit
    return terminated, truncated & ~terminated
