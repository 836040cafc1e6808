"""Reader of an imported robot's ``model.xml``. The file may be untrusted, so an allow-list and limits come before MuJoCo.

The list allows what ``import-urdf`` writes and what people add by hand: bodies, joints, primitives and meshes with their defaults
and materials, couplings of joints. Drives, sensors and options belong to the scene.
"""

import pathlib

import mujoco
from lxml import etree

from mjx_nero import files
from mjx_nero.config.values import hint, short
from mjx_nero.types import UserError

MAX_XML = 5_000_000  # bytes
MAX_MESHES = 500  # files
MAX_MESH_BYTES = 200_000_000  # all together
MAX_NUMBER = 1e9
MAX_WORD = 200  # characters of a name
_POSE = "pos quat euler axisangle xyaxes zaxis "
_SOLVER = "solref solimp margin "
_ALLOWED = {
    tag: set(attributes.split())
    for tag, attributes in {
        "mujoco": "model",
        "compiler": "angle autolimits eulerseq meshdir inertiafromgeom balanceinertia boundmass boundinertia",
        "default": "class",
        "asset": "",
        "worldbody": "",
        "contact": "",
        "equality": "",
        "mesh": "name class file scale refpos refquat maxhullvert inertia",
        "material": "name class rgba specular shininess reflectance emission metallic roughness",
        "frame": _POSE + "name childclass",
        "body": _POSE + "name childclass gravcomp",
        "inertial": _POSE + "mass diaginertia fullinertia",
        "joint": _SOLVER + "name class group type axis pos range limited ref stiffness springref damping frictionloss armature "
        "solreflimit solimplimit solreffriction solimpfriction actuatorfrcrange actuatorfrclimited "
        "joint1 joint2 polycoef active",  # these belong to a coupling
        "geom": _POSE + _SOLVER + "name class type size fromto mesh fitscale material rgba group mass density shellinertia "
        "contype conaffinity condim priority friction solmix gap",
        "site": _POSE + "name class type size fromto group material rgba",
        "exclude": "name body1 body2",
    }.items()
}
_WORDS = set(
    "model angle autolimits eulerseq meshdir inertiafromgeom balanceinertia class name file inertia childclass type limited "
    "actuatorfrclimited joint1 joint2 active mesh material shellinertia body1 body2".split()
)
_TYPES = {"joint": ("hinge", "slide"), "geom": ("sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")}
_SCENES = {"body": ("world", "cube", "goal"), "joint": ("cube",), "geom": ("table", "table_top", "cube", "goal")}


def read(path: pathlib.Path) -> mujoco.MjSpec:
    """Reads a model and the meshes in its folder.

    Raises:
        UserError: a file is missing, damaged or too large, lies outside the folder, or holds something that is not allowed.
    """
    root = files.parse_xml(files.read_bytes(path, MAX_XML), str(path))
    if root.tag != "mujoco":
        raise UserError(f"{path} is not a model: its outermost element is <{root.tag}>, not <mujoco>")
    etree.strip_tags(root, etree.Comment, etree.ProcessingInstruction)
    for element in root.iter():
        _check(element, f"{path}, line {element.sourceline}")
    text = etree.tostring(root, encoding="unicode")
    try:
        return mujoco.MjSpec.from_string(text, assets=_meshes(root, path))
    except ValueError as error:
        raise UserError(f"{path} is not a valid model: {error}") from None


def _check(element: etree._Element, where: str) -> None:
    tag = str(element.tag)
    if tag not in _ALLOWED:
        raise UserError(f"{where}: <{tag[:40]}> is not allowed in a robot's model: remove it (robot.yaml has the drives)")
    for name, value in element.attrib.items():
        if name not in _ALLOWED[tag]:
            raise UserError(f"{where}: <{tag}> takes no {str(name)[:40]!r}{hint(str(name), _ALLOWED[tag])}: remove it")
        if name in _WORDS:
            if len(value) > MAX_WORD or not value.isprintable():
                raise UserError(f"{where}: {name}={short(value)} is longer than {MAX_WORD} or has control characters")
        elif not all(_is_number(v) for v in value.split()):
            raise UserError(f"{where}: {name}={short(value)} is not numbers up to {MAX_NUMBER:g}: correct it")
    kind, name = element.get("type"), element.get("name")
    if kind is not None and kind not in _TYPES.get(tag, (kind,)):
        raise UserError(f"{where}: <{tag} type={short(kind)}> is not supported: choose from {', '.join(_TYPES[tag])}")
    if name in _SCENES.get(tag, ()):
        raise UserError(f"{where}: {tag} {name!r} has a name that scenes use: rename it")


def _is_number(text: str) -> bool:
    try:
        return abs(float(text)) <= MAX_NUMBER and "_" not in text
    except ValueError:
        return False


def _meshes(root: etree._Element, path: pathlib.Path) -> dict[str, bytes]:
    """Reads the meshes: name as MuJoCo asks for it -> content."""
    folders = [e.get("meshdir") for e in root.iter("compiler") if e.get("meshdir")]
    names = {e.get("file") for e in root.iter("mesh")} - {None}
    if len(names) > MAX_MESHES:
        raise UserError(f"{path} names {len(names)} meshes: at most {MAX_MESHES} are read")
    out: dict[str, bytes] = {}
    home, left = path.parent.resolve(), MAX_MESH_BYTES
    for name in sorted(map(str, names)):
        inner, shown = pathlib.PurePosixPath(folders[-1] if folders else "", name), f"{path}: mesh file {short(name)}"
        if "\\" in name or inner.is_absolute() or ".." in inner.parts or inner.suffix.lower() not in (".stl", ".obj"):
            raise UserError(f"{shown} is not a .stl or .obj file below the model's folder: change it")
        try:
            real = home.joinpath(inner).resolve()
        except (OSError, RuntimeError) as error:
            raise UserError(f"{shown} cannot be read: {error}") from None
        if not real.is_relative_to(home):
            raise UserError(f"{shown} is a link out of the model's folder: copy it there")
        out[name] = files.read_bytes(real, left)
        left -= len(out[name])
    return out
