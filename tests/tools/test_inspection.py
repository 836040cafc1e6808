"""What inspect and list-envs say: against figures of the robots' READMEs, hand counts, and MuJoCo's own contacts."""

import dataclasses
import json
import shutil

import imageio.v3 as imageio
import mujoco
import pytest
from rich.console import Console

import mjx_nero
from mjx_nero.sim import contacts, robot_file
from mjx_nero.sim.cameras import opengl
from mjx_nero.sim.robot import ASSETS, GripperCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.tasks import registry
from mjx_nero.tools import list_envs, motion
from mjx_nero.tools.inspection import cameras, report
from mjx_nero.tools.inspection.tables import tables
from mjx_nero.types import UserError

NERO, COBOTTA = (registry.robot(name) for name in ("nero", "cobotta_pro_900"))


@pytest.fixture(scope="module")
def nero():
    return report.inspect("nero")


@pytest.fixture(scope="module")
def cobotta():
    return report.inspect("cobotta_pro_900")


@pytest.fixture(scope="module")
def environments():
    return list_envs.environments()


def test_list_envs_at_eighty_columns(environments):
    rows, screen = environments, Console(width=80)
    with screen.capture() as said:
        screen.print(list_envs.environment_table(rows))
    lines = said.get().splitlines()
    assert max(map(len, lines)) <= 80 and not any("continued" in line for line in lines)
    words = said.get().split()
    for row in rows:
        assert row.name in words and (row.robot or "any") in words
    assert "\n".join(lines).count("*") - 1 == len(list((ASSETS / "policies").glob("*.safetensors"))) > 40
    assert sum(row.name.endswith("follow_target") for row in rows) == 3
    assert words.count("any") == sum(not row.robot for row in rows)


def test_joints_of_nero(nero):
    joints = {j.name: j for j in nero.joints}
    assert tuple(joints) == NERO.joints
    j = joints["joint4"]
    assert (j.kind, j.range, j.group) == ("hinge", pytest.approx((-1.01, 2.14)), "arm")
    assert (j.home, j.stiffness, j.damping, j.effort, j.speed) == (2.0, 80.0, 24.0, 25.0, 1.5)
    finger = joints["gripper_joint2"]
    assert (finger.kind, finger.range, finger.group, finger.effort) == ("slide", pytest.approx((-0.05, 0.0)), "gripper", 22.0)
    assert nero.task is None and not nero.gravity_compensation


def test_gripper_actuators_and_sites(nero, cobotta):
    assert nero.gaps == pytest.approx((0.1, 0.001)) and cobotta.gaps == pytest.approx((0.0937, 0.0), abs=3e-4)
    assert [(a.name, a.joint) for a in nero.actuators] == [(j, j) for j in NERO.joints]
    assert nero.actuators[3].target == pytest.approx((-1.01, 2.14)) and nero.actuators[3].force == (-25.0, 25.0)
    assert nero.sites["ee"] == pytest.approx((0.393, 0, 0.268), abs=1e-3)  # assets/nero/README.md
    assert cobotta.sites["ee"] == pytest.approx((0.5, 0, 0.28), abs=1e-3)


def test_linkage_and_masses_of_cobotta(cobotta):
    followers = {j.name: j.follows for j in cobotta.joints if j.follows}
    assert len(followers) == 5 and set(followers.values()) == {"finger_joint"}
    passive = [j for j in cobotta.joints if j.home is None]
    assert len(passive) == 4 and all(j.group == "" and j.stiffness is None for j in passive)
    assert sum(cobotta.masses.values()) == pytest.approx(26 + 1.25) and cobotta.masses["J2"] == 6.5
    assert "cube" not in cobotta.masses and cobotta.gravity_compensation


