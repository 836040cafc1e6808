"""Controllers by hand: the gripper's targets, the ten phases of pick and place, following by inverse kinematics."""

import dataclasses

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from mjx_nero import UserError, control, make
from mjx_nero.control import pick_place
from mjx_nero.control.follow_target import IkFollower, RmpFollower
from mjx_nero.control.gripper import ParallelGripper
from mjx_nero.control.ik import IkCfg
from mjx_nero.control.pick_place import PHASES, PickPlace, PickPlaceCfg, PickPlaceMemory
from mjx_nero.math import axis_angle, rotate
from mjx_nero.sim import scene
from mjx_nero.tasks.arms.cobotta_pro_900 import COBOTTA_PRO_900
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.types import View

DT = 0.02
DELTAS = (-0.628, 0.628)  # the tutorial's
LIMIT = 0.628319


# --- gripper


@pytest.fixture(scope="module")
def rg6() -> ParallelGripper:
    return ParallelGripper(COBOTTA_PRO_900)


def test_gripper_is_the_robots_own(rg6):
    assert rg6.joints == ("finger_joint", "right_outer_knuckle_joint")
    np.testing.assert_array_equal(rg6.opened, [0, 0])
    np.testing.assert_array_equal(rg6.closed, np.float32([0.628, -0.628]))
    at = jnp.array([0.3, -0.2])
    np.testing.assert_array_equal(rg6.open(at), [0, 0])  # wherever the fingers are
    np.testing.assert_array_equal(rg6.close(at), np.float32([0.628, -0.628]))


def test_gripper_with_the_tutorials_deltas_leads_the_measured_positions():
    gripper = ParallelGripper(COBOTTA_PRO_900, opened=(0.0, 0.0), closed=(0.628, -0.628), action_deltas=DELTAS)
    at = jnp.array([0.3, -0.2])
    np.testing.assert_allclose(gripper.open(at), [-0.328, 0.428], atol=1e-6)
    np.testing.assert_allclose(gripper.close(jnp.array([-0.3, 0.2])), [0.328, -0.428], atol=1e-6)
    np.testing.assert_allclose(gripper.close(at), [LIMIT, -LIMIT], atol=1e-6)  # 0.928, -0.828
    np.testing.assert_allclose(gripper.open(jnp.array([-0.1, 0.1])), [-LIMIT, LIMIT], atol=1e-6)


def test_gripper_steps_from_where_it_is(rg6):
    at = jnp.array([0.3, -0.2])
    np.testing.assert_allclose(rg6.step(at, (0.1, -0.1)), [0.4, -0.3], atol=1e-6)
    np.testing.assert_allclose(rg6.step(at, np.array([1.0, 0.1])), [LIMIT, -0.1], atol=1e-6)


def test_gripper_given_other_positions():
    gripper = ParallelGripper(COBOTTA_PRO_900, opened=(-0.3, 0.3), closed=(0.9, -0.2))
    np.testing.assert_allclose(gripper.open(jnp.zeros(2)), [-0.3, 0.3], atol=1e-6)
    np.testing.assert_allclose(gripper.close(jnp.zeros(2)), [LIMIT, -0.2], atol=1e-6)  # 0.9 is out of range


def test_gripper_moves_at_its_speed(rg6):
    """0.9 rad/s: 0.018 rad a step, from the targets and not from where the fingers are."""
    at, targets = jnp.array([0.25, -0.25]), jnp.array([0.3, -0.3])
    np.testing.assert_allclose(rg6.forward(jnp.array(True), at, targets, DT), [0.318, -0.318], atol=1e-6)
    np.testing.assert_allclose(rg6.forward(jnp.array(False), at, targets, DT), [0.282, -0.282], atol=1e-6)
    near = jnp.array([0.62, -0.01])
    np.testing.assert_allclose(rg6.forward(jnp.array(True), at, near, DT), [0.628, -0.028], atol=1e-6)
    targets = jnp.zeros(2)
    for _ in range(40):
        targets = rg6.forward(jnp.array(True), at, targets, DT)
    np.testing.assert_allclose(targets, [0.628, -0.628], atol=1e-6)


