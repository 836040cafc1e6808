"""Broken and hostile URDFs: one clear line or a warning and a fallback, and nothing outside the given folders is touched."""

import builtins
import os
import pathlib
import re
import struct

import mujoco
import pytest
import urdf_files as make

from mjx_nero.sim import robot_file
from mjx_nero.types import UserError
from mjx_nero.urdf import files, import_urdf, meshes, read, validate

GOOD = make.arm(3)
BOMB = '<!DOCTYPE r [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;&a;&a;"><!ENTITY c "&b;&b;&b;&b;&b;&b;&b;&b;">]>'
OUTER = '<!DOCTYPE r [<!ENTITY x SYSTEM "file:///etc/hostname">]>'


def refused(folder: pathlib.Path, text: str | bytes, match: str, **options) -> None:
    (folder / "in").mkdir(exist_ok=True)
    path = folder / "in" / "robot.urdf"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UserError, match=match) as error:
        import_urdf(path, folder / "out", **options)
    assert "\n" not in str(error.value) and len(str(error.value)) < 600
    assert not (folder / "out").exists() and not list(folder.glob(".out*"))


def warned(folder: pathlib.Path, text: str, match: str):
    report = import_urdf(make.write(folder / "in", text), folder / "out")
    assert any(match in warning for warning in report.warnings), report.warnings
    robot_file.read(folder / "out")
    return mujoco.MjModel.from_xml_path(str(folder / "out" / "model.xml")), report


@pytest.mark.parametrize(
    "head",
    [
        '<?xml version="1"?>',
        '<?xml version="0.0" ?>',
        "<?xml ?>",
        '\n<?xml version="1.0"?>',
        "<!-- a robot -->\n<?xml version='1.0'?>",
    ],
)
def test_a_declaration_that_parsers_refuse_is_no_matter(tmp_path, head):
    make.write(tmp_path, head + GOOD.split("?>", 1)[-1])
    assert len(import_urdf(tmp_path / "robot.urdf", tmp_path / "out").robot.arm.joints) == 3


def test_parts_that_an_argument_would_join_name_it(tmp_path):
    """Arms for several bases leave it to an argument what they stand on."""
    head = '<robot xmlns:xacro="http://ros.org/wiki/xacro" name="x"><xacro:arg name="{}" default=""/>'
    text = GOOD[GOOD.index("<link") :].replace("</robot>", make.link("foot") + "</robot>")
    make.write(tmp_path, head.format("base_model") + text)
    with pytest.raises(UserError, match=r"2 links hang on no joint .*what joins it, --arg NAME:=VALUE \(base_model\)"):
        import_urdf(tmp_path / "robot.urdf", tmp_path / "out")
    with pytest.raises(UserError, match="or remove them$"):
        import_urdf(tmp_path / "robot.urdf", tmp_path / "out", args={"base_model": "none"})
    make.write(tmp_path, head.format("a\u202e b") + text)
    with pytest.raises(UserError, match="or remove them$"):
        import_urdf(tmp_path / "robot.urdf", tmp_path / "out")


def limited(limit: str, type: str = "revolute") -> str:
    return make.arm(2, make.link("e", make.inertial()), make.joint("j", "l2", "e", type, limit=limit))