def test_contact_budget_of_the_readmes(nero, cobotta):
    assert (nero.contacts, cobotta.contacts) == (29, 30)
    pads = [p for p in nero.pairs if "pad" in p.first + p.second]
    assert [(p.shapes, p.contacts, p.condim, p.rows) for p in pads] == [("box, box", 8, 4, 32)] * 2
    # condim 3 but for the pads' 4; nine limits; the linkage's five equalities, and its 12 limits
    assert nero.rows == {"contacts": 13 * 3 + 16 * 4, "joint limits": 9, "joint friction": 0, "equalities": 0}
    assert cobotta.rows == {"contacts": 14 * 3 + 16 * 4, "joint limits": 12, "joint friction": 0, "equalities": 5}
    assert (nero.contacts_per_env, nero.constraints_per_env) == (SimCfg.contacts_per_env, SimCfg.constraints_per_env)


def test_pyramids_take_twice_the_directions():
    found = report.inspect_robot(NERO, SceneCfg(), SimCfg(elliptic=False))
    assert found.rows["contacts"] == 13 * 4 + 16 * 6


def test_without_cube_there_are_fewer_contacts():
    found = report.inspect_robot(NERO, SceneCfg(objects={}), SimCfg())
    assert found.contacts == 7 and {p.first for p in found.pairs} == {"table"}


BODIES = """
<mujoco><worldbody><geom name="floor" type="plane" size="1 1 1"/><geom name="post" size="0.1"/>
  <body name="a"><joint name="ja" frictionloss="1"/><geom name="a1" size="0.1"/><geom name="a2" type="box" size="0.1 0.1 0.1"/>
    <body name="still"><geom name="fixed" size="0.1"/>
      <body name="b"><joint name="jb" range="-1 1" axis="1 0 0"/><geom name="b1" size="0.1" condim="1"/>
        <body name="c"><joint axis="0 1 0"/><geom name="c1" type="capsule" size="0.1 0.1" condim="6" priority="1"/></body></body>
    </body></body>
  <body name="d"><freejoint/><geom name="d1" size="0.1" contype="0"/>
    <geom name="d2" size="0.1" contype="0" conaffinity="0"/></body>
  </worldbody>
  <contact><exclude body1="d" body2="c"/><pair geom1="d2" geom2="a1" condim="4"/></contact>
  <equality><weld body1="d" body2="world"/><connect body1="a" body2="d" anchor="0 0 0"/></equality></mujoco>"""


def all_meet(model):
    """MuJoCo's data of a model whose margins are as wide as the world: every pair that may meet does."""
    model.geom_margin[:], model.pair_margin[:], model.body_margin[:] = 10.0, 10.0, 10.0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_MIDPHASE  # its boxes do not know the new margins
    data = mujoco.MjData(model)
    data.qpos[model.joint("jb").qposadr[0]] = 2.0  # beyond its limit
    mujoco.mj_forward(model, data)
    return data


def test_pairs_are_those_that_mujoco_lets_meet():
    model = mujoco.MjModel.from_xml_string(BODIES)
    pairs = {frozenset((p.first, p.second)): p for p in contacts.contact_pairs(model)}
    meeting = {frozenset(model.geom(g).name for g in contact.geom): contact.dim for contact in all_meet(model).contact}
    assert {names: p.condim for names, p in pairs.items()} == meeting and len(pairs) > 5
    assert pairs[frozenset(("c1", "a1"))].rows == 2 * (6 - 1) and pairs[frozenset(("floor", "c1"))].contacts == 2


@pytest.mark.parametrize("cone", ["PYRAMIDAL", "ELLIPTIC"])
def test_rows_are_those_that_mujoco_makes(cone):
    model = mujoco.MjModel.from_xml_string(BODIES)
    model.opt.cone = getattr(mujoco.mjtCone, f"mjCONE_{cone}")
    pairs, rows = contacts.contact_pairs(model), contacts.constraint_rows(model)
    data = all_meet(model)
    assert (rows["equalities"], rows["joint friction"], rows["joint limits"]) == (data.ne, data.nf, data.nl) == (9, 1, 1)
    each = {frozenset((p.first, p.second)): p.rows / p.contacts for p in pairs}
    made = sum(each[frozenset(model.geom(g).name for g in contact.geom)] for contact in data.contact)
    assert made == data.nefc - data.ne - data.nf - data.nl


# --- movements


