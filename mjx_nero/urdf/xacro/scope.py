"""Names of properties, and the text in which properties and expressions are written."""

import dataclasses
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

from lxml import etree

from mjx_nero.urdf.xacro.budget import MAX_SIZE, Budget, Fault, Value
from mjx_nero.urdf.xacro.evaluate import Names, Namespace, evaluate
from mjx_nero.urdf.xacro.functions import MATH, PYTHON, XACRO, Function

_UNKNOWN: Any = object()


class Surroundings:
    """Everything that text can name besides properties, and the budget of its evaluation.

    Args:
        path: the document.
        args: values of arguments.
        functions: functions of the namespace ``xacro`` that depend on the file.
    """

    def __init__(self, path: pathlib.Path, args: Mapping[str, str], functions: Mapping[str, Callable[..., Any]]):
        self.budget = Budget()
        self.stack = [path]  # files being expanded, innermost last
        self.args = dict(args)
        self.asked: set[str] = set()  # arguments that the file declares or uses
        self.later: dict[str, str] = {}  # properties of whole files, as old files use them before defining them
        self.functions = {name: Function(call) for name, call in functions.items()}

    @property
    def folder(self) -> pathlib.Path:
        """The folder of the file being expanded."""
        return self.stack[-1].parent


@dataclasses.dataclass(frozen=True)
class Lazy:
    """The text of a property, evaluated at its first use."""

    text: str


