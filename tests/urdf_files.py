"""URDFs for the tests, written with meshes of their own."""

from collections.abc import Iterable
from pathlib import Path

import trimesh
from lxml import etree

NERO = Path(__file__).resolve().parents[1] / "assets" / "nero" / "nero.xml"

ROOM = 'lower="-2.9" upper="2.9" effort="80" velocity="2"'
SLIDE = {"type": "prismatic", "limit": 'lower="0.01" upper="0.05" effort="20" velocity="0.2"'}

# Joint frames, axes, limits and masses of AgileX's Piper with gripper (piper_gripper.urdf of agilexrobotics/Agilex-College).
# link, joint, type, parent, xyz, rpy, axis, limits, mass
_PIPER = """
base_link - - - 0 0 0 0 0 0 0 0 1 0 0 1.02
link1 joint1 revolute base_link 0 0 0.123 0 0 0 0 0 1 -2.6179938 2.6179938 0.71
link2 joint2 revolute link1 0 0 0 1.5707963 -0.1357866 -3.1415926 0 0 1 0 3.1415926 1.16
link3 joint3 revolute link2 0.28503 0 0 0 0 -1.7938494 0 0 1 -2.9670597 0 0.5
link4 joint4 revolute link3 -0.02198 -0.25075 0 1.5707963 0 0 0 0 1 -1.7453292 1.7453292 0.38
link5 joint5 revolute link4 0 0 0 -1.5707963 0 0 0 0 1 -1.2217304 1.2217304 0.383
link6 joint6 revolute link5 8.8259E-05 -0.091 0 1.5707963 0 0 0 0 1 -2.0943951 2.0943951 0.007
gripper_base base_joint fixed link6 0 0 0 0 0 0 0 0 1 0 0 0.45
gripper_link1 gripper_joint1 prismatic gripper_base 0 0 0.1358 1.5707963 0 0 0 0 1 0 0.05 0.025
gripper_link2 gripper_joint2 prismatic gripper_base 0 0 0.1358 1.5707963 0 -3.1415926 0 0 -1 -0.05 0 0.025
"""
PIPER = {line.split()[0]: line.split()[1:] for line in _PIPER.strip().splitlines()}


def inertial(mass: float = 1.0, com: str = "0 0 0", moments: str = "", rpy: str = "0 0 0") -> str:
    """``moments``: ixx ixy ixz iyy iyz izz."""
    values = moments.split() or [str(0.001 * mass), "0", "0", str(0.001 * mass), "0", str(0.001 * mass)]
    tensor = " ".join(f'{k}="{v}"' for k, v in zip(("ixx", "ixy", "ixz", "iyy", "iyz", "izz"), values, strict=True))
    return f'<inertial><origin xyz="{com}" rpy="{rpy}"/><mass value="{mass}"/><inertia {tensor}/></inertial>'


def shape(geometry: str, tag: str = "collision", xyz: str = "0 0 0", rpy: str = "0 0 0") -> str:
    return f'<{tag}><origin xyz="{xyz}" rpy="{rpy}"/><geometry>{geometry}</geometry></{tag}>'


def mesh(file: str, tag: str = "collision", scale: str = "1 1 1") -> str:
    return shape(f'<mesh filename="{file}" scale="{scale}"/>', tag)


def link(name: str, *inner: str) -> str:
    return f'<link name="{name}">{"".join(inner)}</link>'


def joint(
    name: str,
    parent: str,
    child: str,
    type: str = "revolute",
    xyz: str = "0 0 0.1",
    rpy: str = "0 0 0",
    axis: str = "0 0 1",
    limit: str = 'lower="-1" upper="1" effort="10" velocity="2"',
    inner: str = "",
) -> str:
    limits = f"<limit {limit}/>" if limit and type != "fixed" else ""
    return (
        f'<joint name="{name}" type="{type}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limits}{inner}</joint>'
    )


def robot(*parts: str, name: str = "arm") -> str:
    return f'<?xml version="1.0"?>\n<robot name="{name}">\n' + "\n".join(parts) + "\n</robot>\n"


def arm(joints: int = 3, *more: str) -> str:
    """A chain of revolute joints with alternating axes, base ``base``, links ``l1`` ..., joints ``j1`` ..."""
    names = ["base", *(f"l{i + 1}" for i in range(joints))]
    links = [link(n, inertial(), shape('<box size="0.04 0.04 0.2"/>', xyz="0 0 0.1")) for n in names]
    axes = ("0 0 1", "0 1 0")
    chain = [joint(f"j{i + 1}", names[i], names[i + 1], xyz="0 0 0.2", axis=axes[i % 2]) for i in range(joints)]
    return robot(*links, *chain, *more)


