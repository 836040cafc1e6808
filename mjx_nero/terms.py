"""Term configs and the folds that apply them. A term is a pure function plus keyword parameters, checked when it is made."""

import dataclasses
import inspect
from collections.abc import Callable, Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_nero.types import Key, Params, UserError, View


@dataclasses.dataclass(frozen=True)
class Term:
    """A function and its keyword parameters.

    Raises:
        UserError: a parameter is missing or unknown; the message lists the valid names.
    """

    func: Callable
    params: Params = dataclasses.field(default_factory=dict, kw_only=True)

    def __post_init__(self):
        object.__setattr__(self, "params", dict(self.params))  # its own: a dict that two terms share is changed for both
        wanted = [p.name for p in inspect.signature(self.func).parameters.values() if p.kind is p.KEYWORD_ONLY]
        if set(wanted) != set(self.params):
            given, valid = ", ".join(self.params) or "none", ", ".join(wanted) or "none"
            raise UserError(f"{self.func.__name__} takes the parameters {valid}; given: {given}")


@dataclasses.dataclass(frozen=True)
class RewardTerm(Term):
    """``weight * func(view)`` per second of simulated time."""

    weight: float = dataclasses.field(kw_only=True)


@dataclasses.dataclass(frozen=True)
class ObservationTerm(Term):
    """A part of an observation group, with uniform noise in +-``noise`` while the env's corruption is on."""

    noise: float = dataclasses.field(default=0.0, kw_only=True)


@dataclasses.dataclass(frozen=True)
class DoneTerm(Term):
    """Ends the episode; ``time_out`` marks a truncation, which is never a terminal state to the learner."""

    time_out: bool = dataclasses.field(default=False, kw_only=True)


ONCE = 1e6  # [s], as ``CommandTerm.resample_s``: longer than any episode, so the goal is drawn at the reset alone


@dataclasses.dataclass(frozen=True)
class CommandTerm(Term):
    """Draws the goal at every reset and every ``resample_s`` seconds."""

    resample_s: float = dataclasses.field(default=5.0, kw_only=True)


def rewards(
    terms: Mapping[str, RewardTerm], curriculum: Mapping[str, Term], view: View, count: Int[Array, ""], dt: float
) -> dict[str, Float[Array, ""]]:
    """Weighted terms of one control step of ``dt`` seconds; their sum is the reward.

    Args:
        curriculum: by the name of the reward whose weight it changes.
        count: control steps that the environment has made in all.
    """
    out = {}
    for name, term in terms.items():
        weight = term.weight
        if name in curriculum:
            weight = curriculum[name].func(count, weight, **curriculum[name].params)
        out[name] = term.func(view, **term.params) * weight * dt
    return out


def by_name(group: Mapping[str, ObservationTerm], view: View) -> dict[str, Float[Array, " n"]]:
    """The terms of an observation group, without noise."""
    return {name: term.func(view, **term.params) for name, term in group.items()}


def observe(
    groups: Mapping[str, Mapping[str, ObservationTerm]], view: View, key: Key, corruption: bool
) -> dict[str, Float[Array, " n"]]:
    """Each group's terms, concatenated in the order of the config."""
    out = {}
    for i, (name, group) in enumerate(groups.items()):
        values = list(by_name(group, view).values())
        out[name] = jnp.concatenate(values)
        if corruption and any(term.noise for term in group.values()):
            # One draw for the group: many small ones would cost more time than the terms themselves.
            noise = np.concatenate([np.full(v.shape, t.noise, np.float32) for v, t in zip(values, group.values(), strict=True)])
            out[name] += noise * jax.random.uniform(jax.random.fold_in(key, i), noise.shape, minval=-1.0, maxval=1.0)
    return out


def terminations(terms: Mapping[str, DoneTerm], view: View) -> tuple[Bool[Array, ""], Bool[Array, ""]]:
    """``(terminated, truncated)``; a step that does both counts as terminated."""
    terminated = truncated = jnp.zeros((), bool)
    for term in terms.values():
        hit = term.func(view, **term.params)
        if term.time_out:
            truncated |= hit
        else:
            terminated |= hit
    return terminated, truncated & ~terminated