def test_cobotta_gets_to_its_limits():
    moved = motion.moves(COBOTTA, SimCfg())
    assert [m.joint for m in moved] == [j for j in COBOTTA.arm.joints for _ in range(2)] + list(COBOTTA.gripper.joints) * 2
    assert moved[0].target == pytest.approx(-4.712, abs=1e-3) and moved[1].target == pytest.approx(4.712, abs=1e-3)
    for m in moved:
        speed = 2.0 if m.joint in COBOTTA.arm.joints else 0.9
        way = abs(m.target - m.start)
        assert m.time is not None and abs(m.end - m.target) < 2e-3 and m.saturation == 0
        assert way / speed - 0.1 < m.time < way / speed + 0.5 and 0.9 * speed < m.fastest < 1.1 * speed


def test_a_weak_drive_does_not_get_there():
    weak = dataclasses.replace(NERO, arm=dataclasses.replace(NERO.arm, effort=(25.0, 2.0, *(25.0,) * 5)), gripper=GripperCfg())
    moved = motion.moves(weak, SimCfg())
    up, down = (m for m in moved if m.joint == "joint2")
    assert len(moved) == 14
    assert (up.time, up.saturation) == (None, 1.0) and (up.start, up.end) == pytest.approx((1.74, 1.74), abs=0.01)  # it hangs
    assert down.time is not None
    assert all(m.time is not None for m in moved if m.joint == "joint1")


# --- environments


def test_task_of_an_environment():
    task = report.inspect("nero_lift").task
    env = mjx_nero.make("nero_lift", impl="native")
    assert (task.env, task.preset, task.episode_s, task.control_dt) == ("nero_lift", "default", 5.0, pytest.approx(0.02))
    assert task.action_size == 8 and "gripper" in task.action
    assert {group: (sum(terms.values()),) for group, terms in task.observations.items()} == env.observation_size
    assert list(task.observations["state"])[:2] == ["joint_pos", "joint_vel"]  # the config's order
    assert task.observations["state"]["joint_pos"] == 9 and task.observations["state"]["ee_to_object"] == 3
    assert task.rewards["goal_tracking_fine"] == 15.0 and task.rewards["action_rate"] == -5e-3
    assert task.terminations["time_out"].endswith("a time-out") and "minimum_height=-0.05" in task.terminations["object_dropping"]
    assert "x=(0.3, 0.4)" in task.events["reset_object_position"] and task.command.startswith("uniform_position(x=(0.3, 0.35)")


def test_presets_and_controllers_actions():
    assert "lifting_object" in report.inspect("nero_lift", preset="isaac").task.rewards
    task = report.inspect("cobotta_pick_place").task
    assert "one entry per drive: its position target [rad or m]" in task.action and task.action_size == 8


def test_environments(environments):
    rows = {row.name: row for row in environments}
    assert tuple(rows) == registry.list_envs()
    lift, goal = rows["nero_lift"], rows["cobotta_follow_target"]
    assert (lift.robot, lift.presets, lift.bundled) == (
        "nero",
        ("default", "isaac", "sim2real", "rgb", "depth", "rgbd", "rgb_fixed", "depth_fixed", "rgbd_fixed", "sim2real_rgb"),
        ("default", "sim2real", "rgb"),
    )
    assert (goal.robot, goal.bundled) == ("cobotta_pro_900", ())
    assert (rows["reach"].robot, rows["reach"].bundled) == (None, ())


def test_a_jaw_that_swings_open_says_how_much_fits(cobotta):
    swings = dataclasses.replace(cobotta, gaps=(0.1156, 0.0), room=0.067)
    for hand, said in ((swings, "only 67 mm fit"), (cobotta, None)):
        captions = [table.caption for table in tables(hand) if table.title == "gripper"]
        assert len(captions) == 1 and (said in captions[0] if said else not captions[0])


# --- the programs


@pytest.fixture
def call(call, monkeypatch):
    """``call("nero", ..., program="inspect") -> (exit status, stdout, stderr)``, not a terminal."""
    monkeypatch.delenv("COLUMNS")
    return lambda *argv, program="inspect": call("mjx_nero", program, *argv)


