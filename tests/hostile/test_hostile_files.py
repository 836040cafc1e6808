"""Files of strangers: every case ends in one line, within limits of time and memory, with nothing written anywhere else."""

import functools
import pathlib

import bad_files as bad
import pytest
import trimesh
import urdf_files as make

DEEP = "[" * 500
LAUGHS = "a: &a [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n" + "".join(
    f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in zip("abcdefgh", "bcdefghi", strict=True)
)
YAML = {  # what no YAML file may be, whoever reads it
    "pipe": bad.PIPE,
    "endless": bad.ZERO,
    "folder": bad.DIRECTORY,
    "large": "a: " + "x" * 1_000_000,
    "deep": DEEP,
    "deep entries": "".join(f"{' ' * i}a:\n" for i in range(500)),
    "laughs": LAUGHS,
    "circle": "a: &a [*a]",
    "date": "arm: 2024-99-99",
    "no int": "arm: !!int a",
    "no float": "arm: !!float a",
    "no bool": "arm: !!bool a",
    "empty int": 'arm: !!int ""',
    "400 digits": "arm: " + "9" * 400,
    "5000 digits": "arm: " + "9" * 5000,
    "code": "!!python/object/apply:os.mkdir ['ran']",
    "binary": "arm: !!binary aGVsbG8=",
    "bytes": bytes(range(256)),
    "escape codes": '"\\e[2J\\e[31m": 1',
    "line feeds": '"a\\nerror: all is well": 1',
    "twice": "arm: 1\narm: 2",
    "two documents": "arm: 1\n---\narm: 2",
    "many": "[" + "1," * 90_000 + "]",
    "empty": "",
    "list": "- 1",
    "long key": "x" * 100_000 + ": 1",
}
REFUSED = {
    f"{kind}: {name}": functools.partial(read, content=text)
    for kind, read in (("gains", bad.gains),)
    for name, text in YAML.items()
}
REFUSED |= {f"robot: {name}": functools.partial(bad.robot, yaml_text=text) for name, text in YAML.items()}
REFUSED |= {
    f"rmpflow: {name}": functools.partial(bad.rmpflow, content=text)
    for name, text in YAML.items()
    if name
    in ("pipe", "endless", "folder", "large", "deep", "laughs", "date", "no int", "400 digits", "code", "escape codes", "empty")
}
REFUSED |= {
    f"robot: {name}": functools.partial(bad.robot, **fields)
    for name, fields in {
        "base_quat of zeros": {"base_quat": [0, 0, 0, 0]},
        "down of zeros": {"down": [0.0, 0.0, 0.0, 0.0]},
        "no unit quaternion": {"down": [0, 5, 0, 0]},
        "reversed workspace": {"workspace": [[0.3, 0.1], [0, 0.1], [0, 0.1]]},
        "arm and gripper": {"gripper": {"j2": {**bad.ROW, "open": 0.0, "close": 1.0}}},
        "far away": {"base_pos": [1e300, 0, 0]},
        "stiff": {"arm": {"j1": {**bad.ROW, "stiffness": 1e300}}},
        "infinite": {"arm": {"j1": {**bad.ROW, "home": float("inf")}}},
        "nameless": {"name": ""},
        "name of escapes": {"name": "a\x1b[2Jb"},
        "name of lines": {"name": "a\nb"},
        "long name": {"name": "x" * 10_000},
        "long value": {"ee_site": "x" * 50_000},
        "no arm": {"arm": None},
        "arm of numbers": {"arm": [1, 2]},
    }.items()
}
REFUSED |= {
    f"model: {name}": bad.with_model(*change)
    for name, change in {
        "second free joint": ('<joint name="j1" axis="0 0 1" range="-1 1"/>', '<freejoint name="j1"/>'),
        "free joint by type": ('name="j1" axis="0 0 1" range="-1 1"', 'name="j1" type="free"'),
        "ball joint": ('name="j2" axis="0 1 0" range="-1 1"', 'name="j2" type="ball"'),
        "actuator": ("</worldbody>", '</worldbody><actuator><motor name="j1" joint="j1"/></actuator>'),
        "memory": ("<asset>", '<size memory="100G"/><asset>'),
        "replicate": ('<site name="ee"/>', '<site name="ee"/><replicate count="100000"><geom size="0.1"/></replicate>'),
        "flexcomp": (
            '<site name="ee"/>',
            '<site name="ee"/><flexcomp name="f" type="grid" count="200 200 200" spacing="1 1 1"/>',
        ),
        "composite": ('<site name="ee"/>', '<site name="ee"/><composite type="cable" count="9999 1 1" size="1"/>'),
        "include": ("<asset>", '<include file="/etc/passwd"/><asset>'),
        "include of itself": ("<asset>", '<include file="model.xml"/><asset>'),
        "plugin": ("<asset>", '<extension><plugin plugin="mujoco.sdf.torus"/></extension><asset>'),
        "texture": ("</asset>", '<texture name="t" type="2d" builtin="flat" width="100000" height="100000"/></asset>'),
        "texture of a file": ("</asset>", '<texture name="t" type="2d" file="/etc/hostname"/></asset>'),
        "height field": ("</asset>", '<hfield name="h" nrow="40000" ncol="40000" size="1 1 1 1"/></asset>'),
        "attached model": ("</asset>", '<model name="a" file="/etc/passwd"/></asset>'),
        "absolute mesh": ('file="m.stl"', 'file="/etc/m.stl"'),
        "mesh above": ('file="m.stl"', 'file="../../secret/s.stl"'),
        "mesh folder above": ('meshdir="meshes"', 'meshdir="../secret"'),
        "no such mesh": ('file="m.stl"', 'file="n.stl"'),
        "mesh of another kind": ('file="m.stl"', 'file="m.msh"'),
        "mesh without end": ('file="m.stl"', 'file="m"'),
        "cube of scenes": ('name="l1"', 'name="cube"'),
        "table of scenes": ('type="mesh" mesh="m"', 'name="table" type="mesh" mesh="m"'),
        "same name twice": ('name="l2"', 'name="l1"'),
        "not a number": ('mass="1"', 'mass="nan"'),
        "infinite": ('pos="0 0 0.1"', 'pos="0 0 inf"'),
        "400 digits": ('pos="0 0 0.1"', f'pos="0 0 {"9" * 400}"'),
        "no mass": ('mass="1"', 'mass="0"'),
        "no range": ('range="-1 1"', ""),
        "entities": ('<mujoco model="arm">', '<!DOCTYPE m [<!ENTITY a "aaaa">]><mujoco model="&a;">'),
        "deep": ('<site name="ee"/>', "<body>" * 2000 + "</body>" * 2000),
        "many": ('<site name="ee"/>', "<site/>" * 600_000),
        "other root": ('<mujoco model="arm">', '<robot name="a"></robot><mujoco model="arm">'),
        "long name": ('name="j1"', f'name="{"j" * 100_000}"'),
        "plane": ('type="mesh" mesh="m"', 'type="plane" size="1 1 1"'),
        "callback": ('<site name="ee"/>', '<site name="ee"/><geom type="sdf"/>'),
    }.items()
}
NO_FILE = {"directory": bad.DIRECTORY, "pipe": bad.PIPE, "endless": bad.ZERO, "empty": b""}
MODELS = {
    "binary": bytes(range(256)),
    "binary model": b"MJB" * 100,
    "large": "<mujoco>" + " " * 20_000_000 + "</mujoco>",
}
MESHES = {"link out": bad.SECRET, "text": b"solid", "lying": bytes(80) + b"\xff\xff\xff\xff" + bytes(100), "flat": bad.stl(4)}
REFUSED |= {
    f"{what}: {name}": functools.partial(bad.robot, **{field: content})
    for what, field, own in (("model", "model", MODELS), ("model's mesh", "mesh", MESHES))
    for name, content in {**NO_FILE, **own}.items()
}


