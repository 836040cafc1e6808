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
KEPT = 0.85  # how often a number is one of those that robots have


def number(draw: random.Random, *usual: float) -> float | str:
    """One of the usual numbers, or another."""
    return draw.choice(usual if draw.random() < KEPT else NUMBERS)


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
    """An import of an arm with one to three things that may be odd, among packages and links that are."""
    home = folder / "home" / "w" / "in"  # what stands beside ``home`` is the user's
    make.box(folder / "mine" / "m.stl", (0, 0, 0), (0.1, 0.06, 0.02))
    for name in draw.sample(("m.stl", "pkg/m.stl", "other/m.stl", "../pkg/m.stl", "../../pkg/m.stl", "m n.stl"), 3):
        make.box(home / name, (0, 0, 0), (0.1, 0.06, draw.choice((0.02, 0.03, 20.0, 1e-7))))
    for name in draw.sample(("pkg", "other", ".", ".."), 2):
        names = "<package><name>pkg</name></package>", "<package/>", "[" * 1000, "<name>../mine</name>", ""
        make.write(home / name, draw.choice(names), "package.xml")
    if draw.random() < 0.3:
        (home / "pkg").mkdir(exist_ok=True)
        (home / draw.choice(("link.stl", "pkg/x", "mine"))).symlink_to(folder / "mine" / draw.choice(("m.stl", ".")))
    last = draw.choice((2, 3, 6))
    inner = (draw.choice(INNER)(draw, folder) for _ in range(draw.randint(0, 2)))
    parts = [make.link("e", _inertia(draw, folder), *inner), joint(draw, f"l{last}")]
    if draw.random() < 0.3:
        said = "".join(f"<{tag}>{draw.choice((*NUMBERS, 'j1', 'j', 'j2'))}</{tag}>" for tag in draw.sample(TAGS, 4))
        parts.append(f"<gazebo reference='{draw.choice(('e', 'x', ''))}'>{PLUGINS.format(said)}</gazebo>")
    text = make.arm(last, *parts)
    make.write(home, text)
    flags = draw.choice(([], [], [], [], ["--strict"], ["--degrees"], ["--package", "pkg=in/pkg"], ["--chain", "base:e"]))
    argv = ["import-urdf", "in/robot.urdf", "--out", "out", *flags]
    odd = text[text.index(parts[0]) :][:600]
    return f"{odd} {flags}", functools.partial(_in, home.parent, functools.partial(server.command, argv))


def _in(folder: pathlib.Path, call: Callable[[], None]) -> None:
    os.chdir(folder)
    call()


def _mesh(draw: random.Random, folder: pathlib.Path) -> str:
    file = draw.choice(FILES).format(mine=folder / "mine", long="x" * 300)
    scale = draw.choice(("1 1 1", "0.001 0.001 0.001", "-1 1 1", f"{number(draw, 1, 2)} 1 1", "1", "0 0 0"))
    return make.mesh(file, draw.choice(("visual", "collision")), scale)


def _shape(draw: random.Random, folder: pathlib.Path) -> str:
    sizes = [number(draw, 0.02, 0.03, 0.05) for _ in range(4)]
    return make.shape(draw.choice(SHAPES).format(*sizes), draw.choice(("visual", "collision")))


def _inertia(draw: random.Random, folder: pathlib.Path) -> str:
    moments = [
        str(draw.choice((1e-3, 2e-3, -1e-3, 5e-3, 1e-9)) if draw.random() < 0.97 else draw.choice(NUMBERS)) for _ in range(6)
    ]
    moments = ["0" if i in (1, 2, 4) and draw.random() < 0.6 else moment for i, moment in enumerate(moments)]
    return make.inertial(number(draw, 0.5, 1.0, 0.0), moments=" ".join(each or "0" for each in moments))


INNER = (_mesh, _shape)


def joint(draw: random.Random, parent: str) -> str:
    """The joint that holds the odd link."""
    usual = {
        "lower": (-1.0, -1.9, -120.0, -0.05),
        "upper": (1.0, 1.9, 120.0, 0.05),
        "effort": (10, 0, 0.18),
        "velocity": (2, 180),
    }
    values = {name: number(draw, *numbers) for name, numbers in usual.items()}
    limit = " ".join(f'{name}="{value}"' for name, value in values.items() if draw.random() < 0.95)
    kind = draw.choice(("revolute", "revolute", "continuous", "prismatic", "fixed", "floating"))
    driver, by, offset = draw.choice(("j1", "j2", "j", "j9")), number(draw, 1, -1, 2), number(draw, 0, 0.1)
    mimic = f'<mimic joint="{driver}" multiplier="{by}" offset="{offset}"/>'
    axis = (
        draw.choice(("0 0 1", "0 1 0", "1 1 0"))
        if draw.random() < 0.95
        else draw.choice(("0 0 0", "nan 0 0", "1e-30 0 0", "1 1"))
    )
    return make.joint("j", parent, "e", kind, axis=axis, limit=limit, inner=draw.choice(("", "", "", mimic)))


def changed(draw: random.Random, content: bytes) -> bytes:
    """A file after one to four changes of the fuzzer's."""
    kinds = ("put", "cut", "double", "swap", "over", "number", "word")
    edits = [
        (draw.choice(kinds), draw.random(), draw.random(), draw.choice((*fuzz.TOKENS, draw.randbytes(8))))
        for _ in range(draw.randint(1, 4))
    ]
    return fuzz.edited(content, edits)
