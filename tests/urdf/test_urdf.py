"""What the URDF importer makes of sound robots."""

import json
from pathlib import Path

import model_checks as check
import mujoco
import numpy as np
import pytest
import trimesh
import urdf_files as make
import yourdfpy
from mujoco import mjx
from scipy import optimize
from test_nero_model import EXTENTS, MASSES

import mjx_nero
from mjx_nero.sim import grasp, robot_file, scene
from mjx_nero.tasks import registry
from mjx_nero.tools.import_urdf import main
from mjx_nero.types import UserError
from mjx_nero.urdf import drawing, drives, files, geometry, import_urdf, inertia, meshes, primitives, read
from mjx_nero.urdf import folder as model_folder
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Mass, bodies
from mjx_nero.urdf.units import METRES, Units, check_lengths

KINDS = {int(getattr(mujoco.mjtGeom, f"mjGEOM_{k.upper()}")): k for k in ("plane", "sphere", "capsule", "box")}
EXACT = {"rtol": 0, "atol": 1e-12}


@pytest.fixture(scope="module")
def nero(tmp_path_factory) -> tuple[Path, mjx_nero.urdf.Report]:
    folder = tmp_path_factory.mktemp("nero")
    return folder, import_urdf(make.nero(folder / "in", EXTENTS), folder / "out")


@pytest.fixture(scope="module")
def piper(tmp_path_factory) -> tuple[Path, mjx_nero.urdf.Report]:
    folder = tmp_path_factory.mktemp("piper")
    return folder, import_urdf(make.piper(folder / "in"), folder / "out")


def imported(folder: Path, text: str, **options) -> tuple[mujoco.MjModel, mjx_nero.urdf.Report]:
    report = import_urdf(make.write(folder / "in", text), folder / "out", **options)
    return mujoco.MjModel.from_xml_path(str(folder / "out" / "model.xml")), report


def poses_agree(urdf: Path, out: Path, count: int) -> None:
    """Every link of the model is where yourdfpy's own kinematics puts it, in random configurations."""
    reference = yourdfpy.URDF.load(str(urdf), build_scene_graph=True, load_meshes=False)
    model = scene.robot_model(robot_file.read(out))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    links = [name for name in reference.link_map if name != "world"]
    for _ in range(count):
        q = {j.name: rng.uniform(*((j.limit.lower, j.limit.upper) if j.limit else (-3, 3))) for j in reference.actuated_joints}
        reference.update_cfg(q)
        for j in reference.robot.joints:
            if j.mimic is not None:
                q[j.name] = q[j.mimic.joint] * j.mimic.multiplier + j.mimic.offset
        for name, value in q.items():
            data.joint(name).qpos = value
        mujoco.mj_kinematics(model, data)
        for name in links:
            expected = reference.get_transform(name, reference.base_link)
            body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
            pos, turn = (data.xpos[body], data.xmat[body]) if body >= 0 else (data.site(name).xpos, data.site(name).xmat)
            np.testing.assert_allclose(pos, expected[:3, 3], rtol=0, atol=1e-6)
            np.testing.assert_allclose(turn.reshape(3, 3), expected[:3, :3], rtol=0, atol=1e-6)


def test_nero_kinematics(nero):
    poses_agree(nero[0] / "in" / "urdf" / "nero.urdf", nero[0] / "out", 100)


def test_piper_kinematics(piper):
    poses_agree(piper[0] / "in" / "piper.urdf", piper[0] / "out", 100)


def test_mass_is_kept(nero, piper):
    published = sum(MASSES.values()) - MASSES["link7"] + 1e-6
    for (folder, report), total in ((nero, published), (piper, 4.66)):
        model = mujoco.MjModel.from_xml_path(str(folder / "out" / "model.xml"))
        assert model.body_mass.sum() == pytest.approx(total, rel=1e-3)
        assert report.mass == pytest.approx(model.body_mass.sum()) and report.mass_read == pytest.approx(total, rel=1e-9)


def test_nero_bodies_and_joints(nero):
    model = mujoco.MjModel.from_xml_path(str(nero[0] / "out" / "model.xml"))
    moving = [*(f"joint{i}" for i in range(1, 8)), "gripper_joint1", "gripper_joint2"]
    assert [model.joint(i).name for i in range(model.njnt)] == moving
    assert {model.body(i).name for i in range(1, model.nbody)} == set(MASSES) - {"gripper_flange", "gripper_base"}
    assert {model.site(i).name for i in range(model.nsite)} == {"gripper_flange", "gripper_base", "ee"}
    assert tuple(model.joint("joint4").range) == (-1.01, 2.14)
    assert model.nu == model.nkey == model.nlight == model.ncam == 0
    assert (model.dof_armature > 0).all()