def put(name, value):
    """A change of a mapping; ``...`` takes the field out."""

    def change(meta):
        meta[name] = value
        if value is ...:
            del meta[name]

    return change


def first(**fields):
    """A change of a head's first array."""

    def change(head):
        next(entry for name, entry in head.items() if name != "__metadata__").update(fields)

    return change


def nest(text: str) -> str:
    return f'{{"env": {text * 100_000}'


LONG = {"actor": [64] * 20_000, "critic": [64, 64]}
REFUSED |= {
    f"policy: {name}": functools.partial(bad.policy, **options)
    for name, options in {
        "no env": {"meta": put("env", ...)},
        "no preset": {"meta": put("preset", ...)},
        "no observations": {"meta": put("observations", ...)},
        "no network": {"meta": put("network", ...)},
        "no action size": {"meta": put("action_size", ...)},
        "env of numbers": {"meta": put("env", 3)},
        "env of lines": {"meta": put("env", "nero\nerror: all is well")},
        "env of escapes": {"meta": put("env", "\x1b[2J\x1b[31mnero")},
        "preset of escapes": {"meta": lambda m: m.update(preset="\x1b]0;x\x07", observations={"state": []})},
        "long env": {"meta": put("env", "x" * 100_000)},
        "no state": {"meta": put("observations", {})},
        "negative size": {"meta": put("action_size", -7)},
        "absurd size": {"meta": put("action_size", 10**30)},
        "true size": {"meta": put("action_size", True)},
        "absurd observations": {"meta": put("observation_size", {"state": [10**12]})},
        "many dimensions": {"meta": put("observation_size", {"state": [9] * 1000})},
        "20,000 layers": {"meta": put("network", LONG)},
        "wide layer": {"meta": put("network", {"actor": [10**9], "critic": [64]})},
        "layer of text": {"meta": put("network", {"actor": ["a"], "critic": [64]})},
        "unknown activation": {"meta": put("network", {"actor": [64], "critic": [64], "activation": "__import__"})},
        "another network": {"meta": put("network", {"actor": [32, 32], "critic": [64, 64]})},
        "zero deviation": {"meta": put("network", {"actor": [64, 64], "critic": [64, 64], "init_std": 0})},
        "deep description": {"meta": nest("[")},
        "deeper description": {"meta": nest('{"a":')},
        "description of NaN": {"meta": '{"env": NaN}'},
        "description of a list": {"meta": "[]"},
        "description of 10**5000": {"meta": '{"env": 1' + "0" * 5000 + "}"},
        "F8_E4M3": {"head": first(dtype="F8_E4M3")},
        "BF16": {"head": first(dtype="BF16")},
        "F16": {"head": first(dtype="F16")},
        "absurd shape": {"head": first(shape=[2**60, 2**60])},
        "negative shape": {"head": first(shape=[-1])},
        "shape of text": {"head": first(shape="ab")},
        "offsets beyond": {"head": first(data_offsets=[0, 10**15])},
        "offsets backwards": {"head": first(data_offsets=[8, 0])},
        "head of a list": {"head": lambda head: [1]},
        "no description": {"head": lambda head: {k: v for k, v in head.items() if k != "__metadata__"}},
        "description of numbers": {"head": lambda head: head.update(__metadata__={"meta": 3})},
        "array missing": {"head": lambda head: {k: v for k, v in head.items() if "bias" not in k}},
        "NaN": {"spoil": lambda body: b"\x00\x00\xc0\x7f" * (len(body) // 4)},
        "infinite": {"spoil": lambda body: b"\x00\x00\x80\x7f" * (len(body) // 4)},
        "cut off": {"spoil": lambda body: body[:-100]},
        "too long": {"spoil": lambda body: body + bytes(100)},
        "absurd file": {"size": 40_000_000_000},
        "large file": {"size": 400_000_000},
        "absurd head": {"raw": (2**62).to_bytes(8, "little") + b"{}"},
        "large head": {"raw": (50_000_000).to_bytes(8, "little") + b"{" + b" " * 50_000_000},
        "empty": {"raw": b""},
        "zeros": {"raw": bytes(1000)},
        "deep head": {"raw": (200_000).to_bytes(8, "little") + b"[" * 200_000},
    }.items()
}


def checkpointed(**changes):
    """A description that says it is of a checkpoint, and more."""
    return lambda meta: meta.update(kind="checkpoint", **changes)


def as_now(meta: dict) -> None:
    """With the networks' fields that files of older versions lack."""
    meta["network"] |= {"output_scale": 0.01, "max_observation": 10.0}


def unsummed(head: dict) -> None:
    """Without the checksum, which would tell that the arrays are others."""
    head["__metadata__"].pop("crc32", None)


RESTORE = "train --env nero_reach --num-envs 8 --num-timesteps 1000 --no-video --out run --restore".split()
REFUSED |= {
    f"restore: {name}": lambda folder, options=options: [*RESTORE, bad.policy(folder, **options)[-1]]
    for name, options in {
        "NaN": {"spoil": lambda body: b"\x00\x00\xc0\x7f" * (len(body) // 4), "head": unsummed, "meta": as_now},
        "NaN and its checksum": {"spoil": lambda body: b"\x00\x00\xc0\x7f" * (len(body) // 4)},
        "checkpoint without state": {"meta": checkpointed()},
        "env of escapes": {"meta": checkpointed(env="\x1b[2Jnero")},
        "many environments": {"meta": checkpointed(num_envs="\n" * 99_999)},
        "version of lines": {"meta": checkpointed(version="1\nerror: all is well")},
        "observations of none": {"meta": lambda meta: {"env": "nero_reach", "observations": {"state": []}}},
        "network of none": {"meta": put("network", None)},
        "cut off": {"spoil": lambda body: body[:-100]},
        "no policy": {"raw": b"{}"},
    }.items()
}


def fill(name: str, content: bytes = b"mine"):
    """A file of the user's in the folder of an import."""

    def change(out: pathlib.Path, source: pathlib.Path) -> None:
        bad.put(out / name, content)

    return change


def linked(out: pathlib.Path, source: pathlib.Path) -> None:
    """Meshes that are a link to the user's."""
    make.box(source.parent / "mine" / "a.stl", (0, 0, 0), (1, 1, 1))
    (out / "meshes").symlink_to(source.parent / "mine")


REFUSED |= {
    "force: source within": bad.source_within,
    "force: source moved in": functools.partial(bad.imported, change=bad.source_moved_in),
    **{
        f"force: {name}": functools.partial(bad.imported, change=change)
        for name, change in {
            "thesis": fill("thesis.tex"),
            "hidden file": fill(".git"),
            "mesh of the user's": fill("meshes/mine.stl"),
            "edited robot": fill("robot.yaml"),
            "edited model": fill("model.xml"),
            "folder": lambda out, source: (out / "runs").mkdir(),
            "folder of meshes": lambda out, source: (out / "meshes" / "a.stl").mkdir(parents=True),
            "linked meshes": linked,
            "no report": lambda out, source: (out / "report.json").unlink(),
            "report of another": fill("report.json", b'{"files": {"thesis.tex": "", "../in/robot.urdf": ""}}'),
            "deep report": fill("report.json", b"[" * 100_000),
            "report that is a pipe": lambda out, source: bad.put(out / "report.json", bad.PIPE),
        }.items()
    },
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(refuse, name):
    refuse(REFUSED[name])


def test_messages(refuse, tmp_path):
    """Some of the lines, word for word."""
    assert "policy.safetensors holds numbers that are not finite, in " in refuse(REFUSED["restore: NaN"])
    assert refuse(bad.source_within) == f"error: {tmp_path}/o holds other files: pass another --out"


CUT = {"stl": bad.solid("stl"), "obj": bad.solid("obj"), "dae": bad.solid("dae")}
LEFT_OUT = {  # meshes: (content, kind), and what the warning says
    "two dimensions": (lambda: b"v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "obj", "no triangles"),
    "four dimensions": (lambda: b"v 0 0 0 1\nv 1 0 0 1\nv 0 1 0 1\nf 1 2 9\n", "obj", ""),
    "mixed dimensions": (lambda: b"v 0 0 0\nv 1 0\nv 0 1 0\nf 1 2 3\n", "obj", ""),
    "negative indices": (lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf -9 -8 -7\n", "obj", ""),
    "12 million faces": (lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\n" + b"f 1 2 3\n" * 4_500_000, "obj", "4,500,000 triangles"),
    "a face of millions": (lambda: b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf" + b" 1 2 3" * 4_000_000, "obj", "numbers: more than"),
    "99 MB": (lambda: bytes(80) + (1_980_000).to_bytes(4, "little") + bytes(99_000_000), "stl", "1,980,000 triangles"),
    "text of a million": (lambda: b"facet normal 0 0 1\nendfacet\n" * 1_500_000, "stl", "1,500,000 triangles"),
    "29 MB of elements": (lambda: bad.within(CUT["dae"], "COLLADA", b"<a/>" * 7_000_000), "dae", "elements and attributes"),
    "29 MB of attributes": (lambda: bad.within(CUT["dae"], "COLLADA", b'<a b="" c="" d=""/>' * 1_500_000), "dae", "attributes"),
    "9 MB of indices": (lambda: bad.within(CUT["dae"], "p", b"0 " * 4_900_000), "dae", "indices"),
    "29 MB of numbers": (lambda: bad.within(CUT["dae"], "float_array", b"0 " * 14_000_000), "dae", ""),
    "deep": (lambda: bad.within(CUT["dae"], "COLLADA", b"<a>" * 100_000), "dae", "well-formed"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LEFT_OUT)
def test_meshes_that_are_left_out(play, name):
    """The import goes on without them."""
    content, kind, words = LEFT_OUT[name]
    outcome = play(functools.partial(bad.mesh, content=content(), kind=kind), allowed=("out",))
    assert outcome["code"] == 0 and words in outcome["stdout"], outcome


READ = {  # large, and fit to be used
    "120,000 equal triangles": (lambda: bad.stl(120_000, equal=True), "stl"),
    "900,000 triangles": (lambda: bad.stl(900_000), "stl"),
    "300,000 groups": (lambda: CUT["obj"] + b"g a\nf 1 2 3\n" * 300_000, "obj"),
    "a million points": (lambda: b"v 0 0 0\n" * 1_000_000 + CUT["obj"], "obj"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", READ)
def test_meshes_that_are_read(play, name):
    content, kind = READ[name]
    outcome = play(functools.partial(bad.mesh, content=content(), kind=kind), allowed=("out",))
    assert outcome["code"] == 0, outcome


def shapes(folder: pathlib.Path, count: int) -> list:
    """One link of many collisions."""
    box = make.link("e", make.inertial(), *[make.shape('<box size="1 1 1"/>')] * count)
    return bad.urdf(folder, make.arm(2, box, make.joint("j", "l2", "e")))


def heavy(folder: pathlib.Path, files: int) -> list:
    """Many meshes that are large each."""
    ball = trimesh.creation.icosphere(subdivisions=7).export(file_type="stl")
    for i in range(files):
        bad.put(folder / "in" / f"m{i}.stl", ball)
    links = make.link("e", make.inertial(0.1), *[make.mesh(f"m{i}.stl") for i in range(files)])
    return bad.urdf(folder, make.arm(2, links, make.joint("j", "l2", "e")))


BUDGETS = {
    "5,000 shapes": (functools.partial(shapes, count=5_000), "5,003 visuals and collisions: more than 4,000"),
    "2,000 scales": (functools.partial(bad.mesh, content=bad.solid("stl"), kind="stl", count=2000), "are more than 500 files"),
    "16 million triangles by scales": (
        functools.partial(bad.mesh, content=bad.stl(8000), kind="stl", count=2000),
        "the limit is",
    ),
    "four million triangles": (functools.partial(heavy, files=13), "triangles together, more than 4,000,000"),
    "101 MB": (lambda folder: bad.mesh(folder, bytes(101_000_000), "stl"), "more than 100 MB are not read"),
    "10 MB of elements": (lambda folder: bad.urdf(folder, make.robot("<a/>" * 2_400_000)), "elements and attributes"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", BUDGETS)
def test_budgets_of_a_robot(refuse, name):
    case, words = BUDGETS[name]
    assert words in refuse(case)


def fixed(folder: pathlib.Path) -> list:
    """A thousand links that are fixed to one another and to an arm's, with a visual and a collision each."""
    shape = '<box size="0.04 0.04 0.2"/>'
    links = [make.link(f"f{i}", make.inertial(), make.shape(shape, "visual"), make.shape(shape)) for i in range(1000)]
    parents = [f"l{i % 6 + 1}" if i < 500 else f"f{i - 1}" for i in range(1000)]
    joints = [make.joint(f"x{i}", parent, f"f{i}", "fixed", xyz="0.01 0 0") for i, parent in enumerate(parents)]
    return bad.urdf(folder, make.arm(6, *links, *joints))


def long(folder: pathlib.Path) -> list:
    """A hundred joints in a row, 20 m of them: as long as it says."""
    return [*bad.urdf(folder, make.arm(100)), "--scale", "1"]


@pytest.mark.slow
@pytest.mark.parametrize("case", [long, fixed, functools.partial(shapes, count=3000)])
def test_large_robots_are_imported(play, case):
    """A hundred joints, a thousand links, three thousand shapes of one link: in less than 30 s."""
    assert play(case, allowed=("out",))["code"] == 0


def test_an_import_is_replaced(play):
    """With --force; what is left is what the second import writes."""
    outcome = play(functools.partial(bad.imported, change=lambda out, source: (out / "robot.yaml").unlink()), allowed=("out",))
    assert outcome["code"] == 0


def test_a_good_robot_and_a_good_policy(play):
    """What the hostile ones are made of is taken."""
    assert play(bad.robot)["code"] == 0


def test_names_that_look_like_markup(play):
    """They are shown as they are."""
    outcome = play(functools.partial(bad.robot, model=bad.MODEL.replace("j1", "[/x]"), name="[/y]", arm={"[/x]": bad.ROW}))
    assert outcome["code"] == 0 and "[/x]" in outcome["stdout"]