@pytest.mark.parametrize(("q", "gap"), [(-0.628, 0.1514), (0.0, 0.0937), (0.299, 0.0515), (0.5, 0.0203), (0.627, 0.0)])
def test_gap_of_the_rg6(rg6, q, gap):
    positions = jnp.array([q, -q])
    assert float(rg6.gap(positions)) == pytest.approx(gap, abs=1e-4)
    assert float(rg6.gap(positions)) == pytest.approx(2 * (0.08 * np.sin(0.6331 - q) - 0.000488), abs=1e-7)
    np.testing.assert_allclose(rg6.positions(rg6.gap(positions)), positions, atol=1e-5)


def test_gap_of_the_rg6_counts_each_finger(rg6):
    assert float(rg6.gap(jnp.array([0.299, 0.0]))) == pytest.approx((0.0515 + 0.0937) / 2, abs=1e-4)


def test_positions_stay_in_the_ranges(rg6):
    np.testing.assert_allclose(rg6.positions(jnp.array(0.155)), [-LIMIT, LIMIT], atol=1e-6)


def test_gap_is_the_distance_of_the_models_pads(rg6):
    model = scene.robot_model(COBOTTA_PRO_900)
    data = mujoco.MjData(model)
    for q in (-0.6, 0.0, 0.299, 0.6):
        for name, sign in {"finger": 1, "left_inner_finger": 1, "right_inner_finger": 1, "right_outer_knuckle": -1}.items():
            data.joint(f"{name}_joint").qpos = sign * q
        mujoco.mj_kinematics(model, data)
        apart = np.linalg.norm(data.geom("left_pad").xpos - data.geom("right_pad").xpos)
        assert float(rg6.gap(jnp.array([q, -q]))) == pytest.approx(apart - 2 * 0.004, abs=2e-5)


def test_neros_gripper_slides():
    gripper = ParallelGripper(NERO)
    assert gripper.joints == ("gripper_joint1", "gripper_joint2")
    np.testing.assert_allclose(gripper.open(jnp.zeros(2)), [0.05, -0.05], atol=1e-7)
    np.testing.assert_allclose(gripper.close(jnp.zeros(2)), [0.0, -0.001], atol=1e-7)
    assert float(gripper.gap(jnp.array([0.03, -0.02]))) == pytest.approx(0.05)
    np.testing.assert_allclose(gripper.positions(jnp.array(0.06)), [0.03, -0.03], atol=1e-7)
    # 1.5 m/s is more than the whole stroke a step
    moved = gripper.forward(jnp.array(True), jnp.zeros(2), jnp.array([0.05, -0.05]), DT)
    np.testing.assert_allclose(moved, [0.02, -0.02], atol=1e-6)


@pytest.mark.parametrize("name", ["opened", "closed", "action_deltas"])
def test_gripper_wants_one_value_a_joint(name):
    message = rf"{name} takes one value for each of finger_joint, right_outer_knuckle_joint, got \(1.0, 2.0, 3.0\)"
    with pytest.raises(UserError, match=message):
        ParallelGripper(COBOTTA_PRO_900, **{name: (1.0, 2.0, 3.0)})


# --- pick and place

REST_OF_MEMORY = [field.name for field in dataclasses.fields(PickPlaceMemory) if field.name != "phase"]
TUTORIAL = (0.005, 0.002, 1.0, 0.05, 0.0008, 0.005, 0.0008, 0.1, 0.0008, 0.008)
PICK, PLACE = np.array([0.5, -0.1, 0.02]), np.array([-0.3, 0.6, 0.03])


def placer(**changes) -> PickPlace:
    return PickPlace(COBOTTA_PRO_900, DT, dataclasses.replace(PickPlaceCfg(), **changes))


def hung(view: View, memory, name: str, grip=(0.0, 0.0, 0.0)) -> View:
    """The object hangs ``grip`` off the hand, which is where it has to be, from when it is lifted until it is put down."""
    if not 4 <= memory.phase <= 6:
        return view
    off = rotate(axis_angle(jnp.array([0.0, 0.0, 1.0]), memory.target[3]), jnp.array(grip))
    object = view.objects[name].replace(pos_w=memory.target[:3] - off)
    return view.replace(objects={**view.objects, name: object}, ee_pos_w=memory.target[:3])


def with_cube(view: View, pos) -> View:
    return view.replace(objects={"cube": view.objects["cube"].replace(pos_w=pos)})


