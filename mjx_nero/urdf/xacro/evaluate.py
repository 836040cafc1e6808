"""Evaluates expressions of xacro files, node by node.

It uses neither ``eval`` nor ``getattr``. A node without a rule here is refused. An attribute is a dictionary's key or a
namespace's name, and a function comes from ``functions`` or from the expander.
"""

import ast
import warnings
from collections.abc import Callable, Iterator, Mapping
from typing import Any

from mjx_nero import config
from mjx_nero.urdf.xacro.budget import Budget, Fault, Value
from mjx_nero.urdf.xacro.functions import METHODS, OPERATORS, Function, dictionary

_MAX_LENGTH = 4_000  # characters of an expression
_ROUND = 5  # evaluation steps charged per round of a comprehension
_PARSING = 10  # evaluation steps charged for parsing, plus one per four characters


class Namespace:
    """A thing with names of its own: ``math``, or an include with ``ns``."""

    def member(self, name: str) -> Any:
        """Looks up a value, function or namespace.

        Raises:
            KeyError: the name is unknown.
        """
        raise NotImplementedError


class Names(Namespace):
    """A namespace of fixed names."""

    def __init__(self, names: Mapping[str, Any]):
        self._names = names

    def member(self, name: str) -> Any:
        return self._names[name]


def evaluate(expression: str, lookup: Callable[[str], Any], budget: Budget) -> Value:
    """Computes the value of an expression.

    Args:
        lookup: name -> value, ``Function`` or ``Namespace``; KeyError if unknown.

    Raises:
        Fault: it is not an expression, does something without a rule here, fails, or exceeds a limit.
    """
    shown = expression.strip()[:80]
    if len(expression) > _MAX_LENGTH:
        raise Fault(f"an expression of more than {_MAX_LENGTH:,} characters: split it", shown)
    budget.spend("evaluation steps", _PARSING + len(expression) // 4)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of escapes in strings
            tree = ast.parse(expression.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise Fault("is not an expression", shown) from None
    try:
        return _Evaluation(lookup, budget).value(tree.body)
    except Fault as fault:
        raise Fault(
            fault.message, fault.expression or shown
        ) from None  # the innermost expression: properties are evaluated at their first use
    except KeyError as error:
        raise Fault(f"there is no {str(error)[:60]}", shown) from None
    except (TypeError, ValueError, ArithmeticError, IndexError, AttributeError) as error:
        raise Fault(str(error)[:120] or type(error).__name__, shown) from None


class _Evaluation:
    def __init__(self, lookup: Callable[[str], Any], budget: Budget):
        self._lookup = lookup
        self._budget = budget

    def value(self, node: ast.expr) -> Any:
        """A plain value, checked."""
        return self._budget.checked(self._meaning(node))

    def _meaning(self, node: ast.expr) -> Any:
        """A value, a function or a namespace."""
        self._budget.spend("evaluation steps")
        match node:
            case ast.Constant(value=bool() | int() | float() | str() | None):
                return node.value
            case ast.Name(id=name):
                return self._lookup(name)
            case ast.List(elts=items):
                return [self.value(i) for i in items]
            case ast.Tuple(elts=items):
                return tuple(self.value(i) for i in items)
            case ast.Dict(keys=keys, values=values) if None not in keys:
                pairs = zip(keys, values, strict=True)
                return dictionary([(self.value(k), self.value(v)) for k, v in pairs if k])
            case ast.ListComp(elt=item) | ast.GeneratorExp(elt=item):
                return [inner.value(item) for inner in self._rounds(node.generators)]
            case ast.DictComp(key=key, value=value):
                return dictionary([(inner.value(key), inner.value(value)) for inner in self._rounds(node.generators)])
            case ast.UnaryOp(op=op, operand=operand):
                return OPERATORS[type(op)](self.value(operand))
            case ast.BinOp(left=left, op=op, right=right) if type(op) in OPERATORS:
                return OPERATORS[type(op)](self.value(left), self.value(right))
            case ast.BoolOp(op=op, values=values):
                return self._either(isinstance(op, ast.Or), values)
            case ast.Compare():
                return self._compared(node)
            case ast.IfExp(test=test, body=body, orelse=orelse):
                return self._meaning(body if self.value(test) else orelse)
            case ast.Subscript(value=items, slice=index):
                return self._item(self.value(items), index)
            case ast.Attribute(value=owner, attr=name):
                return self._member(self._meaning(owner), name)
            case ast.Call():
                return self._called(node)
        raise Fault(f"{type(node).__name__} is not supported: only values, operators and known functions are")

    def _either(self, stop: bool, nodes: list[ast.expr]) -> Any:
        value = None
        for node in nodes:
            value = self.value(node)
            if bool(value) is stop:
                break
        return value

    def _compared(self, node: ast.Compare) -> Any:
        left, outcome = self.value(node.left), True
        for op, operand in zip(node.ops, node.comparators, strict=True):
            right = self.value(operand)
            outcome = OPERATORS[type(op)](left, right)
            if not outcome:
                break
            left = right
        return outcome

    def _item(self, items: Any, index: ast.expr) -> Any:
        if isinstance(index, ast.Slice):
            bounds = (None if b is None else self.value(b) for b in (index.lower, index.upper, index.step))
            return items[slice(*bounds)]
        return items[self.value(index)]

    def _member(self, owner: Any, name: str) -> Any:
        if isinstance(owner, Namespace):
            return owner.member(name)
        if type(owner) is not dict:
            raise Fault(f"a {type(owner).__name__.lower()} has no attribute {name!r} here: only dictionaries have, their keys")
        return owner[name]

    def _called(self, node: ast.Call) -> Any:
        if any(isinstance(a, ast.Starred) for a in node.args) or any(k.arg is None for k in node.keywords):
            raise Fault("* and ** in calls are not supported")
        if isinstance(node.func, ast.Name) and node.func.id == "map":
            return self._mapped(*node.args)
        call = self._callee(node.func)
        positional = [self.value(a) for a in node.args]
        return call(*positional, **{str(k.arg): self.value(k.value) for k in node.keywords})

    def _mapped(self, function: ast.expr, *lists: ast.expr) -> list[Any]:
        """``map``, whose first argument is the one place where a function is named and not called."""
        call, out = self._callee(function), []
        for row in zip(*map(self.value, lists), strict=False):
            self._budget.spend("evaluation steps", _ROUND)
            out.append(self._budget.checked(call(*row)))
        return out

    def _callee(self, node: ast.expr) -> Callable[..., Any]:
        if isinstance(node, ast.Attribute):
            owner = self._meaning(node.value)
            if not isinstance(owner, Namespace):
                owner = self._budget.checked(owner)
                methods = METHODS.get(type(owner), {})
                if node.attr not in methods:
                    raise Fault(f"a {type(owner).__name__} has no method {node.attr!r} here{config.hint(node.attr, methods)}")
                method = methods[node.attr]
                return lambda *args, **named: method(owner, *args, **named)
            found = owner.member(node.attr)
        elif isinstance(node, ast.Name):
            found = self._lookup(node.id)
        else:
            raise Fault("only functions that have a name are called")
        if not isinstance(found, Function):
            raise Fault(f"{ast.unparse(node)[:60]!r} is not a function")
        return found.call

    def _rounds(self, generators: list[ast.comprehension]) -> Iterator["_Evaluation"]:
        """The rounds of a comprehension, each with its names."""
        if not generators:
            yield self
            return
        first, *rest = generators
        for item in list(self.value(first.iter)):
            self._budget.spend("evaluation steps", _ROUND)
            inner = _Evaluation(_with(_bound(first.target, item), self._lookup), self._budget)
            if all(inner.value(condition) for condition in first.ifs):
                yield from inner._rounds(rest)


def _with(names: dict[str, Any], lookup: Callable[[str], Any]) -> Callable[[str], Any]:
    return lambda name: names[name] if name in names else lookup(name)


def _bound(target: ast.expr, item: Any) -> dict[str, Any]:
    if isinstance(target, ast.Name):
        return {target.id: item}
    if not isinstance(target, ast.Tuple) or not all(isinstance(t, ast.Name) for t in target.elts):
        raise Fault("a comprehension binds names only")
    return {t.id: i for t, i in zip(target.elts, item, strict=True) if isinstance(t, ast.Name)}
