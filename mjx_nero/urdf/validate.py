"""Checks the XML of a URDF before use: names, references within a joint, and numbers."""

from collections import Counter

from lxml import etree

from mjx_nero.types import UserError
from mjx_nero.urdf.report import Notes

MAX_ELEMENTS = 5_000  # links and joints
MAX_NUMBER = 1e6  # [m, kg]
MAX_NAME = 150  # characters; scenes and models append to names
CAPSULE = "capsule"
_SHAPES = ("box", "capsule", "cylinder", "sphere", "mesh")
# tag -> attribute -> how many numbers it holds; None: 1 or 3
_NUMBERS: dict[str, dict[str, int | None]] = {
    "origin": {"xyz": 3, "rpy": 3},
    "axis": {"xyz": 3},
    "mass": {"value": 1},
    "inertia": dict.fromkeys(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), 1),
    "box": {"size": 3},
    "capsule": {"radius": 1, "length": 1},
    "cylinder": {"radius": 1, "length": 1},
    "sphere": {"radius": 1},
    "mesh": {"scale": None},
    "limit": dict.fromkeys(("lower", "upper", "effort", "velocity"), 1),
    "dynamics": {"damping": 1, "friction": 1},
    "mimic": {"multiplier": 1, "offset": 1},
    "color": {"rgba": 4},
}
_NEEDED = {
    "box": ("size",),
    "capsule": ("radius", "length"),
    "cylinder": ("radius", "length"),
    "sphere": ("radius",),
    "mesh": ("filename",),
}
_REPAIRED = ("mass", "inertia", "limit", "dynamics", "color")  # elements whose non-finite numbers are repaired


def check(root: etree._Element, notes: Notes) -> None:
    """Checks the XML in place, drops what the importer does not use, and normalises numbers.

    Raises:
        UserError: a name is missing or repeated, a joint lacks links, or a number is malformed.
    """
    etree.strip_tags(root, etree.Comment)
    etree.strip_elements(root, etree.ProcessingInstruction, with_tail=False)
    for element in list(root):
        if element.tag not in ("link", "joint", "material"):
            root.remove(element)
    prefixed = {tag for tag in (e.tag for e in root.iter()) if ":" in tag and not tag.startswith("{")}
    if prefixed:
        etree.strip_elements(root, *prefixed, with_tail=False)
        notes.add("note", "robot", root.get("name"), f"left out: {len(prefixed)} tags whose prefixes are not declared")
    elements = root.findall("link") + root.findall("joint")
    if len(elements) > MAX_ELEMENTS:
        raise UserError(f"{len(elements)} links and joints: more than {MAX_ELEMENTS} are not read")
    for kind in ("link", "joint"):
        names = [(e.get("name") or "").strip() for e in root.findall(kind)]
        if "" in names:
            raise UserError(f"the {kind} number {names.index('') + 1} has no name: give it one")
        for name in names:
            if len(name) > MAX_NAME or not name.isprintable():
                raise UserError(f"{kind} {name[:60]!r} has control characters in its name, or more than {MAX_NAME}: rename it")
        for name, count in Counter(names).items():
            if count > 1:
                raise UserError(f"{count} {kind}s are called {name!r}: give each a name of its own")
    for element in elements:
        kind, name = element.tag, element.get("name").strip()
        element.set("name", name)
        for tag in ("parent", "child") if kind == "joint" else ():
            if element.find(tag) is None or not (element.find(tag).get("link") or "").strip():
                raise UserError(f"joint {name!r} has no {tag} link: add <{tag} link=.../>")
            element.find(tag).set("link", element.find(tag).get("link").strip())
        for shape in element.findall("visual") + element.findall("collision"):
            reason = _unusable(shape)
            if reason:
                notes.add("warning", kind, name, f"{shape.tag} left out: {reason}")
                element.remove(shape)
        for part in element.iter():
            _check_numbers(part, kind, name)
        for shape in element.findall("visual") + element.findall("collision"):
            _name_capsule(shape)
        for tensor in element.iter("inertia"):
            for axis in ("ixx", "iyy", "izz"):
                tensor.set(axis, tensor.get(axis, "0"))  # yourdfpy would make it 1 kg m2


def _unusable(shape: etree._Element) -> str:
    geometry = shape.find("geometry")
    kinds = [] if geometry is None else [e.tag for e in geometry]
    if not kinds or kinds[0] not in _SHAPES:
        return f"its geometry is {kinds[0] if kinds else 'missing'}: {', '.join(_SHAPES)} are known"
    lacking = [a for a in _NEEDED[kinds[0]] if not (geometry[0].get(a) or "").strip()]
    return f"its {kinds[0]} has no {lacking[0]}" if lacking else ""


def _name_capsule(shape: etree._Element) -> None:
    """Turns a capsule into a cylinder whose visual or collision is called ``CAPSULE``, because yourdfpy reads no capsules."""
    solid = shape.find("geometry")[0]
    shape.attrib.pop("name", None)
    if solid.tag == CAPSULE:
        shape.set("name", CAPSULE)
        solid.tag = "cylinder"


def _check_numbers(part: etree._Element, kind: str, name: str) -> None:
    for attribute, count in _NUMBERS.get(str(part.tag), {}).items():
        text = part.get(attribute)
        if text is None:
            continue
        where = f"{kind} {name!r}: {part.tag} {attribute}={text[:60]!r}"
        try:
            values = [float(v) for v in text.replace(",", " ").replace("_", "x").split()]  # Python would take 1_0 for ten
        except ValueError:
            raise UserError(f"{where} is not numbers: correct it") from None
        if len(values) not in ((1, 3) if count is None else (count,)):
            raise UserError(f"{where} takes {'1 or 3' if count is None else count} numbers: correct it")
        if part.tag not in _REPAIRED and not all(abs(v) <= MAX_NUMBER for v in values):
            raise UserError(f"{where} is not finite or beyond {MAX_NUMBER:g}: correct it")
        part.set(attribute, " ".join(map(repr, values)))