@pytest.fixture(scope="module")
def cobotta_view() -> View:
    """The Cobotta at home, the cube at ``PICK``, its place at ``PLACE``; the robot stands at the world's origin."""
    env = make("cobotta_pick_place", impl="native")
    view = jax.jit(lambda key: env.view(env.reset(key)))(jax.random.PRNGKey(0))
    place = jnp.asarray(PLACE, jnp.float32)
    return with_cube(view, jnp.asarray(PICK, jnp.float32)).replace(goal_pos_w=place, command=place)


def test_phases_take_whole_steps():
    """ceil(1 / share) of the share as written: 0.1 takes 10 steps, where adding 0.1 up in floating point takes 11."""
    np.testing.assert_array_equal(placer(events_dt=TUTORIAL).steps, [200, 500, 1, 20, 1250, 200, 1250, 10, 1250, 125])
    default = placer()
    np.testing.assert_array_equal(default.steps, [100, 80, 20, 50, 80, 250, 100, 40, 80, 50])
    assert placer(events_dt=(0.3, *TUTORIAL[1:])).steps[0] == 4  # three and a third
    shares = [1 / k for k in range(1, 31)]
    counts = np.concatenate([placer(events_dt=tuple(shares[i : i + 10])).steps for i in range(0, 30, 10)])
    np.testing.assert_array_equal(counts, np.arange(1, 31))


@pytest.mark.parametrize(
    "shares", [TUTORIAL[:9], (*TUTORIAL, 0.1), (0.0, *TUTORIAL[1:]), (*TUTORIAL[:9], 1.5), (*TUTORIAL[:4], -0.1, *TUTORIAL[5:])]
)
def test_events_dt_takes_ten_shares(shares):
    with pytest.raises(UserError, match="events_dt takes 10 shares above 0 and up to 1, got"):
        placer(events_dt=shares)


# Four steps a phase but for the one that the tutorial gives a single step.
SHORT = (0.25, 0.25, 1.0, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25, 0.25)
STEPS = [4, 4, 1, 4, 4, 4, 4, 4, 4, 4]


class Walk:
    """All phases on one view, kept still: the memories after each step, and the targets of the drives."""

    def __init__(self, view: View, offset=(0.0, 0.0, 0.0), grip=(0.0, 0.0, 0.0), events_dt=SHORT, **changes):
        self.controller = placer(events_dt=events_dt, end_effector_offset=offset, **changes)
        self.steps = self.controller.steps.tolist()
        # The cube in the grip where it was before: the grasp point stays ``grip`` off the cube.
        self.view = view.replace(
            ee_pos_w=view.objects["cube"].pos_w + jnp.array(grip), ctrl=view.ctrl.at[6:].set(jnp.array([0.3, -0.3]))
        )
        step, memory = jax.jit(self.controller.step), self.controller.init(self.view)
        self.first, self.memories, self.targets = memory, [], []
        for _ in range(sum(self.steps) + 3):
            memory, targets = step(memory, hung(self.view, memory, "cube", grip))
            self.memories.append(memory)
            self.targets.append(np.asarray(targets))

    def target(self, phase: int, count: int) -> np.ndarray:
        return np.asarray(self.memories[sum(self.steps[:phase]) + count].target)


@pytest.fixture(scope="module")
def walk(cobotta_view) -> Walk:
    return Walk(cobotta_view)


def s(share: float) -> float:
    return (1 - np.cos(np.pi * share)) / 2


def test_phases_change_by_time_alone(walk):
    phases = [0] + [int(m.phase) for m in walk.memories]
    want = np.repeat(np.arange(10), STEPS).tolist() + [10] * 4
    assert phases == want
    counts = [0] + [int(m.count) for m in walk.memories]
    assert counts[: sum(STEPS)] == [k for n in STEPS for k in range(n)]
    done = [bool(walk.controller.is_done(m)) for m in walk.memories]
    assert done == [False] * (sum(STEPS) - 1) + [True] * 4


def test_targets_of_the_phases(walk):
    """At the start, half-way and three quarters of each phase, with travel at 0.2 m; the grasp point begins at the cube."""
    high, low, place = 0.2, PICK[2], PLACE[2]
    heights = {
        0: lambda s: (1 - s) * low + s * high,
        1: lambda s: (1 - s) * high + s * low,
        4: lambda s: (1 - s) * low + s * high,
        5: lambda s: high,
        6: lambda s: (1 - s) * high + s * place,
        8: lambda s: (1 - s) * place + s * high,
        9: lambda s: high,
    }
    assert s(0.5) == pytest.approx(0.5) and s(0.75) == pytest.approx(0.8535534)
    for phase, height in heights.items():
        for count in (0, 2, 3):
            target = walk.target(phase, count)
            assert target[2] == pytest.approx(height(s(count / 4)), abs=1e-6), (phase, count)
            if phase != 5:
                np.testing.assert_allclose(target[:2], (PICK if phase <= 4 else PLACE)[:2], atol=1e-6)