def test_nero_config(nero):
    robot = robot_file.read(nero[0] / "out")
    assert robot == registry.robot(nero[0] / "out")
    assert robot.arm.joints == tuple(f"joint{i}" for i in range(1, 8))
    assert robot.gripper.joints == ("gripper_joint1", "gripper_joint2")
    assert robot.gripper.open == (0.05, -0.05) and robot.gripper.close == (0.0, 0.0)
    assert robot.gravity_compensation and robot.base_link == "base_link"
    np.testing.assert_allclose(robot.base_quat, [np.cos(1.57), 0, 0, np.sin(1.57)], **EXACT)
    assert robot.arm.effort == (100.0,) * 7 and robot.gripper.effort == (10.0, 10.0)
    assert robot.down in ((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))
    # The fingers end at 0.1358 m: the grasp point lies in their last 40%, between them.
    model = mujoco.MjModel.from_xml_path(str(nero[0] / "out" / "model.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    base = data.site("gripper_base")
    at = base.xmat.reshape(3, 3).T @ (data.site("ee").xpos - base.xpos)
    np.testing.assert_allclose(at, [0, 0, 0.1358 - 0.2 * 0.0765], atol=1e-3)


def test_nero_pads(nero):
    """The pads' inner faces are as far apart as the fingers are."""
    model = mujoco.MjModel.from_xml_path(str(nero[0] / "out" / "model.xml"))
    data = mujoco.MjData(model)
    for opening in ((0.0, 0.0), (0.05, -0.05), (0.02, -0.04)):
        data.qpos[-2:] = opening
        mujoco.mj_kinematics(model, data)
        base, faces = data.site("gripper_base"), []
        for name in ("gripper_link1_pad", "gripper_link2_pad"):
            turn = base.xmat.reshape(3, 3).T @ data.geom(name).xmat.reshape(3, 3)
            centre = base.xmat.reshape(3, 3).T @ (data.geom(name).xpos - base.xpos)
            half = np.abs(turn) @ model.geom(name).size
            faces.append((centre[1] - half[1], centre[1] + half[1]))
            assert 0.1358 - 1e-3 < centre[2] + half[2] < 0.1358 + 1e-6
        assert faces[0][0] - faces[1][1] == pytest.approx(opening[0] - opening[1], abs=1e-3)


@pytest.mark.parametrize("name", ["nero", "piper"])
def test_geoms(name, request):
    folder, report = request.getfixturevalue(name)
    robot = robot_file.read(folder / "out")
    model = mujoco.MjModel.from_xml_path(str(robot.xml))
    for i in range(model.ngeom):
        geom = model.geom(i)
        assert geom.contype[0] == 0
        assert (geom.group[0], geom.conaffinity[0] > 0) != (2, True) and geom.group[0] in (2, 3)
        if geom.group[0] == 3:
            assert KINDS.get(geom.type[0]) in ("sphere", "capsule", "box")
            assert model.body(geom.bodyid[0]).name != "base_link"
            pad = geom.name.endswith("_pad")
            assert geom.conaffinity[0] == 3 if pad else geom.conaffinity[0] in (0, 1)
            assert geom.condim[0] == (4 if pad else 3)
    assert model.body_mass.sum() == pytest.approx(report.mass)  # no mass from geoms
    fast = scene.build(robot, scene.SceneCfg(), scene.SimCfg(), visuals=False)
    assert fast.nmesh == 0 and fast.body_mass.sum() == pytest.approx(report.mass + 0.03)
    assert check.contacts(fast)[1] == report.contacts["table_and_cube"] <= 56
    mjx.put_model(fast)


def test_nero_carries_a_cube(nero):
    """Physics with the default drives: the closed fingers hold a cube by friction alone, and the arm stays where it is."""
    robot = robot_file.read(nero[0] / "out")
    model = scene.build(robot, scene.SceneCfg(), scene.SimCfg(), visuals=False)
    data = mujoco.MjData(model)
    home = np.array(robot.home)
    home[3] = 2.0
    ids = [model.joint(j).qposadr[0] for j in robot.joints]
    data.qpos[ids] = home
    data.qpos[ids[-2:]] = 0.0165, -0.0165
    mujoco.mj_kinematics(model, data)
    ee, cube = data.site("ee"), data.body("cube")
    data.joint("cube").qpos[:3] = ee.xpos
    mujoco.mju_mat2Quat(data.joint("cube").qpos[3:], ee.xmat)
    data.ctrl[:] = home
    data.ctrl[-2:] = robot.gripper.close
    for _ in range(300):
        mujoco.mj_step(model, data)
    assert np.linalg.norm(cube.xpos - ee.xpos) < 3e-3
    assert np.abs(data.qpos[ids[:7]] - home[:7]).max() < 0.05


@pytest.mark.slow
def test_reach_runs_on_mjx(nero):
    jax = pytest.importorskip("jax")
    env = mjx_nero.make("reach", robot=nero[0] / "out", impl="jax")
    state = jax.jit(env.reset)(jax.random.PRNGKey(0))
    step = jax.jit(env.step)
    for _ in range(3):
        state = step(state, jax.numpy.full(env.action_size, 0.1))
    assert np.isfinite(np.asarray(state.pipeline_state.qpos)).all() and np.isfinite(float(state.reward))


@pytest.mark.parametrize("name", ["nero", "piper"])
def test_workspace_is_reachable(name, request):
    """Corners and centre, by inverse kinematics of scipy's own."""
    folder, _ = request.getfixturevalue(name)
    robot = robot_file.read(folder / "out")
    model = scene.robot_model(robot)
    data = mujoco.MjData(model)
    ids = [model.joint(j).qposadr[0] for j in robot.arm.joints]
    bounds = np.array([model.joint(j).range for j in robot.arm.joints]).T
    ranges = np.array(robot.workspace)
    assert ranges[2, 0] > 0.05 and ranges[0, 0] > 0  # above the table, in front
    rng = np.random.default_rng(0)

    def miss(q, goal):
        data.qpos[ids] = q
        mujoco.mj_kinematics(model, data)
        return data.site("ee").xpos - goal

    for goal in [ranges.mean(1), *(np.where(corner, ranges[:, 1], ranges[:, 0]) for corner in np.ndindex(2, 2, 2))]:
        best = 1.0
        for _ in range(8):
            start = rng.uniform(*bounds)
            best = min(best, np.linalg.norm(optimize.least_squares(miss, start, bounds=bounds, args=(goal,)).fun))
            if best < 1e-3:
                break
        assert best < 5e-3, goal


def test_report(nero):
    content = json.loads((nero[0] / "out" / "report.json").read_text())
    assert set(content["links"]) == set(MASSES) and content["mass"] == pytest.approx(content["mass_read"])
    assert content["warnings"] == []
    assert content["links"]["gripper_base"]["body"] == "link7"
    assert any("placeholder" in note for note in content["links"]["link7"]["notes"])
    assert any("armature" in note for note in content["joints"]["joint1"]["notes"])
    link2 = content["links"]["link2"]
    assert link2["covered"] > 0.95 and link2["shapes"][0]["kind"] == "box" and link2["shapes"][0]["fill"] > 0.9
    assert content["links"]["gripper_link1"]["covered"] > 0.95


def test_missing_meshes_get_stand_ins(piper):
    (warning,) = piper[1].warnings  # one line for all
    assert f"{2 * len(make.PIPER)} meshes" in warning and "there is no such file" in warning
    assert all("stand-in" in " ".join(piper[1].notes.of("link", name)) for name in make.PIPER)
    model = mujoco.MjModel.from_xml_path(str(piper[0] / "out" / "model.xml"))
    assert model.nmesh == 0 and {KINDS[t] for t in model.geom_type} <= {"capsule", "sphere", "box"}


def test_fixed_links_keep_mass_and_inertia(tmp_path):
    """Two point-like masses of 1 kg, 0.2 m apart along x, the second one turned: 2 * 1 kg * (0.1 m)^2 about y and z."""
    tiny = "1e-6 0 0 2e-6 0 2.5e-6"
    text = make.robot(
        make.link("base"),
        make.link("a", make.inertial(1, "0 0 0", tiny)),
        make.link("b", make.inertial(1, "0 0 0", tiny)),
        make.joint("j", "base", "a"),
        make.joint("weld", "a", "b", "fixed", xyz="0.2 0 0", rpy="0 0 1.5707963267948966"),
    )
    model, report = imported(tmp_path, text)
    body = model.body("a")
    np.testing.assert_allclose(body.ipos, [0.1, 0, 0], **EXACT)
    assert body.mass[0] == 2.0
    np.testing.assert_allclose(np.sort(body.inertia), [3e-6, 0.02 + 3e-6, 0.02 + 5e-6], rtol=1e-9)
    np.testing.assert_allclose(model.site("b").pos, [0.2, 0, 0], **EXACT)
    assert report.links["b"]["body"] == "a" and report.joints["weld"]["merged"]


def test_inertial_frame_is_turned(tmp_path):
    text = make.robot(
        make.link("base"),
        make.link("a", make.inertial(2, "0.1 0 0", "1e-3 0 0 2e-3 0 2.5e-3", rpy="0 0 1.5707963267948966")),
        make.joint("j", "base", "a"),
    )
    model, _ = imported(tmp_path, text)
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, model.body("a").iquat)
    tensor = turn.reshape(3, 3) @ np.diag(model.body("a").inertia) @ turn.reshape(3, 3).T
    np.testing.assert_allclose(tensor, np.diag([2e-3, 1e-3, 2.5e-3]), atol=1e-9)


FINGERS = (
    make.link("left", make.inertial(0.02), make.mesh("left.stl")),
    make.link("right", make.inertial(0.02), make.mesh("right.stl")),
)


def hand(folder: Path, *joints: str) -> str:
    """An arm with two fingers on ``l3``: 60 mm long, 10 mm thick, their inner faces at y = 0 of their frames."""
    make.box(folder / "in" / "left.stl", (-0.01, 0, 0), (0.01, 0.01, 0.06))
    make.box(folder / "in" / "right.stl", (-0.01, -0.01, 0), (0.01, 0, 0.06))
    return make.arm(3, *FINGERS, *joints)


def follows(model: mujoco.MjModel, equality: int, source: float) -> float:
    """Where an equality puts its first joint when the second is at ``source``."""
    first, second = (model.jnt_qposadr[ids[equality]] for ids in (model.eq_obj1id, model.eq_obj2id))
    terms = model.eq_data[equality]
    return model.qpos0[first] + terms[0] + terms[1] * (source - model.qpos0[second])


def test_mimic_becomes_an_equality(tmp_path):
    """Like Franka's hand: one driven slide, and one that follows it."""
    slide = {"type": "prismatic", "xyz": "0 0 0.2", "limit": 'lower="0" upper="0.04" effort="20" velocity="0.2"'}
    follow = '<mimic joint="f1" multiplier="1" offset="0"/>'
    text = hand(
        tmp_path,
        make.joint("f1", "l3", "left", axis="0 1 0", **slide),
        make.joint("f2", "l3", "right", axis="0 -1 0", inner=follow, **slide),
    )
    model, report = imported(tmp_path, text)
    robot = robot_file.read(tmp_path / "out")
    assert robot.gripper.joints == ("f1",) and robot.gripper.open == (0.04,) and robot.gripper.close == (0.0,)
    assert model.neq == 1 and model.eq_type[0] == mujoco.mjtEq.mjEQ_JOINT
    assert follows(model, 0, 0.013) == pytest.approx(0.013) and not model.eq_data[0, 2:5].any()
    assert model.joint("f2").qpos0[0] == 0.04  # starts where the driven one's home puts it
    assert (model.eq_obj1id[0], model.eq_obj2id[0]) == (model.joint("f2").id, model.joint("f1").id)
    assert report.joints["f2"]["mimic"] == {"joint": "f1", "multiplier": 1.0, "offset": 0.0}
    poses_agree(tmp_path / "in" / "robot.urdf", tmp_path / "out", 5)
    # the grasp point: between the distal 40% of the fingers
    np.testing.assert_allclose(model.site("ee").pos, [0, 0, 0.2 + 0.06 - 0.012], atol=1e-3)
    assert robot.down in ((0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


@pytest.mark.parametrize("limit", ["0 0.04", "0 0.01", "-0.01 0"], ids=["wrong sign", "wrong sign, short", "short"])
def test_followers_limits_do_not_stop_their_driver(tmp_path, limit):
    """A follower that mirrors its driver, -0.04 to 0 m, whose own limits would end that way or forbid it."""
    lower, upper = limit.split()
    slide = {"type": "prismatic", "xyz": "0 0 0.2", "axis": "0 1 0"}
    driver = 'lower="0" upper="0.04" effort="20" velocity="0.2"'
    text = hand(
        tmp_path,
        make.joint("f1", "l3", "left", limit=driver, **slide),
        make.joint(
            "f2", "l3", "right", limit=f'lower="{lower}" upper="{upper}"', inner='<mimic joint="f1" multiplier="-1"/>', **slide
        ),
    )
    model, _ = imported(tmp_path, text)
    model.opt.gravity[:] = 0.0
    np.testing.assert_allclose(model.joint("f2").range, [-0.04, 0.0])
    data = mujoco.MjData(model)
    for force, end in ((20.0, 0.04), (-20.0, 0.0), (20.0, 0.04)):
        data.joint("f1").qfrc_applied = force
        mujoco.mj_step(model, data, 1000)
        assert data.joint("f1").qpos[0] == pytest.approx(end, abs=2e-3)
        assert data.joint("f2").qpos[0] == pytest.approx(-end, abs=3e-3)


def test_fingers_press_no_harder_than_their_cube_bears(tmp_path):
    """250 N a kilogram, where the file allows 500 N; a cube of 30 to 40 mm weighs 27 to 64 g."""
    slide = {"type": "prismatic", "xyz": "0 0 0.2", "limit": 'lower="0" upper="0.04" effort="500" velocity="0.2"'}
    fingers = (make.joint("f1", "l3", "left", axis="0 1 0", **slide), make.joint("f2", "l3", "right", axis="0 -1 0", **slide))
    _, report = imported(tmp_path, hand(tmp_path, *fingers))
    mass = grasp.cube_for(report.robot).mass
    assert report.robot.gripper.effort == pytest.approx((250 * mass,) * 2, rel=0.01) and 5 < 250 * mass < 17
    assert any(note.startswith("repaired: effort 500 is more than fingers take") for note in report.notes.of("joint", "f1"))


def test_mimic_of_a_mimic(tmp_path):
    chain = '<mimic joint="f2" multiplier="2" offset="0.1"/>', '<mimic joint="f1" multiplier="-0.5" offset="0.2"/>'
    turn = {"axis": "1 0 0", "xyz": "0 0 0.2"}
    text = hand(
        tmp_path,
        make.joint("f1", "l3", "left", **turn),
        make.link("tip", make.inertial(0.01)),
        make.joint("f2", "l3", "right", inner=chain[1], **turn),
        make.joint("f3", "right", "tip", inner=chain[0], **turn),
    )
    model, report = imported(tmp_path, text)
    assert report.joints["f3"]["mimic"] == {"joint": "f1", "multiplier": -1.0, "offset": 0.5}
    assert follows(model, 0, 0.4) == pytest.approx(0.2 - 0.5 * 0.4)
    assert follows(model, 1, 0.4) == pytest.approx(0.1 + 2 * (0.2 - 0.5 * 0.4))


def test_one_jaw(tmp_path):
    """Like the SO-ARM: a jaw that turns against a fixed one; open is where the jaws are apart."""
    make.box(tmp_path / "in" / "jaw.stl", (-0.01, 0, 0), (0.01, 0.01, 0.08))
    make.box(tmp_path / "in" / "fixed.stl", (-0.01, -0.03, 0), (0.01, -0.02, 0.12))
    text = make.arm(
        3,
        make.link("fixed_jaw", make.inertial(0.1), make.mesh("fixed.stl")),
        make.link("jaw", make.inertial(0.02), make.mesh("jaw.stl")),
        make.joint("weld", "l3", "fixed_jaw", "fixed", xyz="0 0 0.2"),
        make.joint(
            "gripper",
            "fixed_jaw",
            "jaw",
            xyz="0 -0.02 0.04",
            axis="-1 0 0",
            limit='lower="-0.1" upper="1.5" effort="3" velocity="2"',
        ),
    )
    model, _ = imported(tmp_path, text)
    robot = robot_file.read(tmp_path / "out")
    assert robot.gripper.joints == ("gripper",) and robot.gripper.open == (1.5,) and robot.gripper.close == (-0.1,)
    pads = [model.geom(i) for i in range(model.ngeom) if model.geom_conaffinity[i] == 3]
    assert {g.name for g in pads} == {"jaw_pad", "fixed_jaw_pad"}
    assert 0.2 + 0.08 < model.site("ee").pos[2] < 0.2 + 0.12


def test_a_jaw_without_mesh_closes_on_a_pad_at_the_tools_frame(tmp_path):
    """The jaw's pivot lies 2 cm beside the plane of the tool's frame along x, 3 cm before the fixed jaw along y."""
    text = make.arm(
        3,
        make.link("palm", make.inertial(0.1, "0 0 0.1")),
        make.link("jaw", '<inertial><origin xyz="0.02 0 0.03"/><mass value="0.02"/></inertial>'),
        make.link("gripper_tcp"),
        make.joint("weld", "l3", "palm", "fixed", xyz="0 0 0.2"),
        make.joint("tool", "palm", "gripper_tcp", "fixed", xyz="0 0 0.09"),
        make.joint(
            "gripper", "palm", "jaw", xyz="0 0 0.03", axis="-1 0 0", limit='lower="0" upper="1.5" effort="3" velocity="2"'
        ),
    )
    model, report = imported(tmp_path, text)
    robot, data = report.robot, mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)  # closed
    moving, fixed = (data.geom(f"{name}_pad").xpos - data.site("ee").xpos for name in ("jaw", "palm"))
    turn = data.site("ee").xmat.reshape(3, 3)
    np.testing.assert_allclose(moving + fixed, 0, atol=2e-6)  # not 2 cm beside
    assert np.linalg.norm(moving - fixed) == pytest.approx(0.006, abs=1e-6)  # a pad's thickness apart: they touch
    toward = (moving - fixed) / 0.006  # the cube's middle is on the moving jaw's side, half an edge and 4 mm away
    np.testing.assert_allclose(turn @ robot.grip, toward * (grasp.edge(robot.opening, robot.pad) / 2 + 0.004), atol=1e-4)
    assert robot.opening > 0.03


def test_an_effort_of_one_is_a_placeholder(tmp_path):
    """1 N m against a kilogram half a metre away: 2 rad/s2 at most. Where it would do for a light arm it stays."""

    def arm(mass):
        limit = 'lower="-1" upper="1" effort="1" velocity="1"'
        link = make.link("l", f'<inertial><origin xyz="0 0 0.7"/><mass value="{mass}"/></inertial>')
        return make.robot(make.link("base", make.inertial()), link, make.joint("j", "base", "l", axis="0 1 0", limit=limit))

    heavy, light = (imported(tmp_path / name, arm(mass))[1] for name, mass in (("heavy", 2.0), ("light", 0.1)))
    assert (
        heavy.robot.arm.effort[0] == pytest.approx(heavy.robot.arm.stiffness[0] / 2, rel=1e-3) and heavy.robot.arm.effort[0] > 50
    )
    assert any(note.startswith("repaired: effort 1 is a placeholder") for note in heavy.notes.of("joint", "j"))
    assert light.robot.arm.effort == (1.0,)


def test_an_effort_that_cannot_hold_the_arm_is_none(tmp_path):
    """2 kg half a metre away: 9.81 N m when it lies; 9 N m cannot be its motor's, 11 N m may be."""

    def drive(name, effort):
        limit = f'lower="-3" upper="3" effort="{effort}" velocity="1"'
        link = make.link("l", '<inertial><origin xyz="0 0 0.5"/><mass value="2"/></inertial>')
        text = make.robot(make.link("base", make.inertial()), link, make.joint("j", "base", "l", axis="0 1 0", limit=limit))
        report = imported(tmp_path / name, text)[1]
        return report.robot.arm, [n for n in report.notes.of("joint", "j") if "cannot hold its own links, up to 9.8" in n]

    (weak, told), (strong, silent) = drive("weak", 9), drive("strong", 11)
    assert told and weak.effort[0] == pytest.approx(weak.stiffness[0] / 2, rel=1e-3) and weak.effort[0] > 50
    assert not silent and strong.effort == (11.0,)


def test_an_inertia_of_one_is_a_placeholder(tmp_path):
    """1 kg m2 for a kilogram within a few centimetres, as exporters write it; what a motor's rotor adds to a link stays."""

    def link(name, moments):
        return make.link(name, make.inertial(1.0, moments=moments), make.shape('<box size="0.05 0.05 0.1"/>'))

    limit = 'lower="-1" upper="1" effort="10" velocity="1"'
    joints = [make.joint(f"j{i}", a, b, xyz="0 0 0.1", axis="0 1 0", limit=limit) for i, (a, b) in enumerate(("ba", "ac"))]
    text = make.robot(make.link("b"), link("a", "1 0 0 1 0 1"), link("c", "0.01 0 0 0.01 0 0.01"), *joints)
    model, report = imported(tmp_path, text)
    np.testing.assert_allclose(np.sort(model.body("a").inertia), np.array([0.005, 0.0125, 0.0125]) / 12, rtol=1e-6)
    np.testing.assert_allclose(model.body("c").inertia, 0.01, rtol=1e-6)
    found = [text for text in report.warnings if "inertia" in text]
    assert len(found) == 1 and "the inertia of 'a' is more than 100 times" in found[0]


def test_arm_without_gripper(tmp_path):
    model, report = imported(tmp_path, make.arm(4))
    assert report.robot.gripper.joints == () and len(report.robot.arm.joints) == 4
    assert model.site("ee").bodyid[0] == model.body("l4").id and not model.site("ee").pos.any()


def test_choices_of_the_user(tmp_path):
    (tmp_path / "gains.yaml").write_text("j1: {stiffness: 11, damping: 2.5, effort: 7}\nf2: {stiffness: 300, damping: 0}\n")
    slide = {"type": "prismatic", "limit": 'lower="0" upper="0.04" effort="20" velocity="0.2"'}
    text = hand(
        tmp_path, make.joint("f1", "l3", "left", axis="0 1 0", **slide), make.joint("f2", "l3", "right", axis="0 -1 0", **slide)
    )
    _, report = imported(
        tmp_path, text, gripper=["f2"], ee="left:0,0,0.05", home={"j2": 0.5, "f2": 0.01}, gains=tmp_path / "gains.yaml"
    )
    robot = report.robot
    assert robot.gripper.joints == ("f2",) and robot.gripper.home == (0.01,)
    assert dict(zip(robot.arm.joints, robot.arm.home, strict=True)) == {"j1": 0.0, "j2": 0.5, "j3": 0.0}
    assert (robot.arm.stiffness[0], robot.arm.damping[0], robot.arm.effort[0], robot.arm.speed[0]) == (11.0, 2.5, 7.0, 2.0)
    model = mujoco.MjModel.from_xml_path(str(robot.xml))
    # The finger that no joint of the gripper drives is held still: a part of l3, 0.1 m up.
    assert model.site(robot.ee_site).bodyid[0] == model.body("l3").id
    np.testing.assert_allclose(model.site(robot.ee_site).pos, [0, 0, 0.15])
    assert import_urdf(tmp_path / "in" / "robot.urdf", tmp_path / "none", gripper=[]).robot.gripper.joints == ()


def test_tool_frame_is_the_grasp_point(tmp_path):
    text = make.arm(3, make.link("tool0"), make.joint("t", "l3", "tool0", "fixed", xyz="0 0 0.3", rpy="0 1.5707963267948966 0"))
    model, _ = imported(tmp_path, text)
    np.testing.assert_allclose(model.site("ee").pos, [0, 0, 0.3])
    np.testing.assert_allclose(model.site("ee").quat, [np.sqrt(0.5), 0, np.sqrt(0.5), 0], atol=1e-9)


def test_frame_of_the_flange_is_not_the_grasp_point(tmp_path):
    """With a gripper in front of it, ``tool0`` is passed over, and ``hand_tcp`` is taken."""
    slide = {"type": "prismatic", "xyz": "0 0 0.2", "limit": 'lower="0" upper="0.04" effort="20" velocity="0.2"'}
    moves = make.joint("f1", "l3", "left", axis="0 1 0", **slide), make.joint("f2", "l3", "right", axis="0 -1 0", **slide)
    tool = make.link("tool0"), make.joint("t", "l3", "tool0", "fixed", xyz="0 0 0.1")
    model, _ = imported(tmp_path, hand(tmp_path, *moves, *tool))
    np.testing.assert_allclose(model.site("ee").pos, [0, 0, 0.248], atol=1e-3)
    tcp = make.link("hand_tcp"), make.joint("u", "l3", "hand_tcp", "fixed", xyz="0 0 0.25")
    model, _ = imported(tmp_path, hand(tmp_path, *moves, *tool, *tcp), force=True)
    np.testing.assert_allclose(model.site("ee").pos, [0, 0, 0.25])


def test_limits_dynamics_and_continuous(tmp_path):
    text = make.robot(
        make.link("base"),
        make.link("a", make.inertial()),
        make.link("b", make.inertial()),
        make.joint(
            "j1", "base", "a", "continuous", limit='effort="5" velocity="1"', inner='<dynamics damping="0.7" friction="0.2"/>'
        ),
        make.joint("j2", "a", "b", limit='lower="1" upper="3" effort="5" velocity="9"', axis="0 3 4"),
    )
    model, report = imported(tmp_path, text)
    assert not model.jnt_limited[0] and model.dof_damping[0] == 0.7 and model.dof_frictionloss[0] == 0.2
    assert tuple(model.joint("j2").range) == (1.0, 3.0)
    np.testing.assert_allclose(model.joint("j2").axis, [0, 0.6, 0.8], **EXACT)
    assert report.robot.arm.home == (0.0, 2.0) and report.robot.arm.speed == (1.0, 2.0)
    assert any("axis" in n for n in report.notes.of("joint", "j2"))


@pytest.mark.parametrize("length, kind, size", [(0.2, "capsule", (0.05, 0.1)), (0.0, "sphere", (0.05,))])
def test_capsules_are_kept_as_they_are(tmp_path, length, kind, size):
    """The length is the cylinder's, without the round ends; without any length it is a ball."""
    capsule = f'<capsule radius="0.05" length="{length}"/>'
    shapes = [make.shape(capsule, tag, xyz="0.1 0 0.3", rpy="0 1.5707963267948966 0") for tag in ("visual", "collision")]
    model, report = imported(tmp_path, make.arm(2, make.link("e", *shapes), make.joint("j", "l2", "e", "fixed")))
    assert not [w for w in report.warnings if w.startswith("link e")] and report.links["e"]["covered"] == 1
    (row,) = report.links["e"]["shapes"]
    assert row["kind"] == kind and row["size"] == list(size)
    geoms = [model.geom(i) for i in range(model.ngeom) if KINDS[int(model.geom(i).type[0])] == kind]
    assert len(geoms) == 2  # one to look at, one that touches
    for geom in geoms:
        np.testing.assert_allclose(geom.size[: len(size)], size, **EXACT)
        np.testing.assert_allclose(geom.pos, [0.1, 0, 0.4], atol=1e-9)  # the joint is 0.1 m up
        if kind == "capsule":
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, geom.quat)
            np.testing.assert_allclose(np.abs(turn[2::3]), [1, 0, 0], atol=1e-9)


def test_capsules_are_weighed_by_their_volume(tmp_path):
    """No masses: as heavy as water, pi 0.05^2 0.2 + 4/3 pi 0.05^3 = 0.0020944 m3."""
    links = [make.link(name, make.shape('<capsule radius="0.05" length="0.2"/>')) for name in ("base", "a")]
    _, report = imported(tmp_path, make.robot(*links, make.joint("j", "base", "a")))
    assert report.links["a"]["mass"] == pytest.approx(2.0944, rel=0.03)
    np.testing.assert_allclose(
        geometry._solid("capsule", (0.05, 0.2)).bounds, [[-0.05, -0.05, -0.15], [0.05, 0.05, 0.15]], atol=1e-6
    )


def test_other_shapes_may_be_called_capsule(tmp_path):
    named = '<collision name="capsule"><geometry><cylinder radius="0.05" length="0.2"/></geometry></collision>'
    path = make.write(tmp_path, make.arm(2, make.link("e", named), make.joint("j", "l2", "e", "fixed")))
    tree, _ = read.read(path, files.Roots(path, {}), Notes())
    assert [shape.kind for shape in tree.links["e"].collisions] == ["cylinder"]


@pytest.mark.parametrize(
    "limit, degrees, expected, speed",
    [
        ('lower="-170" upper="90" velocity="180"', True, (-17 * np.pi / 18, np.pi / 2), np.pi),
        ('lower="-170" upper="90" velocity="180"', False, (-170.0, 90.0), 180.0),
        ('lower="0" upper="26" velocity="2"', False, (0.0, 26.0), 2.0),
        ('lower="-25" upper="25" velocity="2"', False, (-25.0, 25.0), 2.0),  # 8 pi = 25.13
        ('upper="90"', True, (0.0, np.pi / 2), None),
        ('lower="-3600" upper="3600" velocity="90"', True, (-20 * np.pi, 20 * np.pi), np.pi / 2),
    ],
)
def test_limits_in_degrees(tmp_path, limit, degrees, expected, speed):
    slide = make.joint("s", "l1", "tip", **{**make.SLIDE, "limit": 'lower="0" upper="30" velocity="60"'})
    text = make.arm(1, make.link("tip"), slide).replace('lower="-1" upper="1" effort="10" velocity="2"', limit)
    path, notes = make.write(tmp_path, text), Notes()
    tree, _ = read.read(path, files.Roots(path, {}), notes, units=Units(degrees))
    hinge, slider = tree.joints["j1"], tree.joints["s"]
    np.testing.assert_allclose([hinge.lower, hinge.upper], expected)
    assert hinge.velocity == (None if speed is None else pytest.approx(speed))
    assert (slider.lower, slider.upper, slider.velocity) == (0, 30, 60)
    suspected = [(n.kind, n.name) for n in notes if "looks like degrees" in n.text and "--degrees" in n.text]
    assert suspected == ([("warning", "j1")] if not degrees and max(map(abs, expected)) > 8 * np.pi else [])


def test_degrees_of_the_command(tmp_path):
    limit = 'lower="-90" upper="90" effort="10" velocity="60"'
    path = make.write(tmp_path / "in", make.arm(2).replace('lower="-1" upper="1" effort="10" velocity="2"', limit))
    with pytest.raises(UserError, match="--strict: joint j1: .*looks like degrees.*--degrees"):
        main([str(path), "--out", str(tmp_path / "out"), "--strict"])
    assert not (tmp_path / "out").exists()
    main([str(path), "--out", str(tmp_path / "out"), "--degrees", "--no-self-test"])
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))
    np.testing.assert_allclose(model.jnt_range, [[-np.pi / 2, np.pi / 2]] * 2, rtol=1e-6)


