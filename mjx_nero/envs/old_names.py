"""Translates the field names of version 0.5.0, so that its runs, command lines and scripts keep their meaning.

Only this module knows the old names. Messages and help texts show the new ones.
"""

import dataclasses
from collections.abc import Collection, Iterator, Mapping
from typing import Any

from mjx_nero.config import values
from mjx_nero.mdp.terms import ObservationGroup

_MOVED = {"motion": "command.motion", "targets": "command.targets", "widening": "curriculum.levels"}
_LISTS = ("apart", "sensed")  # lists of group names, now fields of the groups
_GROUP = {field.name for field in dataclasses.fields(ObservationGroup)}


def current(fields: Mapping[str, Any], groups: Collection[str], weights: Collection[str]) -> dict[str, Any]:
    """Returns the fields under their present names.

    Args:
        fields: values by dotted name, old or new.
        groups: names of the task's observation groups.
        weights: names of the rewards whose weights the curriculum changes.

    Raises:
        UserError: ``apart`` or ``sensed`` is not a list of names.
    """
    return {name: value for old, given in fields.items() for name, value in _renamed(old, given, groups, weights)}


def _renamed(name: str, value: Any, groups: Collection[str], weights: Collection[str]) -> Iterator[tuple[str, Any]]:
    head, *rest = name.split(".")
    if name == "corruption":
        yield from ((f"observations.{group}.corruption", value) for group in groups)
    elif name in _LISTS:
        listed = values.read(tuple[str, ...], value, name)
        yield from ((f"observations.{group}.{name}", group in listed) for group in groups)
    elif name == "training.num_timesteps":
        yield "budget.steps", value
    elif head in _MOVED:
        yield ".".join([_MOVED[head], *rest]), value
    elif name == "curriculum" and isinstance(value, Mapping) or head == "curriculum" and rest and rest[0] in weights:
        yield ".".join([head, "weights", *rest]), value
    elif head == "observations" and len(rest) > 1 and rest[0] in groups and rest[1] not in _GROUP:
        yield ".".join([head, rest[0], "terms", *rest[1:]]), value
    else:
        yield name, value
