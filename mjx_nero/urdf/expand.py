"""Xacro to URDF, with includes from the given folders only and expressions that can only calculate.

Xacro evaluates Python expressions and opens any file, so a stranger's xacro file would be a stranger's program. Here includes are
put in place beforehand, and what is left must be arithmetic.
"""

import ast
import contextlib
import importlib
import io
import pathlib
import re

from lxml import etree

from mjx_nero.types import UserError
from mjx_nero.urdf import files

_URI = "http://www.ros.org/wiki/xacro"
_DEPTH = 20
_MAX_INCLUDED = 1_000_000  # bytes after inclusion: xacro is slow
_FUNCTIONS = (
    "abs acos asin atan atan2 ceil cos degrees exp float floor fmod hypot int len log max min pow radians round sin sqrt str tan"
)
_NODES: tuple[type, ...] = (
    ast.Expression, ast.BinOp, ast.UnaryOp, ast.BoolOp, ast.Compare, ast.IfExp, ast.Constant, ast.Name, ast.Load, ast.Call,
    ast.Subscript, ast.List, ast.Tuple, ast.operator, ast.unaryop, ast.boolop, ast.cmpop,
)  # fmt: skip


def is_xacro(root: etree._Element) -> bool:
    """Whether there is anything for xacro to do."""
    return any(isinstance(e.tag, str) and e.tag.startswith(f"{{{_URI}}}") for e in root.iter())


def expand(root: etree._Element, path: pathlib.Path, roots: files.Roots) -> etree._Element:
    """The URDF that a xacro file describes.

    Raises:
        UserError: the package ``xacro`` is not installed, an include lies outside the folders, or an expression does more than
            arithmetic.
    """
    try:
        xacro = importlib.import_module("xacro")
    except ImportError:
        raise UserError(
            f"{path} is a xacro file: pip install xacro, or expand it yourself (xacro {path.name} > robot.urdf) and import that"
        ) from None
    _include(root, roots, 0)
    for element in root.iter():
        if isinstance(element.tag, str):
            for text in (element.text, element.tail, *element.attrib.values()):
                _check(text or "")
    text = etree.tostring(root, encoding="unicode")
    if len(text) > _MAX_INCLUDED:
        raise UserError(f"{path} has {len(text) / 1e6:.1f} MB with what it includes: expand it with xacro yourself")
    try:
        with contextlib.redirect_stderr(io.StringIO()):
            document = xacro.parse(text)
            xacro.process_doc(document)
    except (Exception, SystemExit) as error:
        raise UserError(f"{path}: xacro says: {' '.join(str(error).split()) or type(error).__name__}") from None
    return files.parse_xml(document.toxml(encoding="utf-8"), str(path))


def _include(root: etree._Element, roots: files.Roots, depth: int) -> None:
    """Replaces xacro:include by what it names, and ``$(find NAME)`` by ``package://NAME``."""
    if depth > _DEPTH:
        raise UserError(f"xacro files include one another more than {_DEPTH} deep: cut the loop")
    for element in list(root.iter()):
        if not isinstance(element.tag, str):
            continue
        for key, value in element.attrib.items():
            element.set(key, re.sub(r"\$\(find\s+([\w.-]+)\)", r"package://\1", value))
        if element.tag != f"{{{_URI}}}include":
            continue
        name, parent = element.get("filename") or "", element.getparent()
        if "$" in name or element.get("ns") or parent is None:
            raise UserError(f"xacro include {name!r}: only plain files are included; expand it with xacro yourself")
        try:
            path = roots.find(name)
        except files.Missing as error:
            raise UserError(f"xacro include {name!r}: {error}") from None
        inner = files.parse_xml(files.read(path, files.MAX_URDF), str(path))
        _include(inner, roots, depth + 1)
        place = parent.index(element)
        parent[place : place + 1] = list(inner)


def _check(text: str) -> None:
    rest = re.sub(r"\$\{([^{}]*)\}", lambda match: _checked(match[1]), text)
    rest = re.sub(r"\$\(arg\s+\w+\)", "", rest)
    if "$" in rest:
        raise UserError(f"xacro {text.strip()[:80]!r}: only ${{arithmetic}}, $(arg ...) and $(find ...) are expanded here")


def _checked(expression: str) -> str:
    try:
        tree = ast.parse(expression.strip(), mode="eval")
    except (SyntaxError, ValueError, RecursionError, MemoryError):
        raise UserError(f"xacro expression {expression[:80]!r} is not one") from None
    for node in ast.walk(tree):
        fine = isinstance(node, _NODES)
        if isinstance(node, ast.Name):
            fine = not node.id.startswith("_")
        elif isinstance(node, ast.Call):
            fine = isinstance(node.func, ast.Name) and node.func.id in _FUNCTIONS.split() and not node.keywords
        elif isinstance(node, ast.Constant):
            fine = not isinstance(node.value, str) or not set(node.value) & set("${}%")
        elif isinstance(node, ast.BinOp):
            fine = not isinstance(node.op, ast.Pow | ast.LShift | ast.Mod) or _small(node.right)
        if not fine:
            raise UserError(f"xacro expression {expression[:80]!r} does more than arithmetic: expand it with xacro yourself")
    return ""


def _small(node: ast.expr) -> bool:
    return isinstance(node, ast.Constant) and isinstance(node.value, int | float) and abs(node.value) < 10
