"""Tasks for any robot: where the cube lies, where it has to go and how large it is; and robots that cannot."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
import urdf_files as files
from scipy import optimize
from scipy.spatial.transform import Rotation

from mjx_nero import UserError, control, env_cfg, make
from mjx_nero.control.gripper import ParallelGripper
from mjx_nero.envs import regions
from mjx_nero.runs import evaluation
from mjx_nero.sim import contacts, grasp, robot_file, scene
from mjx_nero.sim.robot import GripperCfg
from mjx_nero.tasks import building, fitted, registry
from mjx_nero.tasks.arms.cobotta_pro_900 import COBOTTA_PRO_900
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.tasks.arms.so_arm100 import SO_ARM100
from mjx_nero.urdf import import_urdf

OWN = {"nero": "nero", "piper": "piper", "cobotta_pro_900": "cobotta", "so_arm100": "so100", "so_arm101": "so101"}


@pytest.fixture(scope="module")
def hand(tmp_path_factory):
    """Six joints with two fingers that open by 10 cm, imported: the folder."""
    folder = tmp_path_factory.mktemp("hand")
    import_urdf(
        files.write(folder / "in", files.robot(files.base(), *files.six(), *files.fingers(folder, "link6"), name="hand")),
        folder / "out",
    )
    return folder / "out"


@pytest.mark.parametrize(
    ("opening", "pad", "edge", "height"),
    [
        (0.1, (0.01, 0.02, 0.006), 0.04, 0.02),  # two fifths of the opening, held in its middle
        (0.1, (0.04, 0.02, 0.006), 0.05, 0.025),  # the pads' length, and 5 mm clear of the table and of the top
        (0.06, (0.04, 0.02, 0.006), 0.036, 0.025),  # three fifths of the opening at most: the pads stand out above
        (0.3, (0.01, 0.02, 0.006), 0.06, 0.03),  # no larger than this
    ],
)
def test_a_cube_that_fits_by_hand(opening, pad, edge, height):
    assert grasp.edge(opening, pad) == pytest.approx(edge) and grasp.height(opening, pad) == pytest.approx(height)


@pytest.mark.parametrize(("robot", "own"), OWN.items())
def test_the_packages_arms_lift_as_in_their_own_task(robot, own):
    """The cube lies where the hand can point down, which is not all of the recipe's region for Piper and the SO-ARMs."""
    fitted, tuned = env_cfg("lift", robot=robot), env_cfg(f"{own}_lift")
    assert fitted.command == tuned.command
    assert (fitted.events == tuned.events) == (robot in ("nero", "cobotta_pro_900"))
    assert list(fitted.rewards) == list(tuned.rewards) and fitted.observations == tuned.observations
    size = fitted.scene.objects["cube"].size[0]
    assert 0.3 * fitted.robot.opening < size <= 0.6 * fitted.robot.opening


@pytest.mark.parametrize("robot", ["nero", "cobotta_pro_900"])
def test_what_fits_any_robot_is_one_task_by_either_name(robot):
    for task, presets in registry.fitted.FITTING.items():
        for preset in presets:
            assert env_cfg(task, preset, robot=robot) == env_cfg(f"{OWN[robot]}_{task}", preset), (task, preset)


def test_an_imported_arm_has_its_regions_in_the_task(hand):
    robot, cfg = robot_file.read(hand), env_cfg("lift", robot=hand)
    assert cfg.scene.objects["cube"].size == pytest.approx((0.04,) * 3) and cfg.scene.objects["cube"].mass == pytest.approx(0.064)
    start = cfg.events["reset_object_position"].params
    assert (start["x"], start["y"]) == robot.pick[:2]
    assert tuple(cfg.command.params[axis] for axis in "xyz") == robot.hold
    (low, _), (edge, _) = robot.pick[2], cfg.scene.objects["cube"].size[:2]
    assert low == pytest.approx(edge / 2, abs=2e-3)  # the grasp point amid the pads, these amid the cube
    assert robot.hold[2][0] > 0.05 + low and robot.hold[2][1] > 0.2
    x, y = (np.array(ends) for ends in robot.pick[:2])
    assert 0.1 < np.ptp(x) < 0.3 and 0.2 < np.ptp(y) < 0.5 and abs(y.mean()) < 0.1  # of a reach of 0.8 m
    table = np.array(cfg.scene.table_center)[:, None] + np.outer(np.array(cfg.scene.table_size) / 2, (-1, 1))
    assert table[0, 0] < x[0] - 0.1 and table[0, 1] > x[1] + 0.1 and table[1, 0] < y[0] - 0.1 and table[1, 1] > y[1] + 0.1