def test_targets_stay_while_the_fingers_move_and_after_the_end(walk):
    for phase in (2, 3, 7):
        before = walk.target(phase - 1, STEPS[phase - 1] - 1)
        for count in range(STEPS[phase]):
            np.testing.assert_array_equal(walk.target(phase, count), before)
    for memory in walk.memories[sum(STEPS) :]:
        np.testing.assert_array_equal(memory.target, walk.target(9, 3))


def test_fingers_are_closed_in_phases_3_to_6(walk):
    """0.9 rad/s on from the targets in force, (0.3, -0.3): closing to 0.318, opening to 0.282."""
    for phase in range(10):
        for count in range(STEPS[phase]):
            fingers = walk.targets[sum(STEPS[:phase]) + count][6:]
            want = 0.318 if 3 <= phase <= 6 else 0.282
            np.testing.assert_allclose(fingers, [want, -want], atol=1e-6)
    np.testing.assert_allclose(walk.targets[-1][6:], [0.282, -0.282], atol=1e-6)


def test_travel_is_an_arc_about_the_base(walk):
    start, end = np.arctan2(PICK[1], PICK[0]), np.arctan2(PLACE[1], PLACE[0])
    from_, to = np.linalg.norm(PICK[:2]), np.linalg.norm(PLACE[:2])
    for count in range(4):
        share = s(count / 4)
        radius, angle = (1 - share) * from_ + share * to, start + share * (end - start)
        want = radius * np.array([np.cos(angle), np.sin(angle)])
        np.testing.assert_allclose(walk.target(5, count)[:2], want, atol=1e-6)


def test_travel_on_a_straight_line(cobotta_view):
    line = Walk(cobotta_view, arc=False)
    for count in range(4):
        want = (1 - s(count / 4)) * PICK[:2] + s(count / 4) * PLACE[:2]
        np.testing.assert_allclose(line.target(5, count)[:2], want, atol=1e-6)


def test_offset_of_the_grasp_point_counts_at_the_pick(cobotta_view):
    offset = (0.01, -0.02, 0.015)
    walk = Walk(cobotta_view, offset=offset, grip=offset)
    np.testing.assert_allclose(walk.target(1, 0)[:2], PICK[:2] + offset[:2], atol=1e-6)
    assert walk.target(1, 0)[2] == pytest.approx(0.2)
    low = PICK[2] + offset[2]
    assert walk.target(1, 2)[2] == pytest.approx((0.2 + low) / 2, abs=1e-6)
    # the cube hangs that far off the grasp point, so it is put down with the same
    np.testing.assert_allclose(walk.target(6, 2)[:2], PLACE[:2] + offset[:2], atol=1e-6)
    assert walk.target(6, 2)[2] == pytest.approx((0.2 + PLACE[2] + offset[2]) / 2, abs=1e-6)


def test_a_cube_that_slid_in_the_grip_is_made_up_for(cobotta_view):
    slid, long = (0.004, -0.003, 0.002), (*SHORT[:4], 0.01, 0.01, *SHORT[6:])
    walk = Walk(cobotta_view, grip=slid, events_dt=long)
    np.testing.assert_allclose(walk.target(4, 50)[:2], PICK[:2], atol=1e-6)
    np.testing.assert_allclose(walk.target(6, 2)[:2], PLACE[:2] + slid[:2], atol=1e-5)
    assert walk.target(6, 2)[2] == pytest.approx((0.2 + PLACE[2] + slid[2]) / 2, abs=1e-5)
    np.testing.assert_allclose(walk.target(9, 0)[:2], PLACE[:2] + slid[:2], atol=1e-5)  # as it was put down
    # What cannot be a grip (a cube that is lost) counts for 3 cm at most.
    lost = Walk(cobotta_view, grip=(0.4, 0.0, 0.0), events_dt=long)
    np.testing.assert_allclose(lost.target(6, 2)[:2], PLACE[:2] + [0.03, 0.0], atol=1e-5)


