"""Objects from files: what is read of a mesh, how it is cut, weighed and kept, and how it rests in a scene."""

import dataclasses
import importlib.util
import pathlib
import re
import runpy
import shutil

import imageio.v3 as imageio
import mujoco
import numpy as np
import pytest
import trimesh

from mjx_nero import UserError
from mjx_nero.files import cache
from mjx_nero.sim import scene, solids
from mjx_nero.sim.meshes import body as bodies
from mjx_nero.sim.scene import ObjectCfg, SceneCfg, SimCfg
from mjx_nero.sim.solids import making, rests, solid, store
from mjx_nero.tasks import registry

EDGES = (0.04, 0.06, 0.1)
NAMES = solids.names()


@pytest.fixture
def block(tmp_path) -> pathlib.Path:
    """A box that stands beside its file's origin."""
    path = tmp_path / "block.obj"
    trimesh.creation.box(EDGES).apply_translation((1.0, 2.0, 3.0)).export(path)
    return path


@pytest.fixture(autouse=True)
def _forgotten(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    store._found.cache_clear()


def textured(folder: pathlib.Path) -> pathlib.Path:
    """A square slab whose picture has a red left half and a blue right half."""
    picture = np.zeros((8, 16, 3), np.uint8)
    picture[:, :8, 0] = picture[:, 8:, 2] = 255
    imageio.imwrite(folder / "skin.png", picture)
    (folder / "slab.mtl").write_text("newmtl skin\nKd 1 1 1\nmap_Kd skin.png\n")
    corners = [(x, y, z) for z in (0, 0.02) for y in (0, 0.1) for x in (0, 0.1)]
    lines = ["mtllib slab.mtl", *(f"v {x} {y} {z}" for x, y, z in corners), "vt 0 0", "vt 1 0", "vt 0 1", "vt 1 1", "usemtl skin"]
    lines += ["f 5/1 6/2 8/4 7/3", "f 1/1 3/3 4/4 2/2"]
    lines += [f"f {a}/1 {b}/1 {c}/1 {d}/1" for a, b, c, d in ((1, 2, 6, 5), (2, 4, 8, 6), (4, 3, 7, 8), (3, 1, 5, 7))]
    (folder / "slab.obj").write_text("\n".join(lines) + "\n")
    return folder / "slab.obj"


def test_mass_and_rests_of_a_box(block):
    """By hand: m = rho x y z, I_xx = m (y^2 + z^2) / 12; it rests on six sides, and most often on the largest."""
    found = solids.find(str(block))
    x, y, z = EDGES
    assert found.volume == pytest.approx(x * y * z) and found.center == pytest.approx((1, 2, 3))
    by_hand = found.volume / 12 * np.diag([y * y + z * z, x * x + z * z, x * x + y * y])
    assert found.inertia == pytest.approx(by_hand, abs=1e-12) and found.sizes.tolist() == [8]
    heights = [found.height(quat) for quat in found.rest_quat]
    assert sorted(np.round(heights, 4)) == [0.02, 0.02, 0.03, 0.03, 0.05, 0.05] and heights[0] == pytest.approx(0.02, abs=1e-4)
    assert found.rest_share.sum() == pytest.approx(1) and found.rest_share[0] == found.rest_share.max()
    larger = found.scaled(2.0)
    assert larger.volume == pytest.approx(8 * found.volume) and larger.inertia == pytest.approx(32 * found.inertia)
    item = ObjectCfg(shape="mesh", file=str(block), scale=2.0, density=300.0)
    assert item.masses == [pytest.approx(300 * 8 * x * y * z)] and item.rest_height == pytest.approx(0.1, abs=1e-4)


@pytest.mark.parametrize("kind", ["stl", "glb", "obj"])
def test_kinds_of_files(tmp_path, kind):
    """The same solid from each; glTF's y is up, so its box lies turned."""
    mesh = trimesh.creation.box(EDGES)
    mesh.export(tmp_path / f"a.{kind}")
    found = solids.find(str(tmp_path / f"a.{kind}"))
    x, y, z = EDGES
    assert np.ptp(found.points, axis=0) == pytest.approx((x, z, y) if kind == "glb" else (x, y, z), abs=1e-6)
    assert found.volume == pytest.approx(x * y * z, rel=1e-5)


def test_texture_is_drawn(tmp_path):
    found = solids.find(str(textured(tmp_path)))
    assert found.texture.shape == (8, 16, 3) and len(found.uv) == len(found.vertices) and found.sizes.tolist() == [8]
    cube = ObjectCfg(shape="mesh", file=str(tmp_path / "slab.obj"))
    model = scene.build(registry.robot("nero"), SceneCfg(objects={"cube": cube}), SimCfg())
    geom = model.geom(bodies.drawn_name("cube", 0))
    material = model.geom_matid[geom.id]
    texture = model.mat_texid[material, mujoco.mjtTextureRole.mjTEXROLE_RGB]
    assert (model.tex_width[texture], model.tex_height[texture]) == (16, 8)
    # MuJoCo counts rows of pixels from above: the corner at the file's origin has the picture's lowest row.
    of = model.mesh(model.geom_dataid[geom.id])
    assert model.mesh_texcoordnum[of.id] == len(found.uv)
    rows = {tuple(row) for row in np.round(model.mesh_texcoord[of.texcoordadr[0] :][: len(found.uv)], 6)}
    assert rows == {(0, 0), (0, 1), (1, 0), (1, 1)}


def test_own_objects_are_what_their_script_makes(tmp_path):
    makes = runpy.run_path(str(store.HOME / "make.py"))
    assert sorted(makes["OBJECTS"]) == list(NAMES) and len(NAMES) == 12
    assert sum(path.stat().st_size for path in store.HOME.rglob("*") if path.is_file()) < 1_500_000
    for name, (make, density, _) in makes["OBJECTS"].items():
        parts = [trimesh.PointCloud(points).convex_hull for points in make()]
        assert (store.HOME / name / "parts.obj").read_text() == makes["_obj"](parts), name
        found = solids.find(name)
        assert len(found.sizes) == len(parts) <= solid.MAX_PARTS and found.sizes.max() <= solid.MAX_CORNERS
        assert found.density == density and 0.03 < density * found.volume < 0.3
        for part in parts:  # each part lies in the union, and the union in the parts' hull
            assert part.volume <= found.volume * 1.001


def test_own_objects_rest_where_they_are_put():
    """All of them beside one another in a task's scene, in one rest after the other, for half a second each."""
    items = {name: ObjectCfg(shape="mesh", file=name) for name in NAMES}
    model = scene.build(registry.robot("nero"), SceneCfg(objects=items), SimCfg(), visuals=False, fuse=True)
    data, solids = mujoco.MjData(model), {name: item.solids[0] for name, item in items.items()}
    for k in range(max(len(found.rest_quat) for found in solids.values())):
        mujoco.mj_resetData(model, data)
        put = {}
        for i, (name, found) in enumerate(solids.items()):
            quat, at = found.rest_quat[k % len(found.rest_quat)], model.joint(name).qposadr[0]
            put[name] = at, [0.5, 0.5 + 0.4 * i, found.height(quat), *quat]
            data.qpos[at : at + 7] = put[name][1]
        for _ in range(50):
            mujoco.mj_step(model, data)
        for name, (at, pose) in put.items():
            assert model.body(name).mass == pytest.approx(items[name].masses[0])
            assert np.linalg.norm(data.qpos[at : at + 3] - pose[:3]) < 2e-3, (name, k)
            assert rests.up(np.array(pose[3:])) @ rests.up(data.qpos[at + 3 : at + 7]) > np.cos(0.03), (name, k)


def test_cut_once_and_kept_in_the_users_cache(tmp_path, monkeypatch):
    """An L of two boxes is cut into two parts or a few; the second time nothing is cut."""
    parts = [trimesh.creation.box((0.1, 0.03, 0.02)), trimesh.creation.box((0.02, 0.03, 0.1)).apply_translation((-0.04, 0, 0.04))]
    path = tmp_path / "l.stl"
    trimesh.boolean.union(parts, engine="manifold").export(path)
    found = solids.find(str(path))
    assert 2 <= len(found.sizes) <= 4
    hulls = sum(trimesh.PointCloud(part).convex_hull.volume for part in found.parts)
    assert hulls == pytest.approx(found.volume, rel=0.1)
    assert {each.name for each in tmp_path.iterdir()} == {"l.stl", "cache"}
    (kept,) = (tmp_path / "cache" / "mjx_nero" / "objects").iterdir()

    def refuse(*_):
        raise AssertionError("cut again")

    monkeypatch.setattr(making, "make", refuse)
    store._found.cache_clear()
    again = solids.find(str(path))
    for field in dataclasses.fields(found):
        np.testing.assert_array_equal(getattr(again, field.name), getattr(found, field.name))
    kept.write_bytes(kept.read_bytes()[:-8])  # damaged
    store._found.cache_clear()
    with pytest.raises(AssertionError, match="cut again"):
        solids.find(str(path))


def test_without_a_cache_it_is_made_each_time(block, monkeypatch):
    monkeypatch.setattr(cache, "folder", lambda: None)
    first = solids.find(str(block))
    store._found.cache_clear()
    assert (solids.find(str(block)).points == first.points).all()


def test_convex_pieces_are_not_cut_again(tmp_path, monkeypatch):
    """A file of convex parts, as many simulators keep them, needs no library and stays exact."""
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "coacd" else there(name, *a))
    apart = [trimesh.creation.box((0.02, 0.02, 0.02)).apply_translation((x, 0, 0)) for x in (0.0, 0.05)]
    trimesh.util.concatenate(apart).export(tmp_path / "two.stl")
    found = solids.find(str(tmp_path / "two.stl"))
    assert found.sizes.tolist() == [8, 8] and found.volume == pytest.approx(2 * 0.02**3)
    assert sorted(part[:, 0].mean() for part in found.parts) == pytest.approx([-0.025, 0.025])