@pytest.mark.parametrize("name", ["hand", *OWN])
def test_pick_is_reached_pointing_down_and_hold_somehow(name, hand):
    """At every corner, by scipy's own inverse kinematics on the compiled model, joints within limits."""
    robot = robot_file.read(hand) if name == "hand" else env_cfg("reach", robot=name).robot
    model = scene.robot_model(robot)
    data, ids = mujoco.MjData(model), [model.joint(j).qposadr[0] for j in robot.arm.joints]
    bounds = np.array([model.joint(j).range for j in robot.arm.joints]).T
    down = Rotation.from_quat(robot.down, scalar_first=True)
    rng = np.random.default_rng(0)

    def miss(q, goal, turns):
        data.qpos[ids] = q
        mujoco.mj_kinematics(model, data)
        now = Rotation.from_matrix(data.site(robot.ee_site).xmat.reshape(3, 3))
        return np.concatenate(
            [data.site(robot.ee_site).xpos - robot.base_pos - goal, turns * 0.1 * (down * now.inv()).as_rotvec()]
        )

    for box, turns in ((robot.pick, 1.0), *([(robot.hold, 0.0)] if name == "hand" else [])):
        for goal in itertools.product(*box):
            starts = [np.array(robot.arm.home), *rng.uniform(*bounds, (15, len(ids)))]
            found = (optimize.least_squares(miss, s, bounds=bounds, args=(np.array(goal), turns)) for s in starts)
            assert any(np.linalg.norm(f.fun) < 5e-3 for f in found), goal


def test_each_region_can_be_overridden(hand):
    fields = {
        "events.reset_object_position.params.x": "0.3,0.3",
        "command.params.z": "0.2,0.2",
        "scene.objects.cube.mass": "0.01",
    }
    cfg = env_cfg("lift", robot=hand, **fields)
    assert cfg.events["reset_object_position"].params["x"] == (0.3, 0.3) and cfg.command.params["z"] == (0.2, 0.2)
    assert cfg.scene.objects["cube"].mass == 0.01


def test_edits_of_the_robots_file_count(hand):
    robot = robot_file.read(hand)
    wide = dataclasses.replace(robot, pick=((0.3, 0.4), (0.0, 0.1), (0.03, 0.1)), opening=0.05)
    cfg = env_cfg("lift", robot=wide)
    assert cfg.events["reset_object_position"].params["x"] == (0.3, 0.4) and cfg.scene.objects["cube"].size[0] == 0.03
    beside = dataclasses.replace(wide, base_pos=(1.0, -1.0, 0.1))
    start = env_cfg("lift", robot=beside).events["reset_object_position"].params  # of the world
    assert (start["x"], start["y"]) == ((1.3, 1.4), (-1.0, -0.9))
    assert env_cfg("lift", robot=beside).command == cfg.command  # of the robot
    assert env_cfg("pick_place", robot=beside).command.params["z"] == pytest.approx((0.015 - 0.1,) * 2)


@pytest.mark.parametrize("gap", [0.02, 0.05, 0.08])
def test_how_far_a_hand_opens_is_found_without_its_formula(gap):
    """The RG6's linkage: its pads in the model are as far apart as its formula says."""
    blind = dataclasses.replace(COBOTTA_PRO_900.gripper, gap=None, positions=None)
    robot = dataclasses.replace(COBOTTA_PRO_900, gripper=blind)
    found = grasp.opened(robot, gap).gripper
    at, known = ParallelGripper(robot).positions(jnp.array(gap)), ParallelGripper(COBOTTA_PRO_900)
    assert float(known.gap(at)) == pytest.approx(gap, abs=3e-4)
    np.testing.assert_allclose(found.open, grasp.opened(COBOTTA_PRO_900, gap).gripper.open, atol=2e-4)
    assert found.home == found.open and found.close == blind.close


def test_fingers_that_open_alike_are_measured(tmp_path):
    """Both slides count outwards, so that their difference says nothing, as it does of Nero's, which count along one axis."""
    fingers = [line.replace('<mimic joint="left"/>', "") for line in files.fingers(tmp_path, "link6")]
    text = files.robot(files.base(), *files.six(), *fingers, name="alike")
    import_urdf(files.write(tmp_path / "in", text), tmp_path / "out")
    robot = robot_file.read(tmp_path / "out")
    assert robot.gripper.joints == ("left", "right") and robot.gripper.open == pytest.approx((0.05, 0.05), abs=1e-3)
    gripper = ParallelGripper(robot)
    for at, apart in ((0.05, 0.1), (0.02, 0.04), (0.01, 0.02)):  # each finger's own way, twice
        assert float(gripper.gap(jnp.full(2, at))) == pytest.approx(apart, abs=3e-3)
        np.testing.assert_allclose(gripper.positions(jnp.array(apart)), [at, at], atol=2e-3)
    assert grasp.opened(robot, 0.04).gripper.open == pytest.approx((0.02, 0.02), abs=2e-3)