def test_an_arm_that_yields_to_its_load_puts_it_where_it_belongs(cobotta_view):
    """The hand, and the cube in the middle of it, stay 1 cm behind: the target goes as far beyond."""
    controller = placer(events_dt=(*SHORT[:6], 0.005, *SHORT[7:]))
    step, memory = jax.jit(controller.step), controller.init(cobotta_view)
    memory = memory.replace(phase=memory.phase + 6, target=jnp.append(cobotta_view.goal_pos_w, 0.0))
    for _ in range(150):
        at = memory.target[:3] - jnp.array([0.01, 0.0, 0.0])
        memory, _ = step(memory, with_cube(cobotta_view, at).replace(ee_pos_w=at))
    np.testing.assert_allclose(memory.target[:2] - cobotta_view.goal_pos_w[:2], [0.01, 0.0], atol=1e-4)


def test_the_pick_is_where_the_cube_was_when_the_fingers_went_for_it(cobotta_view):
    controller = placer(events_dt=SHORT)
    step, cube = jax.jit(controller.step), cobotta_view.objects["cube"].pos_w
    for phase, follows in [(0, True), (1, True), (2, False), (4, False)]:
        memory = controller.init(cobotta_view)
        memory = memory.replace(phase=memory.phase + phase)
        moved = with_cube(cobotta_view, cube + jnp.array([0.05, 0.0, 0.0]))
        after, _ = step(memory, moved)
        assert float(after.pick[0]) == pytest.approx(0.55 if follows else 0.5)


@pytest.mark.parametrize(
    ("a", "b", "turn"),
    [
        ((0.5, 0.0), (0.0, 0.5), np.pi / 2),
        ((0.0, 0.5), (0.5, 0.0), -np.pi / 2),
        ((0.4, -0.3), (-0.3, 0.4), None),
        ((-0.5, -0.01), (-0.5, 0.01), -2 * np.arctan2(0.01, 0.5)),  # across the seam of atan2
        ((-0.5, 0.01), (-0.4, -0.3), None),
        ((0.6, 0.0), (0.2, 0.01), np.arctan2(0.01, 0.2)),
    ],
)
def test_arc_goes_the_short_way_at_radii_between_both(a, b, turn):
    center = jnp.array([0.1, -0.2])
    a, b = np.array(a), np.array(b)
    at = [pick_place._arc(center + a, center + b, jnp.array(x), center) - center for x in np.linspace(0, 1, 41)]
    points = np.array(at, np.float64)
    np.testing.assert_allclose(points[0], a, atol=1e-6)
    np.testing.assert_allclose(points[-1], b, atol=1e-6)
    radii = np.linalg.norm(points, axis=1)
    np.testing.assert_allclose(radii, np.linspace(np.linalg.norm(a), np.linalg.norm(b), 41), atol=1e-6)
    steps = np.diff(np.unwrap(np.arctan2(points[:, 1], points[:, 0])))
    np.testing.assert_allclose(steps, steps.mean(), atol=1e-4)  # at one rate
    assert abs(steps.sum()) <= np.pi + 1e-6
    if turn is not None:
        assert steps.sum() == pytest.approx(turn, abs=1e-4)


def test_episodes_too_short_for_the_phases_are_told_of():
    controller = placer()
    ended = PickPlaceMemory(phase=jnp.array([10, 9, 3]), **dict.fromkeys(REST_OF_MEMORY, jnp.zeros(3)))
    assert controller.warning(ended) == "2 of 3 episodes ended before the ten phases (17.0 s)"
    assert controller.warning(ended.replace(phase=jnp.array([10, 10, 10]))) == ""
    assert len(PHASES) == 10
    twice = placer(tower=("a", "b", "c"))
    assert twice.warning(ended) == "2 of 3 episodes ended before the ten phases (34.0 s)"


# --- towers


def several(view: View, **at) -> View:
    """Objects by name: x, y, z and turn."""
    like, up = view.objects["cube"], jnp.array([0.0, 0.0, 1.0])
    poses = {name: (jnp.array(pose[:3]), axis_angle(up, jnp.array(pose[3]))) for name, pose in at.items()}
    return view.replace(objects={name: like.replace(pos_w=pos, quat_w=quat) for name, (pos, quat) in poses.items()})