@pytest.mark.parametrize(
    "corner, scale, offset, wanted",
    [
        ((100, 20, 40), "1 1 1", 0.2, "0.001 0.001 0.001"),
        ((10, 2, 4), "5 -5 5", 0.2, "0.005 -0.005 0.005"),  # 50 m
        ((100, 20, 40), "0.001 0.001 0.001", 0.2, None),
        ((9, 2, 4), "1 1 1", 0.1, None),  # 10 m are the least
        ((12, 2, 4), "1 1 1", 0.3, None),  # 50 times 0.3 m are 15 m
    ],
)
def test_meshes_in_millimetres(tmp_path, corner, scale, offset, wanted):
    make.box(tmp_path / "in" / "m.stl", (0, 0, 0), corner)
    end = make.link("end", make.inertial(0.1), make.mesh("m.stl", scale=scale))
    path = make.write(tmp_path / "in", make.arm(2, end, make.joint("j", "l2", "end", xyz=f"0 0 {offset}")))
    roots, notes = files.Roots(path, {}), Notes()
    tree, _ = read.read(path, roots, notes)
    if wanted is None:
        check_lengths(tree, geometry.Looks(tree, bodies(tree), meshes.Meshes(roots), notes).spans, METRES)
        return
    with pytest.raises(UserError, match=f"'m.stl' .* millimetres; give it scale=\"{wanted}\"") as error:
        import_urdf(path, tmp_path / "out")
    assert "\n" not in str(error.value) and not (tmp_path / "out").exists()