def test_program_shows_moves_and_writes(call, tmp_path):
    code, out, err = call("cobotta_lift", "--move", "--json", "all.json")
    assert (code, err) == (0, "") and "…" not in out  # nothing cut for want of width
    for text in ("right_outer_knuckle_joint", "93.7", "geoms that can touch", "goal_tracking_fine", "movements", "27.25"):
        assert text in out
    told = json.loads((tmp_path / "all.json").read_text())
    assert told["robot"] == "cobotta_pro_900" and len(told["moves"]) == 16 and len(told["pairs"]) == 9
    assert told["task"]["rewards"]["at_goal"] == 10.0
    assert [p.name for p in tmp_path.iterdir()] == ["all.json"]


@pytest.mark.parametrize("name", ["nero", "nero_lift"])
def test_program_draws(call, tmp_path, name):
    code, _, err = call(name, "--render", "picture.png")
    if "no offscreen OpenGL" in err:
        assert code == 2 and not list(tmp_path.iterdir())
        return
    picture = imageio.imread(tmp_path / "picture.png").astype(float)
    assert code == 0 and picture.shape == (720, 960, 3) and picture.std() > 10
    red = (picture[..., 0] > 1.8 * picture[..., 1]) & (picture[..., 0] > 100)
    assert (red.sum() > 200) == (name == "nero_lift")  # the cube


def test_program_takes_the_folder_of_an_imported_robot(call, tmp_path):
    folder = tmp_path / "arm"
    folder.mkdir()
    shutil.copy(NERO.xml, folder / "model.xml")
    robot_file.write(folder, dataclasses.replace(NERO, name="my_arm", gripper=GripperCfg()))
    code, out, err = call(str(folder), "--no-self-test")
    assert (code, err) == (0, "") and "joints of my_arm" in out and "gap" not in out
    code, out, _ = call("nero_lift", "--robot", "cobotta_pro_900")
    assert code == 0 and "joints of cobotta_pro_900" in out


def test_list_envs(call, monkeypatch):
    code, out, err = call(program="list-envs")
    assert (code, err) == (0, "") and "sim2real_rgb" in out
    monkeypatch.setenv("COLUMNS", "80")  # names stay whole however narrow the terminal
    for text in (out, call(program="list-envs")[1]):
        assert {row.split()[0] for row in text.splitlines() if row.strip()} >= set(registry.list_envs())


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        ([], "name a robot, an environment or the folder of an imported robot"),
        (["nerro"], "no robot or environment 'nerro' (did you mean 'nero'?)"),
        (["nero", "--preset", "isaac"], "nero is a robot: leave out --preset and --robot, which are for environments"),
        (["nero_lift", "--preset", "x"], "unknown preset of nero_lift 'x'"),
        (["reach"], "reach is for any robot: pass one"),
        (["."], ". holds no robot.yaml"),
        (["nero", "--render", "nero.xyz"], "--render takes a name that ends in .png, got 'nero.xyz'"),
        (["nero", "--render", "nowhere/nero.png"], "cannot write nowhere/nero.png: the folder nowhere does not exist"),
        (["nero", "--json", "."], "--json takes a name that ends in .json, got '.'"),
        (["nero", "--jsn", "x"], "unknown argument '--jsn'"),
        (["nero_lift", "--object", "mug"], "--object shows an object alone: leave out nero_lift"),
    ],
)
def test_mistakes_end_in_one_line_and_leave_nothing(call, tmp_path, argv, message):
    code, _, err = call(*argv)
    assert code == 2 and err.startswith(f"error: {message}") and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_unknown_names_list_the_nearest_ones():
    with pytest.raises(UserError, match="did you mean 'nero_lift'.*choose one of .*nero_lift, .*, or the folder of a robot"):
        report.find("nero_lif")


def test_a_sheet_of_pictures_draws_each_once(monkeypatch):
    """Sixty-four states by two cameras; the steps between them draw nothing."""
    drawn = []
    monkeypatch.setattr(opengl.OpenGL, "_draw_rows", lambda self, rows, images: drawn.append(len(rows)))
    seen = cameras.see(registry.env_cfg("nero_lift", "rgb"))
    assert sum(drawn) == 64
    assert {name: each.rgb.shape for name, each in seen.pictures.items()} == dict.fromkeys(("front", "wrist"), (64, 64, 64, 3))