def six(root: str = "base", tag: str = "", foot: str = "0 0 0.1", elbow: str = ROOM) -> list[str]:
    """Six joints ``a1`` ... with a wrist whose last axis runs along the tool: reach 0.7 m beyond the shoulder."""
    axes = ("0 0 1", "0 1 0", "0 1 0", "0 0 1", "0 1 0", "0 0 1")
    frames = (foot, "0 0 0.1", "0 0 0.35", "0 0 0.15", "0 0 0.15", "0 0 0.05")
    names = [root, *(f"{tag}link{i}" for i in range(1, 7))]
    parts = []
    for i in range(6):
        parts.append(link(names[i + 1], inertial(1.0 - 0.1 * i), shape('<box size="0.05 0.05 0.08"/>')))
        limit = elbow if i == 2 else ROOM
        parts.append(joint(f"{tag}a{i + 1}", names[i], names[i + 1], xyz=frames[i], axis=axes[i], limit=limit))
    return parts


def fingers(folder: Path, palm: str, tag: str = "", at: str = "0 0 0.1") -> list[str]:
    """Two slides ``left`` and ``right`` along y, the second by mimic; their inner faces 1 to 5 cm from the middle."""
    box(folder / "in" / "left.stl", (-0.01, 0, 0), (0.01, 0.01, 0.06))
    box(folder / "in" / "right.stl", (-0.01, -0.01, 0), (0.01, 0, 0.06))
    follow = f'<mimic joint="{tag}left"/>'
    return [
        link(f"{tag}left_finger", inertial(0.05), mesh("left.stl")),
        link(f"{tag}right_finger", inertial(0.05), mesh("right.stl")),
        joint(f"{tag}left", palm, f"{tag}left_finger", xyz=at, axis="0 1 0", **SLIDE),
        joint(f"{tag}right", palm, f"{tag}right_finger", xyz=at, axis="0 -1 0", inner=follow, **SLIDE),
    ]


def base(*shapes: str) -> str:
    return link("base", inertial(5), *(shapes or (shape('<box size="0.1 0.1 0.1"/>', xyz="0 0 0.05"),)))


def write(folder: Path, text: str, name: str = "robot.urdf") -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / name
    path.write_text(text)
    return path


def box(path: Path, lower: Iterable[float], upper: Iterable[float]) -> Path:
    """A mesh of a box between two corners; the file's ending decides the format."""
    solid = trimesh.creation.box(bounds=[list(lower), list(upper)])
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_bytes(solid, path.suffix[1:]))
    return path


def _bytes(solid: trimesh.Trimesh, kind: str) -> bytes:
    if kind == "dae":
        return trimesh.exchange.dae.export_collada(solid)
    content = solid.export(file_type=kind)
    return content if isinstance(content, bytes) else content.encode()


def nero(folder: Path, extents: dict[str, tuple]) -> Path:
    """``folder/urdf/nero.urdf`` with ``folder/meshes``: figures of the package's own Nero, boxes of the links' extents as meshes.

    As in the published file, a fixed joint from ``world`` turns the base by 3.14, link7 has a placeholder's mass.
    """
    parts = [link("world"), joint("world_to_base_link", "world", "base_link", "fixed", xyz="0 0 0", rpy="0 0 3.14")]

    def visit(body: etree._Element, parent: str) -> None:
        name, own = body.get("name"), body.find("inertial")
        xx, yy, zz, xy, xz, yz = own.get("fullinertia").split()
        tensor = inertial(1e-6 if name == "link7" else float(own.get("mass")), own.get("pos"), f"{xx} {xy} {xz} {yy} {yz} {zz}")
        box(folder / "meshes" / f"{name}.stl", *extents[name])
        looks = [mesh(f"../meshes/{name}.stl", tag) for tag in ("visual", "collision")]
        parts.append(link(name, tensor, *looks))
        if parent:
            moves = body.find("joint")
            frame = {"xyz": body.get("pos", "0 0 0"), "rpy": body.get("euler", "0 0 0")}
            if moves is None:
                parts.append(joint(f"{name}_joint", parent, name, "fixed", **frame))
            else:
                lower, upper = moves.get("range").split()
                slide = moves.get("class") == "finger"
                limit = f'lower="{lower}" upper="{upper}" effort="{10 if slide else 100}" velocity="{3 if slide else 5}"'
                kind = "prismatic" if slide else "revolute"
                parts.append(joint(moves.get("name"), parent, name, kind, axis=moves.get("axis", "0 0 1"), limit=limit, **frame))
        for inner in body.findall("body"):
            visit(inner, name)

    visit(etree.parse(NERO).getroot().find("worldbody/body"), "")
    return write(folder / "urdf", robot(*parts, name="nero"), "nero.urdf")


def piper(folder: Path) -> Path:
    """``folder/piper.urdf``, whose meshes are missing."""
    parts = []
    for name, (moves, kind, parent, *figures) in PIPER.items():
        looks = [mesh(f"meshes/{name}.{e}", tag) for e, tag in (("dae", "visual"), ("stl", "collision"))]
        parts.append(link(name, inertial(float(figures[11])), *looks))
        if moves != "-":
            xyz, rpy, axis = (" ".join(figures[i : i + 3]) for i in (0, 3, 6))
            limit = f'lower="{figures[9]}" upper="{figures[10]}" effort="100" velocity="5"'
            parts.append(joint(moves, parent, name, kind, xyz, rpy, axis, limit))
    return write(folder, robot(*parts, name="piper"), "piper.urdf")