@pytest.mark.parametrize("kind", ["stl", "obj", "dae"])
def test_meshes(tmp_path, kind):
    """Scaled and mirrored; the shape is where the mesh is."""
    make.box(tmp_path / "in" / f"m.{kind}", (0, 0, 0), (100, 20, 40))
    scaled = make.mesh(f"m.{kind}", scale="0.001 -0.001 0.001")
    text = make.arm(2, make.link("end", make.inertial(0.1), scaled), make.joint("j", "l2", "end", xyz="0 0 0.2"))
    model, report = imported(tmp_path, text)
    geom = model.geom("end")
    assert KINDS[geom.type[0]] == "box" and report.links["end"]["covered"] > 0.95
    np.testing.assert_allclose(geom.pos, [0.05, -0.01, 0.02], atol=1e-3)
    np.testing.assert_allclose(np.sort(geom.size), [0.01, 0.02, 0.05], atol=1e-3)
    assert model.nmesh == 1


def test_dae_units_and_colours(tmp_path):
    content = make.box(tmp_path / "in" / "m.dae", (0, 0, 0), (100, 20, 40)).read_text()
    assert 'meter="1.0"' in content or "<unit" not in content
    content = content.replace('meter="1.0"', 'meter="0.001"')
    if "<unit" not in content:
        content = content.replace("<up_axis>", '<unit name="millimeter" meter="0.001"/><up_axis>')
    (tmp_path / "in" / "m.dae").write_text(content)
    text = make.arm(2, make.link("end", make.inertial(0.1), make.mesh("m.dae")), make.joint("j", "l2", "end", xyz="0 0 0.2"))
    model, _ = imported(tmp_path, text)
    np.testing.assert_allclose(np.sort(model.geom("end").size), [0.01, 0.02, 0.05], atol=1e-3)


