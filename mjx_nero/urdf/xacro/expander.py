"""Expands the elements of xacro files (properties, arguments, includes, conditions and macros) into a new document."""

import pathlib
import re
from collections.abc import Callable, Mapping
from typing import Any

from lxml import etree

from mjx_nero import config
from mjx_nero.types import UserError
from mjx_nero.urdf import files
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.xacro import yaml_file
from mjx_nero.urdf.xacro.budget import Fault, Value
from mjx_nero.urdf.xacro.macro import Macro, filled, parameters
from mjx_nero.urdf.xacro.scope import Scope, Surroundings, truth

URIS = ("http://www.ros.org/wiki/xacro", "http://ros.org/wiki/xacro", "http://wiki.ros.org/xacro")
_MAX_INCLUDES = 20  # nested files
_MAX_DEPTH = 100  # nested elements, macros and files, all together
_YAML_BYTES = 20  # a byte of YAML costs as much as this many of XML
# Files about simulators, a real robot's drives or its sensors, which an import does not need.
_EXTRAS = re.compile(
    r"gazebo|ign(ition)?_|isaac|ros_?2?_?control|transmission|simulat|hardware"
    r"|camera|sensor|lidar|laser|imu\b|realsense|kinect|d4\d5",
    re.IGNORECASE,
)
_BARE = {"if", "include", "insert_block", "macro", "property", "unless"}  # had no prefix in xacro's first version
_UNUSED = ("gazebo", "ros2_control", "transmission")  # elements about the same
_XML_NAME = re.compile(r"[A-Za-z_][\w.-]*")


def is_xacro(root: etree._Element) -> bool:
    """True if the document needs xacro."""
    return any(_unprefixed(str(e.tag), e) for e in root.iter() if isinstance(e.tag, str)) or _declared(root)


def expand(root: etree._Element, path: pathlib.Path, roots: files.Roots, args: Mapping[str, str], notes: Notes) -> etree._Element:
    """Expands a xacro file to the URDF that it describes.

    Args:
        args: values of ``xacro:arg``, instead of their defaults.

    Raises:
        UserError: one line that names the file, the construct, and what is wrong with it.
    """
    expander = _Expander(path, roots, args)
    try:
        out = expander.document(root)
    except (RecursionError, MemoryError):
        raise UserError(f"{path.name}: macros and expressions nest too deep in one another") from None
    unknown = [name for name in args if name not in expander.asked]
    if unknown:
        there = f"; it has {', '.join(sorted(expander.asked)[:12])}" if expander.asked else ""
        raise UserError(f"--arg {unknown[0]}: {path.name} has no such argument{config.hint(unknown[0], expander.asked)}{there}")
    if expander.left_out:
        names = sorted(expander.left_out)
        more = f" and {len(names) - 8} more" if len(names) > 8 else ""
        notes.add("note", "robot", str(out.get("name") or path.stem), f"left out: {', '.join(names[:8])}{more}")
    if out.find("link") is None and expander.macros:
        known = ", ".join(list(expander.macros)[:5])
        raise UserError(
            f"{path.name} only defines macros ({known}) or calls none that has links: import the file that calls them"
        )
    return out


def _own(element: etree._Element) -> str:
    """Name of a xacro element, which old files write without the prefix; empty for others."""
    tag = str(element.tag)
    return tag if tag in _BARE else _unprefixed(tag, element)


def _unprefixed(name: str, element: etree._Element) -> str:
    """A name of xacro's without its prefix; empty for others. What address ``xacro:`` stands for does not matter, as in xacro."""
    uri, brace, plain = name.removeprefix("{").partition("}")
    if brace:
        return plain if uri in URIS or uri == element.nsmap.get("xacro") else ""
    return name.removeprefix("xacro:") if name.startswith("xacro:") else ""


def _declared(root: etree._Element) -> bool:
    return any(uri in URIS for uri in root.nsmap.values())