def test_slow_fingers_begin_near_the_cube(hand):
    """A cube of 4 cm in a hand that opens by 10 cm: a finger goes 3 cm to it. Slow ones begin 8 cm apart."""
    robot = robot_file.read(hand)
    slow = dataclasses.replace(robot, gripper=dataclasses.replace(robot.gripper, speed=(0.05,)))
    assert grasp.closing_time(robot, 0.04) == pytest.approx(0.03 / robot.gripper.speed[0], abs=2e-3)
    assert grasp.closing_time(slow, 0.04) == pytest.approx(0.6, abs=0.02)
    assert env_cfg("lift", robot=robot).robot.gripper.open == robot.gripper.open
    near = env_cfg("lift", robot=slow).robot.gripper
    assert near.open == pytest.approx((0.04,), abs=5e-4) and near.home == near.open  # the other finger follows
    assert grasp.opened(slow, 0.2).gripper == slow.gripper  # it does not open as far


def test_towers_begin_with_slow_fingers_near_the_cube(hand):
    """Wide open, a slow jaw would still be closing as the hand lifts."""
    robot = robot_file.read(hand)
    slow = dataclasses.replace(robot, gripper=dataclasses.replace(robot.gripper, speed=(0.05,)))
    for env in ("place", "stack"):
        assert env_cfg(env, robot=robot).robot.gripper.open == robot.gripper.open
        assert env_cfg(env, robot=slow).robot.gripper.open == env_cfg("lift", robot=slow).robot.gripper.open


def test_experts_wait_for_slow_fingers(hand):
    """8 cm open, a cube of 4 cm, 2 cm/s: a second to close. The usual half second is 25 control steps of 20 ms."""
    robot = robot_file.read(hand)
    slow = dataclasses.replace(robot, gripper=dataclasses.replace(robot.gripper, speed=(0.02,)))
    for env in ("place", "stack"):
        usual, patient = (env_cfg(env, robot=each) for each in (robot, slow))
        assert usual.controllers["pick_place"]["events_dt"] == building.QUICK and usual.episode_length_s == 7.0
        late = 1.0 + building.PRESS - building.CLOSING
        assert patient.episode_length_s == pytest.approx(7.0 + 2 * late, abs=0.05)
        fields = patient.controllers["pick_place"]
        steps = control.make("pick_place", slow, 0.02, fields).steps
        assert steps[3] == pytest.approx(25 + late / 0.02, abs=1.1) and steps[7] == pytest.approx(20 + late / 0.02, abs=1.1)
    usual, patient = (env_cfg("pick_place", robot=each) for each in (robot, slow))
    late = patient.controllers["pick_place"]["wait"]
    assert usual.controllers["pick_place"]["wait"] == 0.0 and late == pytest.approx(1.0 - fitted.SLOW, abs=0.1)
    assert patient.episode_length_s == pytest.approx(usual.episode_length_s + 2 * late)
    lifts = [env_cfg("lift", robot=each) for each in (robot, slow)]
    assert [cfg.episode_length_s for cfg in lifts] == [5.0, pytest.approx(5.0 + late)]
    assert all(cfg.command.resample_s == cfg.episode_length_s for cfg in lifts)  # no other goal shortly before the end
    nero = dataclasses.replace(NERO, gripper=dataclasses.replace(NERO.gripper, speed=(0.02, 0.02)))
    closing = [env_cfg("clutter", robot=each).controllers["pick_up"]["closing"] for each in (NERO, nero)]
    assert closing == [0.3, pytest.approx((0.06 - 0.0143) / 2 / 0.02, abs=0.06)]  # from 6 cm to the thinnest there is


def test_fingers_with_drives_of_their_own_hold_by_their_springs():
    """Two drives that push at their limits would let the cube drift to either side: they push no further than that."""
    cfg = env_cfg("pick_place", robot=NERO)
    edge, fingers = cfg.scene.objects["cube"].size[0], cfg.robot.gripper
    for at, shut, effort, stiffness in zip(fingers.close, (0.5, -0.5), fingers.effort, fingers.stiffness, strict=True):
        force = stiffness * abs(edge * shut - at)
        assert np.sign(at) in (0, np.sign(shut)) and 0.6 * effort < force < 1.01 * effort