def test_a_tower_is_built_object_by_object(cobotta_view):
    """b onto a, then c onto b, from where it then is; the arm goes over to c on the way that it goes at the start."""
    at = {"a": (0.5, 0.2, 0.02, 0.0), "b": (0.5, -0.1, 0.02, 0.0), "c": (0.4, -0.2, 0.02, 0.0)}
    controller = placer(events_dt=SHORT, tower=("a", "b", "c"), rise=0.04, arc=False)
    step, view = jax.jit(controller.step), several(cobotta_view, **at)
    memory, seen = controller.init(view), []
    for _ in range(2 * sum(STEPS) + 2):
        memory, _ = step(memory, hung(view, memory, "bc"[int(memory.move)]))
        seen.append((int(memory.move), int(memory.phase), np.asarray(memory.target)))
    first, second = seen[: sum(STEPS)], seen[sum(STEPS) :]
    assert [m for m, _, _ in first] == [0] * (sum(STEPS) - 1) + [1] and {m for m, _, _ in second} == {1}
    assert first[-1][1] == 0 and second[-1][1] == second[-3][1] == 10
    down, put = sum(STEPS[:2]) - 1, sum(STEPS[:7]) - 1
    s3 = s(0.75)  # the last step of a phase
    np.testing.assert_allclose(first[down][2], [0.5, -0.1, (1 - s3) * 0.2 + s3 * 0.02, 0.0], atol=1e-6)
    np.testing.assert_allclose(first[put][2], [0.5, 0.2, (1 - s3) * 0.2 + s3 * 0.06, 0.0], atol=1e-6)
    np.testing.assert_allclose(second[2][2], [0.45, 0.0, 0.2, 0.0], atol=1e-6)  # half-way from a to c
    np.testing.assert_allclose(second[down][2], [0.4, -0.2, (1 - s3) * 0.2 + s3 * 0.02, 0.0], atol=1e-6)
    np.testing.assert_allclose(second[put][2], [0.5, -0.1, (1 - s3) * 0.2 + s3 * 0.06, 0.0], atol=1e-6)  # b has not moved here


def test_the_hand_turns_as_the_object_and_then_as_the_goal(cobotta_view):
    """A box at 0.4 rad whose goal is at -0.6 rad; the grasp point is 1 cm along the hand's x from the box."""
    view = several(cobotta_view, box=(0.5, -0.1, 0.02, 0.4)).replace(
        goal_quat_w=axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(-0.6))
    )
    off = 0.01 * np.array([np.cos(0.4), np.sin(0.4)])
    controller = placer(events_dt=SHORT, tower=("goal", "box"), turn=True, end_effector_offset=(0.01, 0.0, 0.0))
    step, view = jax.jit(controller.step), view.replace(ee_pos_w=view.objects["box"].pos_w + jnp.array([*off, 0.0]))
    memory, targets = controller.init(view), []
    for _ in range(sum(STEPS)):
        memory, _ = step(memory, hung(view, memory, "box", (0.01, 0.0, 0.0)))
        targets.append(np.asarray(memory.target))
    starts = np.cumsum([0, *STEPS])
    assert targets[2][3] == pytest.approx(0.2, abs=1e-6)  # half-way in phase 0
    np.testing.assert_allclose(targets[starts[1]][[0, 1, 3]], [*(PICK[:2] + off), 0.4], atol=1e-6)
    assert targets[starts[5] + 2][3] == pytest.approx(-0.1, abs=1e-6)  # half-way across
    # The box may lag by a step of the turn: its place in the grip counts by a twentieth a step.
    end = 0.01 * np.array([np.cos(-0.6), np.sin(-0.6)])
    np.testing.assert_allclose(targets[starts[9]][[0, 1, 3]], [*(PLACE[:2] + end), -0.6], atol=1e-3)


def test_a_tower_of_nothing_is_refused():
    with pytest.raises(UserError, match="^tower names what stays or 'goal', then one or more objects to put there, got"):
        placer(tower=("goal",))


# --- following


def follower(**cfg) -> tuple:
    robot = dataclasses.replace(COBOTTA_PRO_900, ee_site="flange")
    return robot, IkFollower(robot, DT, dataclasses.replace(IkCfg(restarts=1, iterations=8), **cfg))


def looking(view: View, goal) -> View:
    return view.replace(goal_pos_w=jnp.asarray(goal, jnp.float32), goal_quat_w=jnp.array([0.0, 0.0, 1.0, 0.0]))