def test_a_scan_that_lacks_a_triangle_is_a_solid(tmp_path):
    """It is closed, weighed as a whole and, as it is convex, not cut."""
    ball = trimesh.creation.icosphere(2, 0.03)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export(tmp_path / "ball.obj")
    found = solids.find(str(tmp_path / "ball.obj"))
    assert len(found.sizes) == 1 and found.volume == pytest.approx(4 / 3 * np.pi * 0.03**3, rel=0.05)


def test_small_holes_are_filled_and_rims_are_not():
    """By hand: a tube of 20 cm, 2 cm wide and open at both ends, has holes of 6.3 cm; the rim of a cup is 3.1 times its width."""
    tube = trimesh.creation.cylinder(0.01, 0.2, sections=24)
    tube.update_faces(np.abs(tube.face_normals[:, 2]) < 0.5)
    assert not tube.is_watertight
    filled = making._filled(tube, 0.2)
    assert filled.is_volume and filled.volume == pytest.approx(np.pi * 0.01**2 * 0.2, rel=0.02)
    assert not making._filled(tube, 0.06).is_watertight
    cup = trimesh.creation.cylinder(0.04, 0.06, sections=24)
    cup.update_faces(cup.face_normals[:, 2] < 0.5)
    assert not making._filled(cup, 0.08).is_watertight


