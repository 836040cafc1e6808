"""URDFs of the kinds that were imported wrongly in silence, with what a stranger may put there."""

import functools
import os
import pathlib
import random
from collections.abc import Callable

import fuzz
import server
import urdf_files as make

FILES = ("m.stl", "package://pkg/m.stl", "package://other/m.stl", "package://pkg/../m.stl", "package://../mine/m.stl", "M.STL")
FILES += ("package://pkg/%2e%2e/%2e%2e/mine/m.stl", "../../mine/m.stl", "file:///dev/zero", "file://{mine}/m.stl", "{mine}/m.stl")
FILES += (
    "package://",
    "package:///m.stl",
    "package://pkg",
    "m%20n.stl",
    "m n.stl",
    "%",
    "%zz.stl",
    "m%00.stl",
    "http://x.example/m.stl",
)
FILES += ("model://pkg/m.stl", "package://pkg//m.stl", "package://./m.stl", "package://pkg/mine/m.stl", "pkg", "", "file:m.stl")
FILES += (
    "package://" + "../" * 30 + "etc/passwd",
    "package://{long}/m.stl",
    "{long}.stl",
    "package://pkg\\..\\m.stl",
    "link.stl",
)
NUMBERS = (0, -1, 1, 0.5, 1e-9, -1e-9, 1e9, 1e25, 1e-300, float("nan"), float("inf"), -120, 180, 3.15, 1.9, 57.3, 1e308, "x", "")
SHAPES = (
    '<capsule radius="{}" length="{}"/>',
    '<cylinder radius="{}" length="{}"/>',
    '<sphere radius="{}"/>',
    '<box size="{} {} 0.1"/>',
)
SHAPES += (
    '<cone radius="{}"/>',
    "<capsule/>",
    '<capsule radius="0.02"/>',
    '<box size="{}"/>',
    "",
    "<mesh/>",
    '<mesh filename="m.stl" scale="{}"/>',
)
PLUGINS = '<plugin filename="libroboticsgroup_gazebo_mimic_joint_plugin.so" name="p">{}</plugin>'
TAGS = ("joint", "mimicJoint", "multiplier", "offset", "maxEffort", "sensitiveness", "x")


def urdf(draw: random.Random, folder: pathlib.Path) -> tuple[str, Callable[[], None]]:
    """An import of an arm with one to three things that are odd, among packages and links that are."""
    home = folder / "home" / "w" / "in"  # what stands beside ``home`` is the user's
    make.box(folder / "mine" / "m.stl", (0, 0, 0), (0.1, 0.06, 0.02))
    for name in draw.sample(("m.stl", "pkg/m.stl", "other/m.stl", "../pkg/m.stl", "../../pkg/m.stl", "m n.stl"), 3):
        make.box(home / name, (0, 0, 0), (0.1, 0.06, draw.choice((0.02, 20.0, 1e-7))))
    for name in draw.sample(("pkg", "other", ".", ".."), 2):
        text = draw.choice(("<package><name>pkg</name></package>", "<package/>", "[" * 1000, "<name>../mine</name>", ""))
        make.write(home / name, text, "package.xml")
    if draw.random() < 0.3:
        (home / "pkg").mkdir(exist_ok=True)
        (home / draw.choice(("link.stl", "pkg/x", "mine"))).symlink_to(folder / "mine" / draw.choice(("m.stl", ".")))
    parts = [make.link("e", *(draw.choice(INNER)(draw, folder) for _ in range(draw.randint(1, 3)))), joint(draw)]
    if draw.random() < 0.5:
        inner = "".join(f"<{tag}>{draw.choice((*NUMBERS, 'j1', 'j', 'j2'))}</{tag}>" for tag in draw.sample(TAGS, 4))
        parts.append(draw.choice((f"<gazebo>{PLUGINS.format(inner)}</gazebo>", f"<gazebo reference='{inner[:3]}'/>")))
    text = make.arm(draw.choice((2, 3)), *parts)
    said = text[text.index('<link name="e"') :][:400]
    make.write(home, text)
    flags = draw.choice(
        ([], [], ["--strict"], ["--degrees"], ["--package", "pkg=."], ["--package", "../mine"], ["--chain", "base:e"])
    )
    argv = ["import-urdf", "in/robot.urdf", "--out", "out", *flags]
    return f"{said} {flags}", functools.partial(_in, home.parent, functools.partial(server.command, argv))


def _in(folder: pathlib.Path, call: Callable[[], None]) -> None:
    os.chdir(folder)
    call()


def _mesh(draw: random.Random, folder: pathlib.Path) -> str:
    file = draw.choice(FILES).format(mine=folder / "mine", long="x" * 300)
    scale = draw.choice(("1 1 1", "0.001 0.001 0.001", f"{draw.choice(NUMBERS)} 1 1", "1", "-1 1 1", "0 0 0"))
    return make.mesh(file, draw.choice(("visual", "collision")), scale)


def _shape(draw: random.Random, folder: pathlib.Path) -> str:
    return make.shape(
        draw.choice(SHAPES).format(*draw.choices((*NUMBERS, 0.02, 0.05), k=4)), draw.choice(("visual", "collision"))
    )


def _inertia(draw: random.Random, folder: pathlib.Path) -> str:
    moments = " ".join(str(draw.choice((0.001, 0.002, -0.001, *NUMBERS[:-2]))) for _ in range(6))
    return make.inertial(draw.choice((1.0, *NUMBERS[:-2])), moments=moments)


INNER = (_mesh, _shape, _inertia)


def joint(draw: random.Random) -> str:
    """The joint that holds the odd link."""
    values = {name: draw.choice(NUMBERS) for name in ("lower", "upper", "effort", "velocity")}
    limit = " ".join(f'{name}="{value}"' for name, value in values.items() if draw.random() < 0.9)
    kind = draw.choice(("revolute", "continuous", "prismatic", "fixed", "floating", "planar", "universal", ""))
    driver, by, offset = draw.choice(("j1", "j", "j9", "")), draw.choice(NUMBERS), draw.choice(NUMBERS)
    mimic = f'<mimic joint="{driver}" multiplier="{by}" offset="{offset}"/>'
    axis = draw.choice(("0 0 1", "0 0 0", "1 1", "nan 0 0", "1e25 0 0", "1e-30 0 0"))
    return make.joint("j", "l2", "e", kind, axis=axis, limit=limit, inner=draw.choice(("", "", mimic)))


def changed(draw: random.Random, content: bytes) -> bytes:
    """A file after one to four changes of the fuzzer's."""
    kinds = ("put", "cut", "double", "swap", "over", "number", "word")
    edits = [
        (draw.choice(kinds), draw.random(), draw.random(), draw.choice((*fuzz.TOKENS, draw.randbytes(8))))
        for _ in range(draw.randint(1, 4))
    ]
    return fuzz.edited(content, edits)