class Scope(Namespace):
    """Properties, blocks and macros of a document, a macro call or an include with ``ns``. Expressions see a ``Namespace``.

    Args:
        parent: scope in which missing names are looked up.
        named: the scope belongs to an include with ``ns``, not to a macro.
    """

    def __init__(self, around: Surroundings, parent: "Scope | None" = None, named: bool = False):
        self.around = around
        self.parent = parent
        self.named = named
        self.properties: dict[str, Any] = {}
        self.blocks: dict[str, etree._Element] = {}
        self.macros: dict[str, Any] = {}

    def member(self, name: str) -> Any:
        """Looks up a property, function or namespace.

        Raises:
            KeyError: the name is unknown.
            Fault: the property is defined by itself.
        """
        scope = self.holder("properties", name)
        if scope is None:
            own, later = self.around.functions, self.around.later
            if name in later and name not in _GLOBALS:
                return literal(self.outermost().text(later[name]))
            return Names(XACRO | own) if name == "xacro" else own[name] if name in _UNSPACED else _GLOBALS[name]
        value = scope.properties[name]
        if value is _UNKNOWN:
            raise Fault(f'property {name!r} is defined by itself: lazy_eval="false" takes its earlier value')
        if isinstance(value, Lazy):
            scope.properties[name] = _UNKNOWN
            value = scope.properties[name] = literal(scope.text(value.text))
        return value

    def holder(self, what: str, name: str) -> "Scope | None":
        """The nearest scope that has a name among its ``what``."""
        scope: Scope | None = self
        while scope is not None and name not in getattr(scope, what):
            scope = scope.parent
        return scope

    def set(self, name: str, value: Value, lazy: bool = False) -> None:
        """Sets a property. Text that looks like a number or a truth value becomes one."""
        value = literal(value)
        self.properties[name] = Lazy(value) if lazy and isinstance(value, str) else value

    def outermost(self) -> "Scope":
        return self if self.parent is None else self.parent.outermost()

    def text(self, text: str) -> Value:
        """Evaluates text that may contain ``${...}`` and ``$(...)``; the result is a string, unless one of these is all the text.

        Raises:
            Fault: an expression fails, or a bracket is not closed.
        """
        if "$" not in text:
            return text
        if len(text) > MAX_SIZE:
            raise Fault(f"text of more than {MAX_SIZE:,} characters with $ in it: split it")
        pieces: list[Value] = []
        at = 0
        while at < len(text):
            dollars = len(text) - at - len(text[at:].lstrip("$")) if text[at] == "$" else 0
            after = text[at + dollars : at + dollars + 1]
            if dollars and after and after in "{(":
                if dollars == 1:
                    end = text.find("})"[after == "("], at)
                    if end < 0:
                        raise Fault(f"{text[at : at + 60]!r} is not closed")
                    inner = str(self.text(text[at + 2 : end]))
                    pieces.append(evaluate(inner, self.member, self.around.budget) if after == "{" else self._extension(inner))
                    at = end + 1
                else:  # $${ is ${ as it stands
                    pieces.append("$" * (dollars - 1) + after)
                    at += dollars + 1
            else:
                end = text.find("$", at + max(dollars, 1))
                end = len(text) if end < 0 else end
                pieces.append(text[at:end])
                at = end
        whole = pieces[0] if len(pieces) == 1 else "".join(map(str, pieces))
        self.around.budget.spend("characters of text", len(whole) if isinstance(whole, str) else 1)
        return whole

    def string(self, text: str) -> str:
        """Evaluates text to a string."""
        return str(self.text(text))

    def _extension(self, content: str) -> Value:
        words = content.split()
        match words:
            case ["arg", name]:
                return self._arg(name)
            case ["find", package]:
                return f"package://{package}"
            case ["optenv", name, *default]:
                return self._variable(name, " ".join(default))
            case ["env", name]:
                return self._variable(name)
            case ["dirname"]:
                return str(self.around.folder)
            case ["cwd"]:
                return str(pathlib.Path.cwd())
            case ["eval", _, *_]:
                return str(evaluate(content.strip()[4:], self._for_eval, self.around.budget))
        raise Fault(
            f"$({content[:60]}) is none of $(arg NAME), $(find PACKAGE), $(dirname), $(cwd), $(optenv NAME DEFAULT), $(eval ...)"
        )

    def _arg(self, name: str) -> str:
        self.around.asked.add(name)
        if name not in self.around.args:
            raise Fault(f"argument {name!r} has no value: pass --arg {name}:=VALUE")
        return self.around.args[name]

    def _variable(self, name: str, default: str | None = None) -> str:
        """An environment variable: from --arg, as a file need not know what is set on its reader's machine."""
        self.around.asked.add(name)
        value = self.around.args.get(name, default)
        if value is None:
            raise Fault(f"$(env {name}): variables of this machine are not given to files: pass --arg {name}:=VALUE")
        return value

    def _for_eval(self, name: str) -> Any:
        """Names in ``$(eval ...)``: arguments, and few functions."""
        own: dict[str, Callable[..., Any]] = {
            "arg": lambda argument: literal(self._arg(str(argument))),
            "dirname": lambda: str(self.around.folder),
            "find": lambda package: f"package://{package}",
            "optenv": lambda variable, default="": self._variable(str(variable), str(default)),
        }
        if name in own:
            return Function(own[name])
        if name in ("true", "false"):
            return name == "true"
        return literal(self._arg(name)) if name in self.around.args else _GLOBALS[name]


_GLOBALS: dict[str, Any] = {**MATH, **PYTHON, "math": Names(MATH), "python": Names(PYTHON)}
_GLOBALS["dotify"] = XACRO["dotify"]
_UNSPACED = ("load_yaml", "abs_filename")  # known without "xacro.", too


def literal(value: Value) -> Value:
    """Converts text to a number or truth value if it is one, and strips single quotes."""
    if not isinstance(value, str):
        return value
    if len(value) >= 2 and value[0] == value[-1] == "'":
        return value[1:-1]
    if "_" in value:  # Python would read 1_0 as ten
        return value
    for kind in (int, float, truth):
        try:
            return kind(value)
        except (ValueError, Fault):
            pass
    return value


def truth(value: Value) -> bool:
    """Evaluates a condition.

    Raises:
        Fault: it is text other than true, false or a whole number.
    """
    if not isinstance(value, str):
        return bool(value)
    if value in ("true", "True", "false", "False"):
        return value in ("true", "True")
    try:
        return bool(int(value))
    except ValueError:
        raise Fault(f"{value[:60]!r} is neither true nor false") from None