def test_what_is_coarser_is_still_closed(monkeypatch):
    """Folds that make a closed surface open are avoided by other counts and less force, if any of them does."""
    ball, tried = trimesh.creation.icosphere(5, 0.03), []

    def coarser(mesh, most, force):
        tried.append((most, force))
        found = trimesh.creation.icosphere(2, 0.03)
        if len(tried) < 5:
            found.update_faces(np.arange(len(found.faces)) > 0)
        return found

    monkeypatch.setattr(making, "_coarser", coarser)
    assert making._coarse(ball).is_volume and tried == [(2500, 7), (2500, 5), (2500, 3), (2000, 7), (2000, 5)]
    monkeypatch.setattr(making, "_coarser", lambda mesh, most, force: trimesh.creation.box().submesh([[0, 1]])[0])
    assert not making._coarse(ball).is_volume


def test_what_is_not_cut_in_time_is_cut_more_coarsely(tmp_path, monkeypatch):
    trimesh.creation.annulus(0.02, 0.04, 0.02).export(tmp_path / "ring.stl")
    tried = []

    def cut(mesh, surface, effort):
        tried.append((surface, effort))
        corners = trimesh.creation.box((0.08, 0.08, 0.02)).vertices
        return [np.asarray(corners)] if effort == "quick" else None

    monkeypatch.setattr(making, "_cut_apart", cut)
    assert len(solids.find(str(tmp_path / "ring.stl")).sizes) == 1 and tried == [("closed", "careful"), ("closed", "quick")]
    shutil.rmtree(tmp_path / "cache")
    store._found.cache_clear()
    monkeypatch.setattr(making, "_cut_apart", lambda *a: None)
    with pytest.raises(UserError, match="ring.stl cannot be cut into convex parts in time and memory"):
        solids.find(str(tmp_path / "ring.stl"))