@pytest.mark.parametrize(
    "name", ["package://desc/meshes/m.stl", "package://mine/m.stl", "file://{}/desc/meshes/m.stl", "../meshes/m.stl"]
)
def test_where_meshes_are_found(tmp_path, name):
    make.box(tmp_path / "desc" / "meshes" / "m.stl", (0, 0, 0), (0.1, 0.1, 0.1))
    body = make.link("end", make.inertial(0.1), make.mesh(name.format(tmp_path)))
    path = make.write(tmp_path / "desc" / "urdf", make.arm(2, body, make.joint("j", "l2", "end")))
    report = import_urdf(path, tmp_path / "out", {"mine": tmp_path / "desc" / "meshes"})
    assert not any("mesh" in w for w in report.warnings) and report.links["end"]["meshes"] == ["m"]


@pytest.mark.parametrize("name", ["package://mine/a%20b.stl", "a%20b.stl", "file://{}/a%20b.stl"])
@pytest.mark.parametrize("written", ["a b.stl", "a%20b.stl"])
def test_percent_signs_in_mesh_names(tmp_path, name, written):
    make.box(tmp_path / written, (0, 0, 0), (0.1, 0.1, 0.1))
    body = make.link("end", make.inertial(0.1), make.mesh(name.format(tmp_path)))
    path = make.write(tmp_path, make.arm(2, body, make.joint("j", "l2", "end")))
    report = import_urdf(path, tmp_path / "out", {"mine": tmp_path})
    assert not any("mesh" in w for w in report.warnings) and len(report.links["end"]["meshes"]) == 1