def test_a_hand_leaves_what_is_held_above_its_grasp_point(hand):
    """The grasp point 18 mm below the middle of the pads: the hand goes up by as much more to be as far away."""
    robot = robot_file.read(hand)
    low = dataclasses.replace(robot, pick=(*robot.pick[:2], (robot.pick[2][0] - 0.018, robot.pick[2][0] + 0.042)))
    rest = env_cfg("lift", robot=robot).scene.objects["cube"].rest_height
    assert regions.of(low).offset[2] == pytest.approx(regions.of(robot).offset[2] - 0.018)
    assert regions.of(low).travel >= rest + regions.LEFT
    stack = env_cfg("stack", robot=low)
    leave, clearance = (
        stack.controllers["pick_place"]["end_effector_initial_height"],
        stack.success.condition.params["place"].clearance,
    )
    edge = 2 * rest
    assert leave - (rest + edge) > clearance + 0.005  # over the upper cube's middle


def test_hands_close_on_what_is_narrow_or_say_so():
    """The SO-ARM's jaw closes to 17.5 mm where the recipe ends, and to 2 mm where its joint does; Nero's pads meet."""
    assert grasp.shut(NERO, 0.01) is NERO and grasp.shut(SO_ARM100, 0.02) is SO_ARM100
    jaw = grasp.shut(SO_ARM100, 0.01)
    assert jaw.gripper.close == (-0.2,) and jaw.gripper.open == SO_ARM100.gripper.open
    assert env_cfg("clutter", robot="so_arm100").robot.gripper.close == (-0.2,)
    with pytest.raises(
        UserError, match=r"^the hand of so_arm100 closes to 0\.00198 m between its pads: too wide to hold an object 0\.001 m"
    ):
        grasp.shut(SO_ARM100, 0.001)


def test_buffers_of_an_imported_arm_hold_the_worst_case(hand):
    for name in ("lift", "nero_lift"):
        cfg = env_cfg(name, robot=hand)
        model = scene.build(cfg.robot, cfg.scene, cfg.sim, visuals=False)
        assert cfg.sim.contacts_per_env == sum(pair.contacts for pair in contacts.contact_pairs(model)) > 16
        assert cfg.sim.constraints_per_env == sum(contacts.constraint_rows(model).values())
    assert env_cfg("lift", robot="nero").sim == env_cfg("nero_lift").sim


def test_an_imported_arm_steps(hand):
    env = make("lift", robot=hand, impl="native", num_envs=4)
    state = jax.jit(jax.vmap(env.reset))(jax.random.split(jax.random.PRNGKey(0), 4))
    step = jax.jit(jax.vmap(env.step))
    for i in range(20):
        state = step(state, jnp.full((4, env.action_size), (-1.0) ** i))
    assert np.isfinite(np.asarray(state.pipeline_state.qpos)).all() and np.isfinite(np.asarray(state.reward)).all()
    assert not np.asarray(state.metrics["nan"]).any()


@pytest.mark.slow
@pytest.mark.parametrize("robot", ["hand", "cobotta_pro_900"])
def test_scripted_pick_lifts_the_cube(robot, hand):
    """By inverse kinematics alone, wherever the cube starts: what lift asks for can be done."""
    robot = str(hand) if robot == "hand" else robot
    result = evaluation.play(evaluation.EvalCfg("pick_place", robot=robot, controller="pick_place", episodes=8)).result
    assert result["grasp_rate"] >= 7 / 8 and result["nan_count"] == 0


@pytest.mark.slow
def test_an_imported_arm_follows_a_target(hand):
    how = {"robot": str(hand), "preset": "static", "controller": "ik", "episodes": 2}
    result = evaluation.play(evaluation.EvalCfg("follow_target", **how, env_fields={"episode_length_s": 4.0})).result
    assert result["success_rate"] == 1 and result["warning"] == ""


@pytest.mark.parametrize(
    ("env", "changes", "message"),
    [
        ("lift", {"gripper": GripperCfg()}, "nero has no gripper: this task needs one, but reach does not"),
        ("pick_place", {"gripper": GripperCfg()}, "nero has no gripper: this task needs one, but reach does not"),
        (
            "lift",
            {"opening": 0.0},
            r"how far the gripper of nero opens is unknown: give opening, between its pads \[m\], in its config",
        ),
        (
            "lift",
            {"pick": None},
            r"nero has no pick, where on the table it can grasp: give it in its config as ranges of x, y and z",
        ),
        ("lift", {"pick": None, "folder": "x"}, "give it in its robot.yaml as ranges of x, y and z .*, or import it again$"),
        ("lift", {"hold": None}, "nero has no hold, where it can hold what it has grasped: give it in its config"),
        ("follow_target", {"pick": None, "workspace": None}, "nero has no workspace, where it can work: give it in its config"),
    ],
)
def test_robots_that_do_not_do(env, changes, message):
    with pytest.raises(UserError, match=message):
        env_cfg(env, robot=dataclasses.replace(NERO, **changes))