def test_without_the_library(tmp_path, monkeypatch):
    trimesh.creation.annulus(0.02, 0.04, 0.02).export(tmp_path / "ring.stl")
    there = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name, *a: None if name == "coacd" else there(name, *a))
    with pytest.raises(UserError, match=r"ring.stl is not convex, and .* needs coacd: install the extra \(pip install"):
        solids.find(str(tmp_path / "ring.stl"))


@pytest.mark.parametrize(
    ("name", "text", "says"),
    [
        ("a.obj", "v 0 0 0\n", "holds no triangles"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "encloses nothing"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 nan 0\nf 1 2 3\n", "not finite"),
        ("a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 4\n", "vertices that it does not have"),
        ("a.obj", "v 0 0\nv 1 0\nv 0 1\nf 1 2 3\n", "v lines do not all have the same number of values, 3 or more"),
        ("a.obj", "mtllib ../m.mtl\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not below its own folder"),
        ("a.obj", "mtllib /etc/passwd\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not below its own folder"),
        (
            "a.obj",
            "".join(f"v {i} 0 0\nv {i} 1 0\nv {i} 0 {1 + i % 7}\nf {3 * i + 1} {3 * i + 2} {3 * i + 3}\n" for i in range(400)),
            "400 disconnected pieces",
        ),
        ("a.stl", "solid x\nendsolid x\n", "holds no triangles"),
        ("a.stl", "x" * 200, "neither a binary file"),
        ("a.glb", "glTF", "not a glTF 2 file"),
    ],
)
def test_faults_of_files(tmp_path, name, text, says):
    (tmp_path / name).write_text(text)
    with pytest.raises(UserError, match=says):
        solids.find(str(tmp_path / name))


def test_faults_of_configs(block, tmp_path):
    robot = registry.robot("nero")
    for fields, says in (
        ({"file": "mugg"}, r"no object 'mugg' \(did you mean 'mug'\?\): give a file"),
        ({"file": str(tmp_path / "none.obj")}, "cannot read .*none.obj: No such file"),
        ({"file": str(block), "scale": 1000.0}, "is 100 m long: give scale"),
        ({"file": "mug", "condim": 2}, "condim must be"),
    ):
        with pytest.raises(UserError, match=says):
            scene.build(robot, SceneCfg(objects={"cube": ObjectCfg(shape="mesh", **fields)}), SimCfg())


def test_inspection(call, block):
    code, out, err = call("mjx_nero", "inspect", "--object", block, "--scale", 0.5, "--json", "a.json")
    assert code == 0 and not err and "20.0 x 30.0 x 50.0 mm" in out and "0.015 kg, at 500 kg/m³" in out and "10.0 mm" in out
    out = call("mjx_nero", "inspect", "--object", block, "--scale", 100)[1]
    assert "is 10 m long: give scale (now 100; 0.001 if the file is in millimetres" in " ".join(out.split())
    code, _, err = call("mjx_nero", "inspect", "--object", "none.stl")
    assert code == 2 and err.startswith("error: cannot read none.stl")


def test_the_guides_bank():
    """The Python of docs/guides/objects.md."""
    page = pathlib.Path(__file__).parents[2] / "docs" / "guides" / "objects.md"
    (snippet,) = re.findall(r"^```python\n(.*?)^```", page.read_text(), re.MULTILINE | re.DOTALL)
    names: dict = {}
    exec(snippet, names)
    assert list(names["env"].blank().start.shape) == ["thing"]