@pytest.mark.parametrize(
    "limit, expected",
    [('lower="-1.9" upper="1.9"', (-1.9, 1.9)), ('lower="0" upper="0"', None), ('lower="-9" upper="9"', None), ("", None)],
)
def test_limits_of_continuous_joints(tmp_path, limit, expected):
    text = make.robot(
        make.link("base"),
        make.link("a", make.inertial()),
        make.joint("j1", "base", "a", "continuous", limit=f'{limit} effort="5" velocity="1"'),
    )
    model, report = imported(tmp_path, text)
    assert bool(model.jnt_limited[0]) == (expected is not None)
    if expected:
        assert tuple(model.joint("j1").range) == expected
    assert any("limits -1.9 .. 1.9" in w for w in report.warnings) == (expected is not None)


@pytest.mark.parametrize("limits", [{"MAX_FACES": 10_000}, {"MAX_DRAWN": 10_000}], ids=lambda limits: next(iter(limits)))
def test_large_meshes_are_made_coarser(tmp_path, monkeypatch, limits):
    for name, value in limits.items():
        monkeypatch.setattr(drawing, name, value)
    ball = trimesh.creation.icosphere(subdivisions=6, radius=0.1)  # 81,920 triangles
    (tmp_path / "in").mkdir()
    (tmp_path / "in" / "m.stl").write_bytes(trimesh.exchange.stl.export_stl(ball))
    text = make.arm(2, make.link("end", make.inertial(0.1), make.mesh("m.stl")), make.joint("j", "l2", "end"))
    model, report = imported(tmp_path, text)
    assert 1_000 < model.nmeshface <= 10_000
    assert KINDS[model.geom("end").type[0]] == "sphere" and model.geom("end").size[0] == pytest.approx(0.1, rel=0.01)
    assert any("triangles" in n for n in report.notes.of("link", "end"))


def test_meshes_share_the_triangles_that_are_drawn(tmp_path, monkeypatch):
    """Two of 20,480, which may have 10,000 together; a small one keeps its own."""
    monkeypatch.setattr(drawing, "MAX_DRAWN", 15_000)
    (tmp_path / "in").mkdir()
    for name, fineness in (("a", 5), ("b", 5), ("c", 2)):
        ball = trimesh.creation.icosphere(subdivisions=fineness, radius=0.1)
        (tmp_path / "in" / f"{name}.stl").write_bytes(trimesh.exchange.stl.export_stl(ball))
    body = make.link("end", make.inertial(0.1), *[make.mesh(f"{name}.stl") for name in "abc"])
    model, _ = imported(tmp_path, make.arm(2, body, make.joint("j", "l2", "end")))
    a, b, c = model.mesh_facenum
    assert 1_000 < a == b <= 5_000 and c == 320


@pytest.mark.parametrize(
    "solid, kind, size",
    [
        (trimesh.creation.capsule(height=0.2, radius=0.03), "capsule", (0.03, 0.1)),
        (trimesh.creation.icosphere(subdivisions=4, radius=0.05), "sphere", (0.05,)),
        (trimesh.creation.box((0.1, 0.06, 0.02)), "box", (0.01, 0.03, 0.05)),
    ],
)
def test_fit_finds_the_shape(solid, kind, size):
    turn = trimesh.transformations.euler_matrix(0.4, -0.7, 1.1)
    turn[:3, 3] = 0.3, -0.2, 0.1
    points = primitives.sample(solid.copy().apply_transform(turn))
    shape = primitives.best(points, primitives.hull(points))
    assert shape.kind == kind
    np.testing.assert_allclose(np.sort(shape.size), np.sort(size), rtol=0.06)
    assert shape.covered >= 0.96 and shape.fill == pytest.approx(1, abs=0.12)
    np.testing.assert_allclose(shape.pose[:3, 3], turn[:3, :3] @ solid.bounds.mean(0) + turn[:3, 3], atol=3e-3)


