"""Macros: their parameters, and how a call fills them in."""

import dataclasses
import re

from lxml import etree

from mjx_nero import config
from mjx_nero.urdf.xacro.budget import Fault, Value
from mjx_nero.urdf.xacro.scope import Scope

_NAME = re.compile(r"\s*([^\s:=]++)")
_EQUALS = re.compile(r"\s*+:?=\s*+(\^\|?)?")
_DEFAULT = re.compile(r"""(?:\$\{.*?\}|\$\(.*?\))(?=\s|$)|(?:'[^']*+'|"[^"]*+"|[^\s'"]++)*+""")
_MAX_PARAMS = 10_000  # characters


@dataclasses.dataclass(frozen=True)
class Parameter:
    """A parameter. ``default``: text, or None. ``inherited``: the caller's property of that name has priority (``:=^``)."""

    name: str
    default: str | None = None
    inherited: bool = False

    @property
    def is_block(self) -> bool:
        return self.name.startswith("*")


@dataclasses.dataclass(frozen=True)
class Macro:
    name: str
    parameters: tuple[Parameter, ...]
    body: etree._Element


def parameters(text: str) -> tuple[Parameter, ...]:
    """Parses the parameters in ``params="a b:=2 c:=^ d:=^|'x' *block **blocks"``."""
    if len(text) > _MAX_PARAMS:
        raise Fault(f"params: more than {_MAX_PARAMS:,} characters")
    found = []
    while text.strip():
        name = _NAME.match(text)
        if name is None:
            raise Fault(f"params: no name at {text.strip()[:40]!r}")
        text = text[name.end() :]
        equals = _EQUALS.match(text)
        if equals is None:
            found.append(Parameter(name[1]))
            continue
        default = _DEFAULT.match(text, equals.end())
        assert default is not None  # it also matches the empty string
        found.append(Parameter(name[1], default[0] or None, bool(equals[1])))
        text = text[default.end() :]
        if text and not text[0].isspace():
            raise Fault(f"params: what is {text[:40]!r} after the default of {name[1]!r}?")
    return tuple(found)


def filled(macro: Macro, given: dict[str, Value], blocks: list[etree._Element], caller: Scope, home: Scope) -> Scope:
    """Makes the scope of a macro's body.

    Args:
        given: values of the call's attributes.
        blocks: expanded elements within the call.
        home: the scope that holds the macro, or the caller's.

    Raises:
        Fault: a parameter or block is missing or superfluous.
    """
    scope = Scope(caller.around, home)
    names = [p.name for p in macro.parameters]
    for name, value in given.items():
        if name not in names:
            raise Fault(f"macro {macro.name!r} has no parameter {name!r}{config.hint(name, names)}")
        scope.set(name, value)
    left = list(blocks)
    for parameter in macro.parameters:
        if parameter.is_block:
            if not left:
                raise Fault(f"macro {macro.name!r} needs a block for {parameter.name!r}")
            scope.blocks[parameter.name] = left.pop(0)
        elif parameter.name not in given:
            scope.set(parameter.name, _default(macro, parameter, caller))
    if left:
        raise Fault(f"macro {macro.name!r} has no use for the block <{left[0].tag}>")
    return scope


def _default(macro: Macro, parameter: Parameter, caller: Scope) -> Value:
    if parameter.inherited and caller.holder("properties", parameter.name) is not None:
        return caller.member(parameter.name)
    if parameter.default is None:
        raise Fault(f"macro {macro.name!r} needs the parameter {parameter.name!r}")
    return caller.text(parameter.default)