REFUSED = {
    "empty": ("", "not well-formed"),
    "no XML": ("hello", "not well-formed"),
    "cut off": (GOOD[: len(GOOD) // 2], "not well-formed"),
    "binary": (bytes(range(256)), "not well-formed"),
    "MJCF": ("<mujoco/>", "is a model for MuJoCo, .*: give the URDF or xacro"),
    "SDF": ("<sdf/>", "is a model for Gazebo, .*: give the URDF or xacro"),
    "other root": ("<model/>", "not <robot>"),
    "nothing in it": ("<robot name='x'/>", "no links"),
    "entity bomb": (BOMB + "<robot name='&c;'/>", "document type"),
    "external entity": (OUTER + "<robot name='x'><link name='&x;'/></robot>", "not well-formed|document type"),
    "deep": ("<robot name='x'>" + "<a>" * 5000 + "</a>" * 5000 + "</robot>", "not well-formed"),
    "link without name": (GOOD.replace('<link name="l1">', "<link>"), "link number 2 has no name"),
    "link with empty name": (GOOD.replace('<link name="l1">', '<link name=" ">'), "link number 2 has no name"),
    "joint without name": (GOOD.replace('<joint name="j1"', "<joint"), "joint number 1 has no name"),
    "same link twice": (make.arm(3, make.link("l1")), "2 links are called 'l1'"),
    "same joint twice": (make.arm(3, make.link("x"), make.joint("j1", "l3", "x")), "2 joints are called 'j1'"),
    "right to left": (GOOD.replace('"l1"', '"l1\u202e"'), "control characters in its name"),
    "terminal's escape": (GOOD.replace('"j1"', '"j1\x9b2J"'), "control characters in its name"),
    "line in a name": (GOOD.replace('"j1"', '"j1&#10;error: no"'), "control characters in its name"),
    "long name": (GOOD.replace('"j1"', f'"{"j" * 1000}"'), "or more than 150"),
    "absent parent": (GOOD.replace('parent link="base"', 'parent link="bse"'), "names link 'bse'.*did you mean 'base'"),
    "no child": (GOOD.replace('<child link="l2"/>', ""), "joint 'j2' has no child link"),
    "two parents": (make.arm(3, make.joint("again", "base", "l3")), "hangs on two joints"),
    "loop": (
        make.arm(3, make.link("x"), make.link("y"), make.joint("a", "x", "y"), make.joint("b", "y", "x")),
        "form a loop",
    ),
    "loop alone": (
        make.robot(make.link("x"), make.link("y"), make.joint("a", "x", "y"), make.joint("b", "y", "x")),
        "form a loop",
    ),
    "onto itself": (make.arm(3, make.link("x"), make.joint("a", "x", "x")), "form a loop"),
    "two roots": (make.arm(3, make.link("stray")), "2 links hang on no joint"),
    "floating": (GOOD.replace('type="revolute"', 'type="floating"', 1), "of type 'floating'"),
    "planar": (GOOD.replace('type="revolute"', 'type="planar"', 1), "of type 'planar'"),
    "no type": (GOOD.replace('type="revolute"', "", 1), "of type None"),
    "nothing moves": (GOOD.replace("revolute", "fixed"), "no joint that moves"),
    "zero axis": (GOOD.replace('axis xyz="0 0 1"', 'axis xyz="0 0 0"', 1), "axis 0 0 0"),
    "word for a number": (GOOD.replace('axis xyz="0 0 1"', 'axis xyz="0 0 up"', 1), "is not numbers"),
    "Python's number": (GOOD.replace('axis xyz="0 0 1"', 'axis xyz="0 0 1_0"', 1), "is not numbers"),
    "two numbers": (GOOD.replace('axis xyz="0 0 1"', 'axis xyz="0 1"', 1), "takes 3 numbers"),
    "NaN in a frame": (GOOD.replace('origin xyz="0 0 0.2"', 'origin xyz="0 0 nan"', 1), "not finite"),
    "huge frame": (GOOD.replace('origin xyz="0 0 0.2"', 'origin xyz="0 0 1e300"', 1), "beyond"),
    "slide without limits": (limited("", "prismatic"), "no limits: give it a range"),
    "slide with limits NaN": (limited('lower="nan" upper="1"', "prismatic"), "nan .. 1: give it a range"),
    "mimics nothing": (
        make.arm(2, make.link("e", make.inertial()), make.joint("j", "l2", "e", inner='<mimic joint="jj1"/>')),
        "mimics joint 'jj1'.*did you mean 'j1'",
    ),
    "mimics itself": (make.arm(2, make.link("e"), make.joint("j", "l2", "e", inner='<mimic joint="j"/>')), "mimics itself"),
    "too many joints": (make.arm(read.MAX_MOVING + 1), "moving joints"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused(tmp_path, name):
    refused(tmp_path, *REFUSED[name])


def test_too_many_links(tmp_path):
    refused(tmp_path, make.robot(*(make.link(f"l{i}") for i in range(validate.MAX_ELEMENTS + 1))), "are not read")


def test_no_file(tmp_path):
    with pytest.raises(UserError, match="there is no file"):
        import_urdf(tmp_path / "no.urdf", tmp_path / "out")
    with pytest.raises(UserError, match="is not a file"):
        import_urdf(tmp_path, tmp_path / "out")
    os.mkfifo(tmp_path / "pipe.urdf")  # opening it would wait for ever
    with pytest.raises(UserError, match="is not a file"):
        import_urdf(tmp_path / "pipe.urdf", tmp_path / "out")
    with pytest.raises(UserError, match="no such folder"):
        import_urdf(make.write(tmp_path, GOOD), tmp_path / "out", {"a": tmp_path / "absent"})


def test_large_files(tmp_path):
    (tmp_path / "in").mkdir()
    with (tmp_path / "in" / "big.urdf").open("wb") as file:
        file.truncate(files.MAX_URDF + 1)
    with pytest.raises(UserError, match="10 MB are not read"):
        import_urdf(tmp_path / "in" / "big.urdf", tmp_path / "out")
    with (tmp_path / "in" / "big.stl").open("wb") as file:
        file.truncate(meshes.KINDS["stl"] + 1)
    refused(tmp_path, make.arm(2, with_mesh("big.stl"), make.joint("j", "l2", "e")), "100 MB are not read")


def with_mesh(name: str) -> str:
    return make.link("e", make.inertial(0.1), make.mesh(name, "visual"), make.mesh(name))


@pytest.fixture
def secret(tmp_path) -> pathlib.Path:
    """A mesh outside the URDF's folder."""
    return make.box(tmp_path / "secret" / "s.stl", (0, 0, 0), (0.1, 0.1, 0.1))


@pytest.mark.parametrize(
    "name",
    [
        "../secret/s.stl",
        "package://x/../../secret/s.stl",
        "package://in/../secret/s.stl",
        "file://{}/secret/s.stl",
        "file://{}/in/../secret/s.stl",
        "{}/secret/s.stl",
        "/etc/passwd",
        "file:///etc/passwd",
        "file://%2Fetc%2Fpasswd",
        "..\\secret\\s.stl",
        "../no/such/file.stl",
        "link.stl",
        "folder/s.stl",
        "package://known/../../secret/s.stl",
    ],
)
def test_paths_out(tmp_path, secret, name, monkeypatch):
    folder = tmp_path / "in"
    (folder / "known").mkdir(parents=True)
    (folder / "link.stl").symlink_to(secret)
    (folder / "folder").symlink_to(secret.parent)
    opened = []
    original = os.open
    monkeypatch.setattr(os, "open", lambda file, *a, **k: (opened.append(pathlib.Path(file)), original(file, *a, **k))[1])
    text = make.arm(2, with_mesh(name.format(tmp_path)), make.joint("j", "l2", "e"))
    refused(tmp_path, text, "lies outside", packages={"known": folder / "known"})
    assert opened and all(p.is_relative_to(folder) for p in opened)


def library(collada: str, nodes: str) -> str:
    """A COLLADA file whose scene is the node ``n0`` of a library of ``nodes``."""
    scene = f"<library_nodes>{nodes}</library_nodes><library_visual_scenes"
    collada = collada.replace("<library_visual_scenes", scene, 1)
    return re.sub(
        r"(<visual_scene[^>]*>).*(</visual_scene>)",
        r'\1<node id="r"><instance_node url="#n0"/></node>\2',
        collada,
        flags=re.DOTALL,
    )


@pytest.mark.parametrize(
    "name, why",
    [
        ("no.stl", "there is no such file"),
        ("package://other/no.stl", "--package other=DIR"),
        ("http://host/a.stl", "http:// is not fetched"),
        ("loop.stl", "there is no such file"),
        ("pipe.stl", "there is no such file"),
        ("folder.stl", "there is no such file"),
        ("a" * 5000 + ".stl", "there is no such file"),
        ("empty.stl", "no triangles"),
        ("text.stl", "no triangles"),
        ("lying.stl", "no triangles"),
        ("nan.stl", "no triangles"),
        ("cut.dae", "cannot be read"),
        ("bomb.dae", "document type"),
        ("doubling.dae", "more than 10000 times"),
        ("circle.dae", "more than 10000 times"),
        ("none.obj", "no triangles"),
        ("a.glb", "only stl, obj, dae are read"),
        ("plain", "only stl, obj, dae are read"),
    ],
)
def test_unusable_meshes(tmp_path, name, why):
    folder = tmp_path / "in"
    (folder / "folder.stl").mkdir(parents=True)
    (folder / "loop.stl").symlink_to(folder / "loop.stl")
    os.mkfifo(folder / "pipe.stl")
    (folder / "empty.stl").touch()
    (folder / "text.stl").write_text("solid nothing\n")
    (folder / "lying.stl").write_bytes(bytes(80) + struct.pack("<I", 2**31) + bytes(100))
    (folder / "nan.stl").write_bytes(bytes(80) + struct.pack("<I", 1) + struct.pack("<12f", *[float("nan")] * 12) + b"\0\0")
    (folder / "cut.dae").write_text("<COLLADA")
    (folder / "bomb.dae").write_text(BOMB + "<COLLADA>&c;</COLLADA>")
    good = make.box(folder / "good.dae", (0, 0, 0), (0.1, 0.1, 0.1)).read_text()
    geometry = re.search(r"<instance_geometry.*?</instance_geometry>|<instance_geometry[^>]*/>", good, re.DOTALL)[0]
    places = [f'<instance_node url="#n{i + 1}"/>' * 2 for i in range(40)]
    twice = "".join(f'<node id="n{i}">{place}</node>' for i, place in enumerate(places))
    (folder / "doubling.dae").write_text(library(good, f'{twice}<node id="n40">{geometry}</node>'))
    (folder / "circle.dae").write_text(library(good, '<node id="n0"><instance_node url="#n0"/></node>'))
    (folder / "none.obj").write_text("# nothing\n")
    (folder / "a.glb").write_bytes(b"glTF")
    (folder / "plain").write_bytes(b"?")
    model, report = warned(tmp_path, make.arm(2, with_mesh(name), make.joint("j", "l2", "e")), why)
    assert model.nmesh == 0 and report.notes.of("link", "e")
    assert any("stand-in" in w or "in place of" in w for w in report.notes.of("link", "e"))


def test_the_folder_that_a_refusal_names(tmp_path):
    """Assemblies take meshes from folders beside their own: passing the flag that the message names is enough."""
    base = tmp_path.resolve() / "robots"
    make.box(base / "arms" / "one arm" / "meshes" / "e.stl", (0, 0, 0), (0.1, 0.1, 0.1))
    text = make.arm(2, with_mesh("../../arms/one arm/meshes/e.stl"), make.joint("j", "l2", "e"))
    urdf = make.write(base / "assembly" / "both", text)
    with pytest.raises(UserError) as caught:
        import_urdf(urdf, tmp_path / "out")
    assert f"pass --package arms={base / 'arms'}, if" in str(caught.value)
    assert not any("mesh" in w for w in import_urdf(urdf, tmp_path / "out", {"arms": base / "arms"}).warnings)


def test_meshes_of_an_unread_format_share_a_warning(tmp_path):
    (tmp_path / "in").mkdir()
    for name in ("l0", "l1", "l2"):
        (tmp_path / "in" / f"{name}.glb").write_bytes(b"glTF")
    links = [make.link(f"l{i}", make.inertial(0.1), make.mesh(f"l{i}.glb", "visual"), make.mesh("no.stl")) for i in range(3)]
    text = make.robot(*links, make.joint("a", "l0", "l1"), make.joint("b", "l1", "l2"))
    report = import_urdf(make.write(tmp_path / "in", text), tmp_path / "out")
    told = [w for w in report.warnings if "only stl, obj, dae are read" in w]
    assert len(told) == 1 and "3 meshes" in told[0]
    assert len([w for w in report.warnings if "there is no such file" in w]) == 1


def test_meshes_that_name_files(tmp_path, secret, monkeypatch):
    """Materials and textures of other files are not opened."""
    solid = make.box(tmp_path / "in" / "m.obj", (0, 0, 0), (0.1, 0.1, 0.1))
    solid.write_text(f"mtllib ../secret/x.mtl\nmtllib {secret.parent}/x.mtl\nusemtl y\n" + solid.read_text())
    (secret.parent / "x.mtl").write_text("newmtl y\nmap_Kd s.png\n")
    collada = make.box(tmp_path / "in" / "m.dae", (0, 0, 0), (0.1, 0.1, 0.1))
    image = f'<library_images><image id="i"><init_from>file://{secret}</init_from></image></library_images><library_geometries'
    collada.write_text(collada.read_text().replace("<library_geometries", image, 1))
    opened = []
    original = builtins.open
    monkeypatch.setattr(builtins, "open", lambda file, *a, **k: (opened.append(str(file)), original(file, *a, **k))[1])
    text = make.arm(
        2,
        with_mesh("m.obj"),
        make.joint("j", "l2", "e"),
        make.link("f", make.mesh("m.dae", "visual")),
        make.joint("k", "e", "f", "fixed"),
    )
    report = import_urdf(make.write(tmp_path / "in", text), tmp_path / "out")
    assert report.links["e"]["meshes"] and report.links["f"]["meshes"]
    assert not any("secret" in name for name in opened)


def test_one_missing_mesh_of_two(tmp_path):
    """The collision's mesh is drawn where the visual's is missing, and the other way round."""
    make.box(tmp_path / "in" / "m.stl", (0, 0, 0), (0.1, 0.06, 0.02))
    for visual, collision in (("no.dae", "m.stl"), ("m.stl", "no.stl")):
        body = make.link("e", make.inertial(0.1), make.mesh(visual, "visual"), make.mesh(collision))
        report = import_urdf(
            make.write(tmp_path / "in", make.arm(2, body, make.joint("j", "l2", "e"))), tmp_path / "o", force=True
        )
        assert report.links["e"]["meshes"] == ["m"] and report.links["e"]["shapes"][0]["covered"] > 0.95
        assert len([w for w in report.warnings if "no such file" in w]) == 1
        assert len([n for n in report.notes.of("link", "e") if "no such file" in n]) == 1


def test_strict(tmp_path):
    refused(tmp_path, make.arm(2, with_mesh("no.stl"), make.joint("j", "l2", "e")), "--strict.*no such file", strict=True)


@pytest.mark.parametrize(
    "limit, match, expected",
    [
        ('lower="1" upper="-1"', "reversed", (-1.0, 1.0)),
        ('lower="nan" upper="1"', "half a turn", (-3.141592653589793, 3.141592653589793)),
        ('lower="-inf" upper="inf"', "half a turn", (-3.141592653589793, 3.141592653589793)),
        ('lower="0" upper="0"', "half a turn", (-3.141592653589793, 3.141592653589793)),
        ("", "half a turn", (-3.141592653589793, 3.141592653589793)),
    ],
)
def test_limits(tmp_path, limit, match, expected):
    model, report = warned(tmp_path, limited(limit), match)
    assert tuple(model.joint("j").range) == expected
    assert min(report.robot.arm.effort) > 0 and min(report.robot.arm.speed) > 0


def test_bad_efforts(tmp_path):
    text = limited('lower="-1" upper="1" effort="-5" velocity="nan"')
    report = import_urdf(make.write(tmp_path / "in", text), tmp_path / "out")
    assert report.robot.arm.effort[-1] > 0 and 0 < report.robot.arm.speed[-1] <= 2
    assert report.joints["j"]["effort"] is None and report.joints["j"]["velocity"] is None


@pytest.mark.parametrize(
    "inertial",
    [
        "",
        make.inertial(0.0),
        make.inertial(1e-9, moments="0 0 0 0 0 0"),
        make.inertial(-3.0),
        make.inertial(float("nan")),
        make.inertial(0.5, moments="nan 0 0 1 0 1"),
        make.inertial(0.5, moments="0 0 0 0 0 0"),
        make.inertial(0.5, moments="1 0 0 1 0 9"),
        make.inertial(0.5, moments="-1 0 0 -1 0 -1"),
        make.inertial(0.5, moments="1 5 5 1 5 1"),
        make.inertial(0.5, moments="inf 0 0 1 0 1"),
        "<inertial/>",
        '<inertial><mass value="0.5"/></inertial>',
        '<inertial><mass value="0.5"/><inertia ixx="1e-3"/></inertial>',
    ],
)
def test_broken_inertias(tmp_path, inertial):
    text = make.arm(2, make.link("e", inertial), make.joint("j", "l2", "e"))
    report = import_urdf(make.write(tmp_path / "in", text), tmp_path / "out")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))
    body = model.body("e")
    small, middle, large = sorted(body.inertia)
    assert body.mass[0] >= 1e-3 and small > 0 and small + middle >= large * (1 - 1e-9)
    assert report.notes.of("link", "e")
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    assert abs(data.qacc).max() < 1e4


def test_names_that_scenes_use(tmp_path):
    text = GOOD.replace('"l1"', '"cube"').replace('"l2"', '"world"').replace('"j1"', '"cube"').replace('"l3"', '"ee"')
    text = text.replace("</robot>", make.link("goal", make.inertial()) + make.joint("w", "ee", "goal", "fixed") + "</robot>")
    model, report = warned(tmp_path, text, "renamed")
    assert {"cube_link", "world_link", "ee"} <= {model.body(i).name for i in range(model.nbody)}
    assert report.robot.arm.joints[0] == "cube_joint" and "goal_link" in report.links


def test_odd_names(tmp_path):
    odd = "a/../b &amp; &lt;c&gt; [red]é'"
    text = GOOD.replace('"l1"', f'"{odd}"').replace('"j2"', f'"{odd}"').replace('name="arm"', 'name="../../x"')
    report = import_urdf(make.write(tmp_path / "in", text), tmp_path / "out")
    assert robot_file.read(tmp_path / "out").arm.joints[1] == report.robot.arm.joints[1] == "a/../b & <c> [red]é'"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "out"]


def test_shapes_left_out(tmp_path):
    shapes = "".join(
        make.shape(g) for g in ('<capsule radius="1"/>', '<box size="1 1 0"/>', "<!-- x -->", '<sphere radius="-1"/>')
    )
    shapes += make.shape('<mesh filename=""/>') + make.shape('<mesh filename="m.stl" scale="0 1 1"/>') + "<visual/>"
    model, report = warned(tmp_path, make.arm(2, make.link("e", make.inertial(), shapes), make.joint("j", "l2", "e")), "left out")
    assert len(report.warnings) >= 7 and not report.links["e"]["shapes"]


@pytest.mark.parametrize(
    "text, match",
    [
        ("", "takes joint"),
        ("- 1", "takes joint"),
        ("j9: {stiffness: 1, damping: 1}", "names joint 'j9': choose from j1, j2, j3"),
        ("j1: 4", "takes stiffness and damping"),
        ("j1: {stiffness: 1}", "takes stiffness and damping"),
        ("j1: {stiffness: 1, damping: 1, mass: 2}", "takes stiffness and damping"),
        ("j1: {stiffness: -1, damping: 1}", "above 0"),
        ("j1: {stiffness: .nan, damping: 1}", "stiffness takes a finite number, got nan"),
        ("j1: {stiffness: yes, damping: 1}", "stiffness takes a finite number, got True"),
        ("j1: {stiffness: 1", "is not YAML"),
        ("!!python/object/apply:os.system ['true']", "is not YAML"),
    ],
)
def test_gains(tmp_path, text, match):
    (tmp_path / "gains.yaml").write_text(text)
    refused(tmp_path, GOOD, match, gains=tmp_path / "gains.yaml")


def test_out_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot write|not a folder"):
        import_urdf(make.write(tmp_path / "in", GOOD), tmp_path / "file" / "out")


PACKAGE = '<?xml version="1.0"?><package format="3"><name>{}</name></package>'


def in_packages(folder: pathlib.Path) -> pathlib.Path:
    """A folder in package ``arm_description``, with package ``hand`` beside that and ``tool`` beside their folder."""
    for package, name in (("repo/group/arm", "arm_description"), ("repo/group/hand", "hand"), ("repo/tool", "tool")):
        make.write(folder / "work" / package, PACKAGE.format(name), "package.xml")
        make.box(folder / "work" / package / "meshes" / "m.stl", (0, 0, 0), (0.1, 0.1, 0.1))
    return folder / "work" / "repo" / "group" / "arm" / "urdf" / "a"


@pytest.mark.parametrize("name", ["package://arm_description", "package://hand", "package://tool", "model://hand", "../.."])
def test_packages_that_lie_about(tmp_path, name):
    here = in_packages(tmp_path)
    text = make.arm(2, make.link("e", make.inertial(), make.mesh(f"{name}/meshes/m.stl")), make.joint("j", "l2", "e"))
    report = import_urdf(make.write(here, text), tmp_path / "out")
    assert report.links["e"]["meshes"] == ["m"] and not any("mesh" in w for w in report.warnings)


def test_packages_that_are_none(tmp_path):
    """Neither a folder without package.xml nor a link, nor what lies in one above that the URDF does not name."""
    here = in_packages(tmp_path)
    make.box(tmp_path / "work" / "repo" / "plain" / "m.stl", (0, 0, 0), (1, 1, 1))
    make.write(tmp_path / "far" / "secret", PACKAGE.format("linked"), "package.xml")
    make.box(tmp_path / "far" / "secret" / "m.stl", (0, 0, 0), (1, 1, 1))
    (tmp_path / "work" / "repo" / "linked").symlink_to(tmp_path / "far" / "secret")
    roots = files.Roots(here / "robot.urdf", {})
    for package in ("plain", "linked", "secret"):
        with pytest.raises(files.Missing, match=f"--package {package}=DIR"):
            roots.find(f"package://{package}/m.stl")
    for name in (
        "../../../../plain/m.stl",
        "../../../../tool/meshes/m.stl",
        "package://hand/../../plain/m.stl",
    ):
        with pytest.raises(UserError, match="lies outside"):
            roots.find(name)
    assert roots.find("package://tool/meshes/m.stl").is_file()
    with pytest.raises(files.Missing, match="in package 'hand', which is"):
        roots.find("package://hand/no.stl")


@pytest.mark.parametrize(
    "urdf, there, name, found",
    [
        # name of the URDF's folder, files that exist (a package.xml with its name), name in the URDF, the file found
        ("other", ["other/m.stl"], "package://pkg/m.stl", None),
        ("other/urdf", ["other/m.stl"], "package://pkg/m.stl", None),
        ("other", ["other/m.stl"], "package://pkg/../m.stl", None),
        ("a pkg/urdf", ["a pkg/m.stl"], "package://a pkg/m.stl", "a pkg/m.stl"),
        ("other", ["other/m.stl", "other/package.xml:third"], "package://pkg/m.stl", None),
        ("other", ["other/m.stl", "beside/m.stl"], "package://pkg/m.stl", None),
        ("other", ["other/m.stl", "other/package.xml:pkg"], "package://pkg/m.stl", "other/m.stl"),
        ("other/urdf", ["other/m.stl", "other/package.xml:pkg"], "package://pkg/m.stl", "other/m.stl"),
        ("pkg/urdf", ["pkg/m.stl"], "package://pkg/m.stl", "pkg/m.stl"),
        ("pkg", ["pkg/m.stl"], "package://pkg/m.stl", "pkg/m.stl"),
        ("other", ["other/pkg/m.stl"], "package://pkg/m.stl", "other/pkg/m.stl"),
        ("other", ["other/meshes/m.stl"], "package://meshes/m.stl", "other/meshes/m.stl"),
        ("other/urdf", ["other/meshes/m.stl"], "package://meshes/m.stl", "other/meshes/m.stl"),
        # the nearest, and of several the one that holds the file
        ("a/b/pkg/urdf", ["pkg/m.stl", "pkg/package.xml:pkg", "a/b/pkg/m.stl"], "package://pkg/m.stl", "a/b/pkg/m.stl"),
        ("a/b/pkg/urdf", ["pkg/m.stl", "pkg/package.xml:pkg", "a/b/pkg/n.stl"], "package://pkg/m.stl", "pkg/m.stl"),
        ("a/b", ["pkg/m.stl", "pkg/package.xml:pkg", "a/pkg/package.xml:pkg"], "package://pkg/m.stl", "pkg/m.stl"),
        # paths of another machine
        ("pkg/urdf", ["pkg/s/m.stl"], "file:///home/no/share/pkg/s/m.stl", "pkg/s/m.stl"),
        ("pkg/urdf", ["pkg/s/m.stl"], "/home/no/pkg/s/m.stl", "pkg/s/m.stl"),
        ("pkg/urdf", ["pkg/s/a b.stl"], "file:///home/no/pkg/s/a%20b.stl", "pkg/s/a b.stl"),
        ("pkg/urdf", ["pkg/s/m.stl"], "C:\\no\\pkg\\s\\m.stl", "pkg/s/m.stl"),
        ("a/b", ["pkg/m.stl", "pkg/package.xml:pkg"], "/home/no/pkg/m.stl", "pkg/m.stl"),
        ("other", ["other/pkg/m.stl"], "file:///home/no/share/pkg/m.stl", "other/pkg/m.stl"),
        ("other", ["other/m.stl", "other/pkg/n.stl"], "/home/no/pkg/m.stl", UserError),
        # in the own folders, at the longest tail of the path with a folder
        ("other", ["other/meshes/m.stl", "other/m.stl"], "/home/no/pkg/meshes/m.stl", "other/meshes/m.stl"),
        ("other/urdf", ["other/a/b/m.stl", "other/b/m.stl"], "package://pkg/c/a/b/m.stl", "other/a/b/m.stl"),
        ("other/urdf", ["other/meshes/m.stl"], "meshes/m.stl", "other/meshes/m.stl"),
        ("other", ["other/meshes/m.stl"], "../meshes/m.stl", UserError),
        ("other", ["secret/b/m.stl", "other/b>secret/b"], "package://pkg/b/m.stl", UserError),
        ("pkg", ["secret/m.stl", "pkg/n.stl"], "/home/no/pkg/../secret/m.stl", UserError),
        ("pkg", ["secret/m.stl", "pkg/m.stl>secret/m.stl"], "/home/no/pkg/m.stl", UserError),
        ("other", ["secret/m.stl", "other/pkg>secret"], "package://pkg/m.stl", UserError),
        ("a/b", ["s/x/m.stl", "s/x/package.xml:pkg", "pkg>s/x"], "package://pkg/m.stl", None),
        ("other", ["s/x/m.stl", "s/x/package.xml:pkg", "other/in>s/x"], "package://pkg/m.stl", None),
        # beside, in a folder that is called otherwise
        ("arm/urdf", ["arm/package.xml:arm", "hand_x/m.stl", "hand_x/package.xml:pkg"], "package://pkg/m.stl", "hand_x/m.stl"),
        ("arm/urdf", ["arm/package.xml:arm", "hand_x/m.stl", "hand_x/package.xml:no"], "package://pkg/m.stl", None),
        ("arm/urdf", ["arm/package.xml:arm", "a/x/m.stl", "a/x/package.xml:pkg"], "package://pkg/m.stl", None),
    ],
)
def test_what_is_a_package(tmp_path, urdf, there, name, found):
    (tmp_path / urdf).mkdir(parents=True)
    for file in there:
        path, sign, more = re.fullmatch(r"([^:>]*)([:>]?)(.*)", file).groups()
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        if sign == ">":
            (tmp_path / path).symlink_to(tmp_path / more)
        else:
            (tmp_path / path).write_text(PACKAGE.format(more) if sign else "")
    roots = files.Roots(tmp_path / urdf / "robot.urdf", {})
    if found is None:
        with pytest.raises(files.Absent, match="no folder here is package 'pkg': pass --package pkg=DIR"):
            roots.find(name)
    elif found is UserError:
        with pytest.raises(
            UserError, match=r"lies outside the URDF's folder: pass --package [\w.]+=/\S+, if you trust that folder"
        ):
            roots.find(name)
    else:
        assert roots.find(name) == tmp_path / found


def test_meshes_taken_from_elsewhere_are_said(tmp_path):
    make.box(tmp_path / "arm" / "meshes" / "m.stl", (-0.02, -0.02, 0), (0.02, 0.02, 0.1))
    text = make.arm(3).replace("</robot>", make.link("tip", make.mesh("package://gone/x/meshes/m.stl")) + "</robot>")
    text = text.replace("</robot>", make.joint("t", "l3", "tip", "fixed") + "</robot>")
    report = import_urdf(make.write(tmp_path / "arm" / "urdf", text), tmp_path / "out")
    assert any("meshes/m.stl': not where the name says, so taken from" in n.text for n in report.notes if n.kind == "repaired")
    assert not any("mesh" in text for text in report.warnings)


@pytest.mark.parametrize("package", ["", ".", "..", "a" * 5000])
def test_what_no_package_is_called(tmp_path, package):
    make.box(tmp_path / "pkg" / "m.stl", (0, 0, 0), (1, 1, 1))
    with pytest.raises(files.Absent):
        files.Roots(tmp_path / "pkg" / "urdf" / "robot.urdf", {}).find(f"package://{package}/m.stl")


@pytest.mark.parametrize("name", ["package://pkg/m.stl", "/home/no/pkg/m.stl", "file:///home/no/share/pkg/m.stl"])
def test_a_given_package_is_the_only_one(tmp_path, name):
    for folder in ("pkg", "given"):
        make.box(tmp_path / folder / "m.stl", (0, 0, 0), (1, 1, 1))
    roots = files.Roots(tmp_path / "pkg" / "robot.urdf", {"pkg": tmp_path / "given"})
    assert roots.find(name) == tmp_path / "given" / "m.stl"
    (tmp_path / "given" / "m.stl").unlink()
    with pytest.raises((files.Absent, UserError)):
        roots.find(name)


def test_a_home_is_no_package(tmp_path, monkeypatch):
    make.write(tmp_path, PACKAGE.format("me"), "package.xml")
    make.box(tmp_path / "m.stl", (0, 0, 0), (1, 1, 1))
    monkeypatch.setattr(pathlib.Path, "home", lambda: tmp_path)
    with pytest.raises(UserError, match="lies outside"):
        files.Roots(tmp_path / "in" / "robot.urdf", {}).find("../m.stl")
    with pytest.raises(files.Missing):
        files.Roots(tmp_path / "in" / "robot.urdf", {}).find(f"package://{tmp_path.name}/m.stl")


def test_missing_meshes_in_one_line(tmp_path):
    links = [make.link(f"e{i}", make.inertial(), make.mesh(f"package://{'ab'[i % 2]}/m{i}.stl")) for i in range(9)]
    joints = [make.joint(f"k{i}", "base", f"e{i}", "fixed") for i in range(9)]
    report = import_urdf(make.write(tmp_path / "in", make.arm(2, *links, *joints)), tmp_path / "out")
    (line,) = [w for w in report.warnings if "no such file" in w]
    assert "9 meshes" in line and "--package a=DIR" in line and "--package b=DIR" in line and len(line) < 500