def test_inertia_repairs():
    notes = Notes()

    def fixed(mass, diagonal):
        return inertia.checked(yourdfpy.Inertial(mass=mass, inertia=np.diag(diagonal).astype(float)), "a", notes)

    np.testing.assert_allclose(fixed(1, (1, 2, 2.5)).inertia, np.diag([1, 2, 2.5]), **EXACT)
    assert not notes
    assert not fixed(1, (np.nan, 1, 1)).inertia.any()
    assert fixed(-1, (1, 1, 1)).mass == 0.0 and fixed(np.inf, (1, 1, 1)).mass == 0.0
    assert len(notes) == 4
    # a brick of 1 kg, 0.3 x 0.1 x 0.2 m: m/12 (b^2 + c^2)
    corners = np.array([[x, y, z] for x in (0, 0.3) for y in (0, 0.1) for z in (0, 0.2)])
    brick = inertia.filled(Mass(1.0, np.zeros(3), np.zeros((3, 3))), corners, "a", notes)
    np.testing.assert_allclose(np.diag(brick.inertia), [0.05 / 12, 0.13 / 12, 0.10 / 12], **EXACT)


BRICK = np.array([[x, y, z] for x in (-0.05, 0.05) for y in (-0.1, 0.1) for z in (-0.15, 0.15)])  # 1.2 kg: 0.1 (b^2 + c^2)
SOLID = np.diag([0.013, 0.010, 0.005])


@pytest.mark.parametrize(
    ("read", "used", "points", "kinds", "said"),
    [
        (np.diag([-0.02, 0.012, 0.01]), np.diag([0.02, 0.012, 0.01]), BRICK, ["warning"], "(-0.02, 0.012, 0.01)"),
        (np.diag([0.02, -0.03, -0.04]), np.diag([0.02, 0.03, 0.04]), None, ["warning"], "(0.02, -0.03, -0.04)"),
        (-SOLID - 0.001, SOLID + 0.001, BRICK, ["warning"], "(-0.014, -0.011, -0.006)"),
        (np.diag([0.01, 0.01, 0.05]), SOLID, BRICK, ["warning"], "(0.01, 0.01, 0.05)"),
        (np.diag([-0.01, 0.01, 0.05]), SOLID, BRICK, ["warning"], "(-0.01, 0.01, 0.05)"),
        # second moments (1 + 1 - 5, ..., 5) / 200 = (0.025, 0.025, -0.015): the last becomes 0.00025
        (np.diag([0.01, 0.01, 0.05]), np.diag([0.02525, 0.02525, 0.05]), None, ["warning"], "(0.01, 0.01, 0.05)"),
        # 1% short: (0.0101, 0.0101, -0.0001), the last becomes 0.000101
        (np.diag([0.01, 0.01, 0.0202]), np.diag([0.010201, 0.010201, 0.0202]), None, ["repaired"], "(0.01, 0.01, 0.0202)"),
        (np.diag([0.01, 0.01, 0.02 + 1e-9]), np.diag([0.01, 0.01, 0.02 + 1e-9]), None, [], ""),
    ],
    ids=["sign", "signs", "all signs", "A + B < C", "more than a sign", "no shape", "rounded", "floats"],
)
def test_an_inertia_that_no_body_has_is_a_warning_with_both(read, used, points, kinds, said):
    notes = Notes()
    out = inertia.filled(inertia.checked(yourdfpy.Inertial(mass=1.2, inertia=read), "a", notes), points, "a", notes)
    np.testing.assert_allclose(out.inertia, used, **EXACT)
    assert out.mass == 1.2 and [n.kind for n in notes] == kinds
    numbers = "(" + ", ".join(f"{v:.3g}" for v in np.sort(np.linalg.eigvalsh(used))) + ")"
    signs = "(" + ", ".join(f"{v:.3g}" for v in np.diag(used)) + ")"
    assert all(said in n.text and (numbers in n.text or signs in n.text) for n in notes)


@pytest.mark.parametrize("moments", ["-0.02 0 0 0.03 0 0.04", "0.01 0 0 0.01 0 0.05"])
def test_strict_refuses_an_inertia_that_no_body_has(tmp_path, moments):
    end = make.link("end", make.inertial(1.2, moments=moments), make.shape('<box size="0.1 0.2 0.3"/>'))
    text = make.arm(2, end, make.joint("j", "l2", "end", xyz="0 0 0.2"))
    with pytest.raises(UserError, match=r"--strict: link end: .*correct its <inertia>"):
        imported(tmp_path, text, strict=True)


def test_a_moving_part_without_mass_weighs_what_its_shape_does(tmp_path):
    """As heavy as water: 0.1 m each way is a kilogram. A frame has no shape, and what is fixed hides in what weighs."""
    cube = make.shape('<box size="0.1 0.1 0.1"/>', xyz="0 0 0.05")
    text = make.arm(
        2,
        make.link("block", cube),
        make.link("dust", make.inertial(1e-6), cube),
        make.link("frame"),
        make.link("cover", cube),
        make.joint("j3", "l2", "block", xyz="0 0 0.2"),
        make.joint("j4", "block", "dust"),
        make.joint("j5", "dust", "frame"),
        make.joint("weld", "l1", "cover", "fixed"),
    )
    model, report = imported(tmp_path, text)
    masses = {n: float(model.body(n).mass[0]) for n in ("l1", "block", "dust", "frame")}
    assert masses == pytest.approx({"l1": 1.0, "block": 1.0, "dust": 1.0, "frame": 0.001}, rel=0.03)
    np.testing.assert_allclose(model.body("block").ipos, [0, 0, 0.05], atol=2e-3)
    np.testing.assert_allclose(model.body("block").inertia, 0.01 / 6, rtol=0.06)
    for name in ("block", "dust"):
        assert any("its shape filled with water; weigh it" in note for note in report.notes.of("link", name))
    assert not any("water" in note for name in ("frame", "cover", "l1") for note in report.notes.of("link", name))


@pytest.mark.parametrize(
    ("type", "axis", "effort", "grip"),
    [("prismatic", "0 1 0", 0.18, "0.18 N"), ("revolute", "-1 0 0", 0.006, "0.1")],
    ids=["slides", "jaws"],
)
def test_fingers_too_weak_to_hold_are_a_warning(tmp_path, type, axis, effort, grip):
    """20 N a kilogram at the pads. The least effort that the warning names is enough, from the file or from ``--gains``."""

    def weak(name, effort, **options):
        upper = 0.04 if type == "prismatic" else 0.6
        limit = f'lower="0" upper="{upper}" effort="{effort}" velocity="1"'
        row = {"type": type, "xyz": "0 0 0.2", "limit": limit}
        other = " ".join(str(-float(v)) for v in axis.split())
        joints = (make.joint("f1", "l3", "left", axis=axis, **row), make.joint("f2", "l3", "right", axis=other, **row))
        report = imported(tmp_path / name, hand(tmp_path / name, *joints), **options)[1]
        return report, [note for note in report.warnings if "too little for a cube" in note]

    report, warnings = weak("weak", effort)
    assert len(warnings) == 2 and f"effort {effort:g} grips with {grip}" in warnings[0] and "--gains" in warnings[0]
    least = float(warnings[0].split("at least ")[1].split(",")[0])
    if type == "prismatic":
        assert least == pytest.approx(20 * grasp.cube_for(report.robot).mass, rel=0.02)
    assert not weak("enough", least)[1]
    rows = "".join(f"f{i}: {{stiffness: 100, damping: 1, effort: {least}}}\n" for i in (1, 2))
    (tmp_path / "gains.yaml").write_text(rows)
    assert not weak("given", effort, gains=tmp_path / "gains.yaml")[1]