def test_ik_follower_without_a_solution_stays_and_counts(cobotta_view):
    robot, controller = follower()
    view, step = looking(cobotta_view, [1.5, 0.0, 0.5]), jax.jit(controller.step)
    memory = controller.init(view)
    for k in range(3):
        memory, targets = step(memory, view)
        np.testing.assert_allclose(targets[:6], robot.arm.home, atol=1e-6)
        assert (int(memory.failures), int(memory.step)) == (k + 1, k + 1)
    np.testing.assert_array_equal(targets[6:], view.ctrl[6:])
    batch = jax.tree.map(lambda x: jnp.stack([x, jnp.zeros_like(x)]), memory)
    text = "inverse kinematics found no solution in 3 of 3 steps (1 of 2 episodes): the arm did not move there"
    assert controller.warning(batch) == text
    assert controller.warning(jax.tree.map(jnp.zeros_like, batch)) == ""


def test_ik_follower_keeps_the_drives_speed(cobotta_view):
    robot, controller = follower()
    view, step = looking(cobotta_view, [0.3, 0.35, 0.5]), jax.jit(controller.step)
    memory, limit, lead = controller.init(view), np.array(robot.arm.speed) * DT, np.array(robot.arm.lead)
    moved = 0
    for _ in range(60):
        before = np.asarray(memory.q)
        memory, targets = step(memory, view)
        q = np.asarray(memory.q)
        assert (np.abs(q - before) <= limit + 1e-6).all()
        np.testing.assert_allclose(targets[:6], q + lead * (q - before) / DT, atol=1e-5)  # ahead by what the drive lags
        moved += np.abs(np.abs(q - before) - limit).min() < 1e-6
    assert moved > 5 and int(memory.failures) == 0
    pos, quat = controller.ik.chain.poses(memory.q)
    np.testing.assert_allclose(pos[0], [0.3, 0.35, 0.5], atol=1.1e-3)
    assert abs(float(quat[0] @ jnp.array([0.0, 0.0, 1.0, 0.0]))) > np.cos(0.01 / 2) - 1e-6


def test_rmp_follower_moves_towards_the_target_and_leaves_the_gripper(cobotta_view):
    robot = dataclasses.replace(COBOTTA_PRO_900, ee_site="flange")
    controller = RmpFollower(robot, DT)
    view = looking(cobotta_view, [0.5, 0.2, 0.54])
    memory, targets = jax.jit(controller.step)(controller.init(view), view)
    assert memory == () and controller.warning(memory) == ""
    assert targets.shape == (8,) and (targets[6:] == view.ctrl[6:]).all()
    assert targets[0] > robot.arm.home[0]  # positive joint_1 turns towards +y


# --- by name


def test_make_by_name():
    made = control.make("pick_place", COBOTTA_PRO_900, DT, {"end_effector_initial_height": "0.3", "arc": "false"})
    assert isinstance(made, PickPlace) and made.cfg.end_effector_initial_height == 0.3 and made.cfg.arc is False
    assert made.cfg.events_dt == PickPlaceCfg().events_dt
    assert isinstance(control.make("ik", NERO, DT), IkFollower)
    made = control.make("rmpflow", NERO, DT, {"maximum_substep_size": 0.01})
    assert isinstance(made, RmpFollower)
    assert set(control.CONTROLLERS) == {
        "ik",
        "rmpflow",
        "pick_place",
        "pick_up",
        "detour",
        "carry",
        "follow_joint",
        "grasp_thing",
        "hand_over",
        "put_in",
        "put_thing",
        "turn_over",
    }


@pytest.mark.parametrize(
    ("name", "overrides", "message"),
    [
        ("spline", {}, "unknown controller 'spline': choose one of ik, rmpflow, pick_place"),
        ("ik", {"iteration": 3}, r"no field 'iteration': .*did you mean 'iterations'"),
        ("ik", {"iterations": "many"}, "iterations takes a whole number, got 'many'"),
        ("pick_place", {"events_dt": "(0.1, 0.1)"}, "events_dt takes 10 shares above 0 and up to 1, got"),
        ("pick_place", {"rmpflow.descriptor": "nowhere.yaml"}, "nowhere.yaml"),
    ],
)
def test_what_make_refuses(name, overrides, message):
    with pytest.raises(UserError, match=message):
        control.make(name, COBOTTA_PRO_900, DT, overrides)