class _Expander(Surroundings):
    """State of one expansion. It has one method per element of the language, which makes the module longer than others."""

    def __init__(self, path: pathlib.Path, roots: files.Roots, args: Mapping[str, str]):
        own = {"load_yaml": self._load_yaml, "abs_filename": self._abs_filename, "arg": self._arg_value}
        super().__init__(path, args, own)
        self.left_out: set[str] = set()
        self.macros: dict[str, None] = {}  # names, in order
        self._bare: set[str] = set()  # macros that old files call without the prefix, as they define them
        self._roots = roots
        self._depth = 0
        self._documents: dict[pathlib.Path, etree._Element] = {}
        self._yaml: dict[pathlib.Path, Value] = {}
        self._rules: dict[str, Callable[[etree._Element, etree._Element, Scope], None]] = {
            "arg": self._arg,
            "attribute": self._attribute,
            "call": self._dynamic_call,
            "element": self._named_element,
            "if": self._if,
            "include": self._include,
            "insert_block": self._insert_block,
            "macro": self._macro,
            "property": self._property,
            "unless": self._if,
        }

    def document(self, root: etree._Element) -> etree._Element:
        """Expands the outermost element, its attributes last: they may name arguments that the content declares."""
        scope = Scope(self)
        self._gather(root)
        try:
            out = _outermost(root)
            self._children(root, out, scope)
            self._attributes(root, out, scope)
        except Fault as fault:
            raise self._located(root, fault) from None
        return out

    def _gather(self, root: etree._Element) -> None:
        for child in root:
            if isinstance(child.tag, str) and _own(child) == "property" and child.get("name") and child.get("value"):
                self.later.setdefault(child.get("name"), child.get("value"))

    def _element(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        """Appends to ``target`` what an element expands to."""
        try:
            self.budget.spend("expanded elements")
            name, tag = _own(element), str(element.tag)
            if name:
                self._rules.get(name, self._call)(element, target, scope)
            elif tag in self._bare:
                self._call(element, target, scope, tag)
            elif ":" in tag and not tag.startswith("{"):
                self.left_out.add(f"<{tag[:60]}> (its prefix is not declared)")
            else:
                self._copy(element, tag, target, scope)
        except Fault as fault:
            raise self._located(element, fault) from None

    def _located(self, element: etree._Element, fault: Fault) -> UserError:
        file = pathlib.Path(element.getroottree().docinfo.URL or self.stack[-1]).name
        named = "".join(f' {k}="{v[:40]}"' for k, v in element.attrib.items() if k in ("name", "filename", "macro"))
        tag = f"{element.prefix or ''}:{str(element.tag).rpartition('}')[2]}".removeprefix(":")
        return UserError(f"{file}, line {element.sourceline}, <{tag[:60]}{named}>: {fault}")

    def _copy(self, element: etree._Element, tag: str, target: etree._Element, scope: Scope) -> None:
        """An element of the URDF, without xacro's own attributes and those of undeclared prefixes."""
        out, depth, files_open = etree.SubElement(target, tag), self._depth, len(self.stack)
        try:
            self._attributes(element, out, scope)
            self._children(element, out, scope)
        except (Fault, UserError) as error:
            if tag not in _UNUSED:
                raise
            target.remove(out)
            self.left_out.add(f"<{tag}>, as {str(error)[:200]}")
            self._depth = depth
            del self.stack[files_open:]

    def _attributes(self, element: etree._Element, out: etree._Element, scope: Scope) -> None:
        for key, text in element.attrib.items():
            if not _unprefixed(key, element) and (key.startswith("{") or ":" not in key):
                self._set(out, key, scope.string(text))

    def _set(self, out: etree._Element, key: str, value: str) -> None:
        self.budget.spend("characters of text", len(value))
        try:
            out.set(key, value)
        except ValueError:
            raise Fault(f"{key}={value[:60]!r} cannot stand in XML") from None

    def _children(self, source: etree._Element, target: etree._Element, scope: Scope) -> None:
        """Appends to ``target`` what the content of ``source`` expands to. Comments and processing instructions are dropped."""
        self._depth += 1
        if self._depth > _MAX_DEPTH:
            raise Fault(f"elements, macros and files nest more than {_MAX_DEPTH} deep: does a macro call itself?")
        self._append(target, source.text, scope)
        for child in source:
            if isinstance(child.tag, str):
                self._element(child, target, scope)
            self._append(target, child.tail, scope)
        self._depth -= 1

    def _append(self, target: etree._Element, text: str | None, scope: Scope) -> None:
        if text is None or not text.strip():
            return
        value = scope.string(text)
        self.budget.spend("characters of text", len(value))
        try:
            if len(target):
                target[-1].tail = (target[-1].tail or "") + value
            else:
                target.text = (target.text or "") + value
        except ValueError:
            raise Fault(f"{value[:60]!r} cannot stand in XML") from None

    def _arg(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        name, default = _needed(element, "name"), element.get("default")
        self.asked.add(name)
        if default is not None and name not in self.args:
            self.args[name] = scope.string(default)

    def _attribute(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        name = scope.string(_needed(element, "name"))
        self._set(target, _plain_name(name), scope.string(_needed(element, "value")))

    def _named_element(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        name = next((text for key, text in element.attrib.items() if _unprefixed(key, element) == "name"), None)
        if name is None:
            raise Fault("has no xacro:name")
        self._copy(element, _plain_name(scope.string(name)), target, scope)

    def _if(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        if truth(scope.text(_needed(element, "value"))) is (_own(element) == "if"):
            self._children(element, target, scope)

    def _insert_block(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        name = _needed(element, "name")
        for key in (f"**{name}", f"*{name}"):
            holder = scope.holder("blocks", key)
            if holder is not None:
                block = holder.blocks[key]
                return self._children(block, target, scope) if key[1] == "*" else self._element(block, target, scope)
        raise Fault(f"there is no block {name!r}")

    def _property(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        name = scope.string(_needed(element, "name"))
        if not name.isidentifier() or name.startswith("__"):
            raise Fault(f"{name[:60]!r} cannot be a property's name: letters, digits and _ can")
        value, default, where = element.get("value"), element.get("default"), element.get("scope")
        if truth(scope.text(element.get("remove", "false"))):
            holder = scope.holder("properties", name)
            while holder is not None:
                del holder.properties[name]
                holder = scope.holder("properties", name)
            return
        if default is not None:
            if scope.holder("properties", name) is not None:
                return
            value = default
        lazy = truth(scope.text(element.get("lazy_eval", "true"))) and where not in ("parent", "global")
        home: Scope | None = scope
        if where == "global":
            home = scope.outermost()
        elif where == "parent":
            home = scope.parent
            while home is not None and home.named and not scope.named:
                home = home.parent
        if home is None:
            return  # the document has no parent
        if value is None:
            home.blocks[f"**{name}"] = element
        else:
            home.set(name, value if lazy else scope.text(value), lazy)

    def _include(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        name, ns = scope.string(_needed(element, "filename")), element.get("ns")
        try:
            path = self._roots.find(name, self.folder)
            root = self._document(path)
        except files.Missing as error:
            if truth(element.get("optional", "false")):
                return
            if not _EXTRAS.search(name):
                raise Fault(f"{name[:120]!r}: {error}") from None
            self.left_out.add(f"include of {name[:120]} (missing)")
            return
        except UserError as error:
            raise Fault(str(error)) from None
        if len(self.stack) > _MAX_INCLUDES:
            raise Fault(f"files include one another more than {_MAX_INCLUDES} deep: cut the loop")
        if ns is not None:
            inner = Scope(self, scope, named=True)
            scope.properties[scope.string(ns)] = inner
            scope = inner
        self.stack.append(path)
        self._children(root, target, scope)
        self.stack.pop()

    def _document(self, path: pathlib.Path) -> etree._Element:
        self.budget.spend("included files")
        if path not in self._documents:
            content = files.read(path, files.MAX_URDF)
            self.budget.spend("included bytes", len(content))
            self._documents[path] = files.parse_xml(content, str(path))
            self._gather(self._documents[path])
        return self._documents[path]

    def _load_yaml(self, name: Any) -> Value:
        try:
            path = self._roots.find(str(name), self.folder)
            if path not in self._yaml:
                self.budget.spend("included bytes", _YAML_BYTES * path.stat().st_size)
                self._yaml[path] = yaml_file.values(path, self.budget)
        except (files.Missing, UserError) as error:
            raise Fault(f"load_yaml of {str(name)[:120]!r}: {error}") from None
        return self._yaml[path]

    def _arg_value(self, name: Any) -> str:
        self.asked.add(str(name))
        return self.args[name]

    def _abs_filename(self, name: Any) -> str:
        return str(name) if "://" in str(name) else str(self.folder / str(name))

    def _macro(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        name = _needed(element, "name").removeprefix("xacro:")
        if not name or name == "call" or "." in name:
            raise Fault(f"{name[:60]!r} cannot be a macro's name")
        scope.macros[name] = Macro(name, parameters(element.get("params", "")), element)
        self.macros[name] = None
        if element.tag == "macro":
            self._bare.add(name)

    def _dynamic_call(self, element: etree._Element, target: etree._Element, scope: Scope) -> None:
        self._call(element, target, scope, scope.string(_needed(element, "macro")))

    def _call(self, element: etree._Element, target: etree._Element, scope: Scope, name: str = "") -> None:
        dynamic, name = bool(name), name or _own(element)
        *spaces, last = name.split(".")
        home: Scope | None = scope
        for space in spaces:
            holder = home.holder("properties", space) if home else None
            found = holder.properties[space] if holder else None
            home = found if isinstance(found, Scope) else None
        holder = home.holder("macros", last) if home else None
        if home is None or holder is None:
            if _EXTRAS.search(name) and self.left_out:
                self.left_out.add(f"macro {name[:60]}")
                return
            raise Fault(f"there is no macro {name[:60]!r}{config.hint(last, self.macros)}")
        macro = holder.macros[last]
        attributes = {k: v for k, v in element.attrib.items() if not k.startswith("{") and not (dynamic and k == "macro")}
        blocks = etree.Element("blocks")
        self._children(element, blocks, scope)
        given = {key: scope.text(text) for key, text in attributes.items()}
        inner = filled(macro, given, [b for b in blocks if isinstance(b.tag, str)], scope, home)
        self._children(macro.body, target, inner)


def _outermost(root: etree._Element) -> etree._Element:
    try:
        return etree.Element(str(root.tag))
    except ValueError:  # a prefix that is not declared
        raise Fault("cannot be the outermost element: <robot> is") from None


def _needed(element: etree._Element, attribute: str) -> str:
    value = element.get(attribute)
    if value is None:
        raise Fault(f"has no {attribute}")
    return value


def _plain_name(name: str) -> str:
    if not _XML_NAME.fullmatch(name):
        raise Fault(f"{name[:60]!r} cannot be a name here: letters, digits, _, - and . can")
    return name