def test_fingers_overcome_their_joints_own_friction(tmp_path):
    """Dry friction of both fingers comes on top of what they grip with; damping says how fast they can be."""

    def grips(name, losses, effort=20.0, upper=0.04):
        row = {"type": "prismatic", "xyz": "0 0 0.2", "limit": f'lower="0" upper="{upper}" effort="{effort}" velocity="1"'}
        inner = f"<dynamics {losses}/>"
        joints = (
            make.joint("f1", "l3", "left", axis="0 1 0", inner=inner, **row),
            make.joint("f2", "l3", "right", axis="0 -1 0", inner=inner + '<mimic joint="f1"/>', **row),
        )
        report = imported(tmp_path / name, hand(tmp_path / name, *joints))[1]
        return report, report.robot.gripper

    def weak(report):
        return [text for text in report.warnings if "too little for a cube" in text]

    _, free = grips("free", 'friction="0" damping="0"')
    report, rough = grips("rough", 'friction="4" damping="0"')
    assert rough.effort[0] == pytest.approx(free.effort[0] + 8, rel=1e-4) and not weak(report)
    report, _ = grips("stuck", 'friction="12" damping="0"')
    assert len(weak(report)) == 1 and "grips with 0 N" in weak(report)[0]
    report, unsaid = grips("unsaid", 'friction="1" damping="0"', effort=1.0)  # cannot even move them: a placeholder
    assert unsaid.effort[0] == pytest.approx(free.effort[0] + 2, rel=1e-4) and not weak(report)
    assert any("effort 1 is a placeholder" in note for note in report.notes.of("joint", "f1"))
    report, small = grips("small", 'friction="1" damping="0"', upper=0.012)  # 2 N of friction are most of a small hand's effort
    edge = grasp.edge(report.robot.opening, report.robot.pad, report.robot.closed)
    assert small.stiffness[0] * edge / 2 == pytest.approx(small.effort[0], rel=1e-3) and edge < 0.02
    report, slow = grips("slow", 'friction="0" damping="100"')
    assert slow.speed[0] == pytest.approx(free.effort[0] / 200, rel=1e-4) and slow.speed[0] < free.speed[0]
    assert any("its own damping" in note for note in report.notes.of("joint", "f1"))


def test_default_gains(tmp_path):
    """One turning rod: 2 kg, its centre 0.5 m from the axis. kp = 20^2 (I + 5%), damping critical at steps of 1/60 s."""
    text = make.robot(
        make.link("base"),
        make.link("rod", make.inertial(2, "0.5 0 0", "0.01 0 0 0.1 0 0.1")),
        make.joint("j", "base", "rod", limit='lower="-1" upper="1" effort="1000" velocity="1"'),
    )
    _, report = imported(tmp_path, text)
    carried = (2 * 0.25 + 0.1) * 1.05
    assert report.joints["j"]["armature"] == pytest.approx(0.05 * 0.6)
    assert report.robot.arm.stiffness[0] == pytest.approx(400 * carried, rel=1e-4)
    assert report.robot.arm.damping[0] == pytest.approx(2 * 20 * carried + 400 * carried / 60, rel=1e-4)
    assert drives.FREQUENCY == 20.0


def test_home_clears_the_table(tmp_path):
    """At 0 the arm would lie under the table: it is moved."""
    text = make.robot(
        make.link("base"),
        make.link("a", make.inertial(), make.shape('<box size="0.04 0.04 0.4"/>', xyz="0 0 -0.2")),
        make.joint("j", "base", "a", axis="0 1 0", limit='lower="-3" upper="3" effort="100" velocity="1"'),
    )
    model, report = imported(tmp_path, text)
    assert abs(report.robot.arm.home[0]) > np.pi / 2 - 0.3
    assert not any("below the table" in w for w in report.warnings)


def test_out_is_whole_or_absent(tmp_path, monkeypatch):
    path = make.write(tmp_path / "in", make.arm())
    out = tmp_path / "sub" / "out"

    def interrupted(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(model_folder.robot_file, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            import_urdf(path, out)
    assert [p.name for p in tmp_path.iterdir()] == ["in"]
    import_urdf(path, out)
    before = (out / "model.xml").read_text()
    with pytest.raises(UserError, match="--force"):
        import_urdf(path, out)
    with monkeypatch.context() as patch:
        patch.setattr(model_folder.robot_file, "write", interrupted)
        with pytest.raises(KeyboardInterrupt):
            import_urdf(path, out, force=True)
    assert (out / "model.xml").read_text() == before
    make.write(path.parent, make.arm(4))
    import_urdf(path, out, force=True)
    assert (out / "model.xml").read_text() != before
    assert [p.name for p in out.parent.iterdir()] == ["out"]
    assert sorted(p.name for p in out.iterdir()) == ["model.xml", "report.json", "robot.yaml"]


def test_out_of_others_is_left_alone(tmp_path):
    path = make.write(tmp_path / "in", make.arm())
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    for force in (False, True):
        with pytest.raises(UserError, match="other files"):
            import_urdf(path, tmp_path / "out", force=force)
    with pytest.raises(UserError, match="not a folder"):
        import_urdf(path, path, force=True)
    (tmp_path / "empty").mkdir()
    import_urdf(path, tmp_path / "empty")


def test_command(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("COLUMNS", "160")
    path = make.write(tmp_path / "in", make.arm(3, make.link("e", make.mesh("no.stl")), make.joint("w", "l3", "e", "fixed")))
    main(
        [
            str(path),
            "--out",
            str(tmp_path / "out"),
            "--home",
            "j1=0.5,j2=-0.25",
            "--gripper",
            "none",
            "--ee",
            "l3:0,0,0.2",
            "--no-self-test",
        ]
    )
    text = capsys.readouterr().out
    for part in (
        "5 in 4 bodies",
        "3 moving",
        "warning robot arm: mesh",
        "no such file",
        "inspect",
        f"--robot {tmp_path / 'out'}",
    ):
        assert part in text.replace("\n", "")
    assert robot_file.read(tmp_path / "out").arm.home == (0.5, -0.25, 0.0)
    for argv, message in (
        ([], "required"),
        ([str(path), "--out", "x", "--packages", "y"], "unknown argument"),
        ([str(path), "--out", "x", "--package", "y"], "y=y: no such folder"),
        ([str(path), "--out", "x", "--home", "j1=a"], "--home j1 takes a finite number"),
        ([str(path), "--out", "x", "--home", "j9=1"], "j9"),
        ([str(path), "--out", "x", "--home", "j1=7"], "beyond its limits"),
        ([str(path), "--out", "x", "--ee", "l4"], "l4"),
        ([str(path), "--out", "x", "--gripper", "j9"], "j9"),
        ([str(path), "--out", "x", "--gripper", "j1,j2,j3"], "at least one"),
        ([str(path), "--out", "x", "--strict"], "no such file"),
    ):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(UserError, match=message) as error:
            main(argv)
        assert "\n" not in str(error.value) and not (tmp_path / "x").exists()
