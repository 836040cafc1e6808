"""Every term on hand-made views, against numbers worked out by hand, and the folds that apply them."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import UserError
from mjx_nero.mdp import actions, commands, curriculum, events, metrics, observations, rewards, success, terminations, terms
from mjx_nero.mdp.memory import Delay, History
from mjx_nero.mdp.terms import CommandTerm, DoneTerm, ObservationGroup, ObservationTerm, RewardTerm, Term
from mjx_nero.types import LEVEL, ObjectView, ObstacleView, ShapeView, Start, View

KEY = jax.random.PRNGKey(0)
RECALL = terms.Recall({})  # no term here remembers anything
TANH_1, TANH_HALF, TANH_2 = 0.76159416, 0.46211716, 0.96402758


def view(**changes) -> View:
    """A robot with two joints at the root (1, 2, 3): the object is 5 cm from the grasp point, 10 cm from the goal."""
    fields = {
        "joint_pos": [0.5, -0.25],
        "joint_vel": [2.0, -3.0],
        "default_joint_pos": [0.25, 0.25],
        "ctrl": [0.75, 0.0],
        "ee_pos_w": [1.03, 2.04, 3.2],
        "ee_quat_w": [1.0, 0.0, 0.0, 0.0],
        "object_pos_w": [1.0, 2.0, 3.2],
        "object_quat_w": [0.5, 0.5, 0.5, 0.5],
        "object_linvel_w": [1.0, 2.0, 3.0],
        "object_angvel_local": [4.0, 5.0, 6.0],
        "root_pos_w": [1.0, 2.0, 3.0],
        "command": [0.0, 0.0, 0.3],
        "goal_pos_w": [1.0, 2.0, 3.3],
        "goal_quat_w": [0.0, 1.0, 0.0, 0.0],
        "goal_linvel_w": [0.1, 0.2, 0.3],
        "action": [0.5, -1.0, 2.0],
        "last_action": [0.0, 1.0, 2.0],
        **changes,
    }
    step = fields.pop("step", 3)
    arrays = {name: jnp.asarray(value, jnp.float32) for name, value in fields.items()}
    of_cube = {name.removeprefix("object_"): arrays.pop(name) for name in list(arrays) if name.startswith("object_")}
    objects = {"cube": ObjectView(**of_cube), "other": ObjectView(**{name: 2 * value for name, value in of_cube.items()})}
    return View(**arrays, objects=objects, step=jnp.asarray(step, jnp.int32), time=jnp.asarray(0.02 * step), max_steps=250)


def beside(touch: float = 0.0, **changes) -> View:
    """... 5 cm from a box that is a quarter turned about z, 10 cm wide there; another is far away."""
    turned, far = np.float32([0.5**0.5, 0, 0, 0.5**0.5]), np.float32([9, 9, 9])
    one = ObstacleView(jnp.float32([1.13, 2.04, 3.2]), jnp.asarray(turned), jnp.float32([0.04, 0.1, 0.2]))
    two = ObstacleView(jnp.asarray(far), jnp.asarray(turned), jnp.float32([0.04, 0.1, 0.2]))
    return view(**changes).replace(obstacles={"one": one, "two": two}, readings={"touch": jnp.float32(touch)})


def at_height(z: float) -> View:
    return view(object_pos_w=[1.0, 2.0, z], ee_pos_w=[1.0, 2.0, z + 0.03], goal_pos_w=[1.0, 2.0, z + 0.1])


def pushed(ee_pos_w: list[float]) -> View:
    """The goal 4 and 3 cm from the object, along the table."""
    return view(ee_pos_w=ee_pos_w, goal_pos_w=[1.04, 2.03, 3.2])


# 13 cm and a right angle from the goal
QUARTER = {"ee_pos_w": [1.03, 2.04, 3.42], "goal_quat_w": [0.5**0.5, 0.0, 0.0, 0.5**0.5]}
LYING = {"object_quat_w": [1.0, 0.0, 0.0, 0.0], "goal_quat_w": [0.5**0.5, 0.0, 0.0, 0.5**0.5]}

REWARDS = [
    (rewards.object_ee_distance, {"std": 0.05}, view(), 1 - TANH_1),
    (rewards.object_ee_distance, {"std": 0.1}, view(), 1 - TANH_HALF),
    (rewards.object_is_lifted, {"minimal_height": 3.19}, view(), 1.0),
    (rewards.object_is_lifted, {"minimal_height": 3.21}, view(), 0.0),
    (rewards.object_goal_distance, {"std": 0.1, "minimal_height": 0.025}, at_height(0.03), 1 - TANH_1),
    (rewards.object_goal_distance, {"std": 0.2, "minimal_height": 0.025}, at_height(0.03), 1 - TANH_HALF),
    (rewards.object_goal_distance, {"std": 0.1, "minimal_height": 0.025}, at_height(0.02), 0.0),
    # 3 cm from the grasp point
    (rewards.object_is_held, {"minimal_height": 0.025, "grasp_radius": 0.04}, at_height(0.03), 1.0),
    (rewards.object_is_held, {"minimal_height": 0.025, "grasp_radius": 0.02}, at_height(0.03), 0.0),
    (rewards.object_is_held, {"minimal_height": 0.025, "grasp_radius": 0.04}, at_height(0.02), 0.0),
    (rewards.held_goal_distance, {"std": 0.05, "minimal_height": 0.025, "grasp_radius": 0.04}, at_height(0.03), 1 - TANH_2),
    (rewards.held_goal_distance, {"std": 0.05, "minimal_height": 0.025, "grasp_radius": 0.02}, at_height(0.03), 0.0),
    (rewards.held_goal_distance, {"std": 0.05, "minimal_height": 0.035, "grasp_radius": 0.04}, at_height(0.03), 0.0),
    # 10 cm from the goal
    (rewards.held_at_goal, {"threshold": 0.11, "minimal_height": 0.025, "grasp_radius": 0.04}, at_height(0.03), 1.0),
    (rewards.held_at_goal, {"threshold": 0.09, "minimal_height": 0.025, "grasp_radius": 0.04}, at_height(0.03), 0.0),
    (rewards.held_at_goal, {"threshold": 0.11, "minimal_height": 0.025, "grasp_radius": 0.02}, at_height(0.03), 0.0),
    (rewards.held_at_goal, {"threshold": 0.11, "minimal_height": 0.035, "grasp_radius": 0.04}, at_height(0.03), 0.0),
    # 10 cm from the goal whether lifted or not; the grasp point (0.03, 0.04, -0.12) from it: 13 cm
    (rewards.goal_distance, {"std": 0.1}, view(), 1 - TANH_1),
    (rewards.goal_distance, {"std": 0.2}, at_height(-1.0), 1 - TANH_HALF),
    (rewards.ee_goal_distance, {"std": 0.13}, view(ee_pos_w=[1.03, 2.04, 3.42]), 1 - TANH_1),
    (rewards.ee_goal_distance, {"std": 0.26}, view(ee_pos_w=[1.03, 2.04, 3.42]), 1 - TANH_HALF),
    (rewards.ee_position_error, {}, view(ee_pos_w=[1.03, 2.04, 3.42]), 0.13),
    # half a turn about x from the goal; a quarter about z, whichever of its two quaternions it is given by
    (rewards.ee_orientation_error, {}, view(), math.pi),
    (rewards.ee_orientation_error, {}, view(goal_quat_w=[-(0.5**0.5), 0.0, 0.0, -(0.5**0.5)]), math.pi / 2),
    (rewards.ee_goal_pose, {"std": 0.26, "angle_std": math.pi / 2}, view(**QUARTER), (1 - TANH_HALF) * (1 - TANH_1)),
    # 10 cm and a right angle from the goal: of a box with four sides alike, none
    (rewards.object_goal_pose, {"std": 0.1, "angle_std": math.pi / 2}, view(**LYING), (1 - TANH_1) ** 2),
    (rewards.object_goal_pose, {"std": 0.1, "angle_std": math.pi / 2, "fold": 4}, view(**LYING), 1 - TANH_1),
    # wherever it is
    (rewards.object_goal_turn, {"std": math.pi / 2}, view(**LYING), 1 - TANH_1),
    (rewards.object_goal_turn, {"std": math.pi}, view(**{**LYING, "object_pos_w": [9.0, 9.0, 9.0]}), 1 - TANH_HALF),
    (rewards.object_goal_turn, {"std": 1.0, "fold": 4}, view(**LYING), 1.0),
    # the hand 10 cm above the place that is as far behind the object as the goal is before it; the goal straight above it
    (rewards.behind_object_distance, {"std": 0.1, "behind": 0.05, "near": 1e-6}, pushed([0.96, 1.97, 3.3]), 1 - TANH_1),
    (rewards.behind_object_distance, {"std": 0.2, "behind": 0.13, "near": 0.12}, pushed([0.96, 1.97, 3.3]), 1 - TANH_HALF),
    (rewards.behind_object_distance, {"std": 0.05, "behind": 0.05}, view(), 1 - TANH_1),
    (rewards.object_at_pose, {"threshold": 0.11, "angle": 1.6}, view(**LYING), 1.0),
    (rewards.object_at_pose, {"threshold": 0.11, "angle": 1.5, "fold": 2}, view(**LYING), 0.0),
    (rewards.object_at_pose, {"threshold": 0.11, "angle": 0.1, "fold": 4}, view(**LYING), 1.0),
    (rewards.object_at_pose, {"threshold": 0.09, "angle": 1.6}, view(**LYING), 0.0),
    # joints of 2 and 3 rad/s
    (rewards.stillness, {"std": 6.5**0.5}, view(), math.exp(-1)),
    (rewards.action_rate_l2, {}, view(), 0.25 + 4.0 + 0.0),
    (rewards.gripper_action_l2, {}, view(), 4.0),
    (rewards.joint_vel_l2, {}, view(), 4.0 + 9.0),
    (rewards.touching, {}, beside(), 0.0),
    (rewards.touching, {}, beside(touch=1e-3), 1.0),
    (rewards.obstacle_nearness, {"margin": 0.1}, beside(), 0.5),
    (rewards.obstacle_nearness, {"margin": 0.04}, beside(), 0.0),
    (rewards.obstacle_nearness, {"margin": 0.04}, beside(ee_pos_w=[1.13, 2.04, 3.2]), 1.0),  # within it
]


@pytest.mark.parametrize(("func", "params", "at", "value"), REWARDS)
def test_rewards(func, params, at, value):
    got = func(at, **params)
    assert got.shape == () and got.dtype == jnp.float32
    assert float(got) == pytest.approx(value, abs=2e-5)


def test_every_public_reward_is_tested():
    public = {f for n, f in vars(rewards).items() if callable(f) and not n.startswith("_") and f.__module__ == rewards.__name__}
    assert public - {row[0] for row in REWARDS} == {rewards.held}


def test_held_and_at_goal():
    assert rewards.held(at_height(0.03), minimal_height=0.025, grasp_radius=0.04)
    assert not rewards.held(view(object_pos_w=[1.0, 2.0, 3.0]), minimal_height=0.025, grasp_radius=0.04)  # knocked up, not held
    for target, up in ((0, True), (1, False)):  # of several objects each has its own height
        commanded = at_height(0.03).replace(target=jnp.array(target))
        assert bool(rewards.held(commanded, minimal_height=(0.025, 0.035), grasp_radius=0.04)) is up
    assert success.object_at_goal(view(), threshold=0.101) and not success.object_at_goal(view(), threshold=0.099)


THIRD = 2 * math.pi / 3 / 3**0.5
FAR = 0.05 * np.array([0.97, 1.96, 3.2]) / np.linalg.norm([0.97, 1.96, 3.2])  # 5 cm of the way from the grasp point to the other


def feeling(view):
    """The same arm with sensors: six numbers at the wrist, one of the hand."""
    return dataclasses.replace(view, readings={"wrist": jnp.array([0.0, 0.0, -9.81, 0.1, 0.2, 0.3]), "hand": jnp.array(2.5)})


def shaped(view):
    """The cube has the code of a mesh."""
    mesh = dataclasses.replace(
        view.objects["cube"], shape=ShapeView(*[jnp.array([0.1, 0.2, 0.05])] * len(dataclasses.fields(ShapeView)))
    )
    return dataclasses.replace(view, objects={**view.objects, "cube": mesh})


OBSERVATIONS = [
    (observations.joint_pos, [0.5, -0.25]),
    (observations.joint_pos_rel, [0.25, -0.5]),
    (observations.joint_vel_rel, [2, -3]),
    (observations.object_position, [0, 0, 0.2]),
    (observations.command, [0, 0, 0.3]),
    (observations.pose_command, [0, 0, 0.3, 0, 1, 0, 0]),
    (observations.ee_to_goal, [-0.03, -0.04, 0.1]),
    (observations.ee_turn_to_goal, [math.pi, 0, 0]),
    (observations.last_action, [0.5, -1, 2]),
    (observations.ee_position, [0.03, 0.04, 0.2]),
    (observations.ee_to_object, [-0.03, -0.04, 0]),
    (observations.object_to_goal, [0, 0, 0.1]),
    (observations.target_error, [0.25, 0.25]),
    (observations.object_velocity, [1, 2, 3, 4, 5, 6]),
    (observations.object_orientation, [0.5, 0.5, 0.5, 0.5]),
    (observations.ee_orientation, [1, 0, 0, 0]),
    (observations.object_heading, [0, 1]),  # a third of a turn about (1, 1, 1) takes x to y
    # half a turn about x after a third back about (1, 1, 1): (0, 1, 0, 0) (0.5, -0.5, -0.5, -0.5) = (0.5, 0.5, 0.5, -0.5)
    (observations.object_turn_to_goal, [THIRD, THIRD, -THIRD]),
    (lambda view: observations.ee_to_objects(view, objects=("cube", "other"), limit=0.05), [-0.03, -0.04, 0, *FAR]),
    (observations.goal_position, [0, 0, 0.3]),
    (observations.goal_orientation, [0, 1, 0, 0]),
    (lambda view: observations.reading(feeling(view), name="wrist"), [0.0, 0.0, -9.81, 0.1, 0.2, 0.3]),
    (lambda view: observations.reading(feeling(view), name="hand"), [2.5]),
    (lambda view: observations.object_shape(shaped(view)), [0.1, 0.2, 0.05]),
    (lambda view: observations.obstacle(beside(), obstacle="one"), [0.13, 0.04, 0.2, 0.5**0.5, 0, 0, 0.5**0.5, 0.04, 0.1, 0.2]),
]


@pytest.mark.parametrize(("func", "value"), OBSERVATIONS)
def test_observations(func, value):
    np.testing.assert_allclose(func(view()), value, rtol=0, atol=5e-7)  # rounding of coordinates of size 3


def test_every_observation_is_tested():
    public = {f for f in vars(observations).values() if getattr(f, "__module__", "") == observations.__name__}
    assert public - {row[0] for row in OBSERVATIONS} == {
        *(observations.ee_to_objects, observations.obstacle, observations.reading, observations.object_shape)  # in a lambda
    }


def test_what_is_not_measured_is_said():
    with pytest.raises(UserError, match="measures no 'wrist': its readings are hand "):
        observations.reading(dataclasses.replace(view(), readings={"hand": 2.5}), name="wrist")
    with pytest.raises(UserError, match="the shape of a mesh, but 'cube' is not a mesh"):
        observations.object_shape(view())


@pytest.mark.parametrize(
    ("func", "params", "changes", "hit"),
    [
        (terminations.time_out, {}, {"step": 249}, False),
        (terminations.time_out, {}, {"step": 250}, True),
        (terminations.time_out, {}, {"step": 251}, True),
        (terminations.object_below, {"minimum_height": -0.05}, {"object_pos_w": [0, 0, -0.049]}, False),
        (terminations.object_below, {"minimum_height": -0.05}, {"object_pos_w": [0, 0, -0.051]}, True),
        # the table from x = -0.2 to 0.8, y = -0.6 to 0.6
        (terminations.object_off_table, {"center": (0.3, 0.0), "size": (1.0, 1.2)}, {"object_pos_w": [0.79, 0.59, 9]}, False),
        (terminations.object_off_table, {"center": (0.3, 0.0), "size": (1.0, 1.2)}, {"object_pos_w": [-0.19, -0.59, 9]}, False),
        (terminations.object_off_table, {"center": (0.3, 0.0), "size": (1.0, 1.2)}, {"object_pos_w": [0.81, 0, 0]}, True),
        (terminations.object_off_table, {"center": (0.3, 0.0), "size": (1.0, 1.2)}, {"object_pos_w": [-0.21, 0, 0]}, True),
        (terminations.object_off_table, {"center": (0.3, 0.0), "size": (1.0, 1.2)}, {"object_pos_w": [0, 0.61, 0]}, True),
        (terminations.object_off_table, {"center": (0.3, 0.0), "size": (1.0, 1.2)}, {"object_pos_w": [0, -0.61, 0]}, True),
    ],
)
def test_terminations(func, params, changes, hit):
    assert bool(func(view(**changes), **params)) is hit


PLACED = {"threshold": 0.01, "max_speed": 0.005, "clearance": 0.05}
# 9 mm from the goal, 4.9 mm/s, 51 mm from the grasp point
REST = {
    "object_pos_w": [0.0, 0.0, 0.0],
    "goal_pos_w": [0.0, 0.009, 0.0],
    "object_linvel_w": [0.0049, 0.0, 0.0],
    "ee_pos_w": [0.0, 0.0, 0.051],
}


@pytest.mark.parametrize(
    ("func", "params", "changes", "hit"),
    [
        # 10 cm from the object to the goal, 13 cm from the grasp point
        (success.object_at_goal, {"threshold": 0.101}, {}, True),
        (success.object_at_goal, {"threshold": 0.099}, {}, False),
        (success.ee_at_goal, {"threshold": 0.131}, {"ee_pos_w": [1.03, 2.04, 3.42]}, True),
        (success.ee_at_goal, {"threshold": 0.129}, {"ee_pos_w": [1.03, 2.04, 3.42]}, False),
        (success.ee_at_pose, {"threshold": 0.131, "angle": 1.58}, QUARTER, True),
        (success.ee_at_pose, {"threshold": 0.129, "angle": 1.58}, QUARTER, False),
        (success.ee_at_pose, {"threshold": 0.131, "angle": 1.57}, QUARTER, False),
        (success.object_placed, PLACED, REST, True),
        (success.object_placed, PLACED, {**REST, "goal_pos_w": [0.0, 0.011, 0.0]}, False),  # elsewhere
        (success.object_placed, PLACED, {**REST, "object_linvel_w": [0.003, 0.0, -0.0041]}, False),  # sliding
        (success.object_placed, PLACED, {**REST, "ee_pos_w": [0.0, 0.0, 0.049]}, False),  # in the grip
    ],
)
def test_success(func, params, changes, hit):
    assert bool(func(view(**changes), **params)) is hit


@pytest.mark.parametrize(("object", "near", "far"), [(None, 0.131, 0.129), ("cube", 0.101, 0.099)])
def test_a_touch_is_never_forgotten(object, near, far):
    at = {"ee_pos_w": [1.03, 2.04, 3.42]}  # 13 cm from the goal, the cube 10 cm
    term, metric = success.AtGoalUntouched(threshold=near, object=object), metrics.Touched()
    memory, touched = term.init(KEY, beside()), metric.init(KEY, beside())
    for force, met in ((0.0, True), (0.0, True), (1e-3, False), (0.0, False)):
        memory, now = term.step(memory, beside(touch=force, **at))
        touched, before = metric.step(touched, beside(touch=force, **at))
        assert bool(now) is met and bool(before) is not met
    off = success.AtGoalUntouched(threshold=far, object=object)
    assert not off.step(off.init(KEY, beside()), beside(**at))[1]


def test_calmness_is_a_root_mean_square_of_the_arm_alone():
    """Two joints of an arm and a finger; steps of 0.02 s. Targets move by 3 and 4 mrad, then not at all."""
    targets = [[0.0, 0.0, 9.0], [0.003, -0.004, 5.0], [0.003, -0.004, 7.0]]
    speeds = [[0.0, 0.0, 0.0], [0.02, 0.0, 1.0], [0.02, 0.04, 2.0]]
    seen = [view(ctrl=ctrl, joint_vel=speed, step=i) for i, (ctrl, speed) in enumerate(zip(targets, speeds, strict=True))]
    terms = metrics.calmness(2)
    values = {}
    for name, term in terms.items():
        memory = term.made.init(KEY, seen[0])
        for now in seen[1:]:
            memory, values[name] = term.made.step(memory, now)
    # (9 + 16) / 2 mrad^2 in one of two steps; (1 + 4) / 2 (rad/s^2)^2 in both together
    assert float(values["target_change"]) == pytest.approx(2.5e-3)
    assert float(values["joint_acc"]) == pytest.approx((2.5 / 2) ** 0.5)


def test_distances_of_success():
    assert float(success.object_distance(view())) == pytest.approx(0.1, abs=1e-6)
    assert float(success.ee_distance(view(ee_pos_w=[1.03, 2.04, 3.42]))) == pytest.approx(0.13, abs=1e-6)


def test_pose_is_a_place_in_its_box_and_one_orientation():
    params = {"x": (0.4, 0.5), "y": (-0.1, 0.1), "z": (0.3, 0.3), "quat": (0.0, 0.0, 1.0, 0.0)}
    pos, quat = jax.jit(jax.vmap(lambda k: commands.pose(k, **params)))(jax.random.split(KEY, 500))
    assert (quat == jnp.array([0.0, 0.0, 1.0, 0.0])).all()
    np.testing.assert_allclose(pos.min(0), [0.4, -0.1, 0.3], atol=0.005)
    np.testing.assert_allclose(pos.max(0), [0.5, 0.1, 0.3], atol=0.005)
    box = {name: params[name] for name in "xyz"}
    np.testing.assert_array_equal(commands.pose(KEY, **params)[0], commands.uniform_position(KEY, **box))


@pytest.mark.parametrize(
    ("time", "offset"),
    [(0.0, [0, 0.1, 0]), (1.0, [0, 0, 0.1]), (2.0, [0, -0.1, 0]), (0.5, [0, 0.0707107, 0.0707107]), (4.0, [0, 0.1, 0])],
)
def test_circle(time, offset):
    """A turn of 4 s in the yz plane that starts at +y and rises."""
    at = commands.circle(jnp.array([0.5, 0.1, 0.4]), jnp.array(time), radius=0.1, frequency=0.25)
    np.testing.assert_allclose(at, np.add([0.5, 0.1, 0.4], offset), atol=1e-6)


def test_circle_of_no_radius_or_no_frequency_stays():
    center = jnp.array([0.5, 0.1, 0.4])
    np.testing.assert_array_equal(commands.circle(center, jnp.array(0.7), radius=0.0, frequency=0.25), center)
    for time in (0.0, 0.7):
        at = commands.circle(center, jnp.array(time), radius=0.1, frequency=0.0)
        np.testing.assert_allclose(at, [0.5, 0.2, 0.4], atol=1e-7)


def drives(home, low, high, speed=1.5, open=(0.0,), close=(0.0,), lag=0.1) -> actions.Drives:
    n = len(home)
    arrays = (home, [low] * n, [high] * n, [speed] * n, open, close, [lag] * n)
    return actions.Drives(*(np.array(x, np.float32) for x in arrays), dt=0.02)


GROUPS = {
    "arm": drives([0.25, 2.0], -1.5, 2.5),
    "gripper": drives([0.05, -0.05], -0.05, 0.05, open=[0.05, -0.06], close=[0.0, -0.001]),
}


def play(terms_by_name, inputs, joints=(0.25, 2.0, 0.05, -0.05)):
    """The targets of a chain of action terms for actions one after another."""
    chain, joints = actions.Chain(terms_by_name, GROUPS), jnp.array(joints)
    memory, ctrl, out = chain.init(KEY, joints), joints, []
    for action in inputs:
        memory, ctrl = chain.step(memory, jnp.array(action), joints, ctrl)
        out.append(np.asarray(ctrl))
    return np.array(out)


ARM = {"arm": Term(actions.JointPosition, params={"scale": 0.5})}
GRIPPER = {"gripper": Term(actions.BinaryGripper)}


def test_an_arm_goes_to_home_and_the_scaled_action_within_its_ranges():
    out = play({**ARM, **GRIPPER}, [[1.0, -2.0, 0.0], [9.0, -9.0, 0.0]])
    np.testing.assert_array_equal(out[:, :2], np.float32([[0.75, 1.0], [2.5, -1.5]]))


HALF = 0.02 / np.log(2)  # [s]: a velocity gets half of the way to the action in a step of 0.02 s


def test_velocities_follow_the_action_and_targets_lead_the_set_point_by_the_lag():
    """Rates of 1/4 and -1/2, then 3/8 and -3/4, of 0.03 rad a step; targets 5 such steps ahead."""
    chain = {"arm": Term(actions.JointVelocity, params={"time": HALF, "ahead": 1.0})}
    out = play(chain, [[0.5, -9.0], [0.5, -1.0], [0.0, 0.0]])[:, :2]
    rates = np.array([[0.25, -0.5], [0.375, -0.75], [0.1875, -0.375]])
    np.testing.assert_allclose(out, [0.25, 2.0] + 0.03 * (np.cumsum(rates, axis=0) + 5 * rates), atol=1e-6)
    assert actions.Chain(chain, GROUPS).kinds == ["JointVelocity"]


def test_a_set_point_waits_for_a_joint_that_does_not_move():
    """At 0.04 s of full speed, 0.06 rad: however long the action asks for more, the next one takes it back at once."""
    chain = {"arm": Term(actions.JointVelocity, params={"time": HALF, "ahead": 0.04})}
    out = play(chain, [[1.0, 0.0]] * 20 + [[-1.0, 0.0]] * 2)[:, 0]
    np.testing.assert_allclose(out[19], 0.25 + 0.06 + 0.15, atol=1e-5)
    np.testing.assert_allclose(out[20:], [0.25 + 0.06, 0.25 + 0.06 - 0.015 - 0.075], atol=1e-5)


def test_set_points_and_their_targets_stay_within_the_joints_ranges():
    chain = {"arm": Term(actions.JointVelocity, params={"time": HALF})}
    out = play(chain, [[0.0, 1.0]] * 20, joints=(0.25, 2.45, 0.05, -0.05))[:, 1]
    assert out.max() == np.float32(2.5)


def test_a_speed_limit_of_one_group_leaves_the_others():
    chain = {**ARM, **GRIPPER, "limit": Term(actions.SpeedLimit, params={"group": "gripper"})}
    out = play(chain, [[0.1, -2.0, -1.0]])
    np.testing.assert_allclose(out, [[0.3, 1.0, 0.02, -0.02]], atol=1e-6)


def test_targets_that_turn_back_start_near_the_joints():
    """Fingers that hold at 30 and -20 mm are pressed by targets of 0 and -1; 0.01 s of full speed are 15 mm."""
    chain = {**GRIPPER, "back": Term(actions.AntiWindup, params={"ahead": 0.01}), "limit": Term(actions.SpeedLimit)}
    out = play(chain, [[-1.0], [-1.0], [1.0], [1.0]], joints=(0.25, 2.0, 0.03, -0.02))[:, 2:]
    np.testing.assert_allclose(out[:2], [[0.0, -0.001]] * 2, atol=1e-7)  # closing goes on
    np.testing.assert_allclose(out[2:], [[0.045, -0.035], [0.05, -0.05]], atol=1e-7)  # at once, then as fast as ever


def test_without_anti_windup_targets_take_all_of_the_way_back():
    out = play({**GRIPPER, "limit": Term(actions.SpeedLimit)}, [[-1.0], [-1.0], [1.0]], joints=(0.25, 2.0, 0.03, -0.02))[:, 2:]
    np.testing.assert_allclose(out[-1], [0.03, -0.031], atol=1e-7)


def test_a_gripper_closes_for_negative_actions_within_its_ranges():
    out = play({**ARM, **GRIPPER}, [[0.0, 0.0, a] for a in (-1e-6, -5.0, 0.0, 3.0)])
    np.testing.assert_array_equal(out[:, 2:], np.float32([[0.0, -0.001]] * 2 + [[0.05, -0.05]] * 2))


def test_a_gripper_with_hysteresis_changes_its_mind_beyond_it_alone():
    chain = {**ARM, "gripper": Term(actions.BinaryGripper, params={"hysteresis": 0.5})}
    asked = [(-0.4, False), (-0.6, True), (0.0, True), (0.4, True), (0.6, False), (-0.4, False), (-9.0, True), (0.5, False)]
    out = play(chain, [[0.0, 0.0, action] for action, _ in asked])
    np.testing.assert_array_equal(out[:, 2], np.float32([0.0 if closed else 0.05 for _, closed in asked]))
    assert list(actions.Chain(chain, GROUPS).init(KEY, jnp.zeros(4))) == ["actions.gripper"]
    assert not actions.Chain({**ARM, **GRIPPER}, GROUPS).init(KEY, jnp.zeros(4))


def test_a_gripper_is_told_where_its_targets_are_on_their_way_to():
    """From 50 mm to 0 a millimetre a step: it closes from the first on, and opens from the first back, however far that is."""
    chain = actions.Chain({**ARM, **GRIPPER}, GROUPS)

    def told(now, to, joints=0.02):
        at = [jnp.array([0.0, 0.0, x, -x]) for x in (to, joints, now)]
        return float(chain.invert(*at)[-1])

    assert told(now=0.05, to=0.049) == told(now=0.001, to=0.0) == told(now=0.0, to=0.0) == -1.0
    assert told(now=0.0, to=0.001) == told(now=0.049, to=0.05) == told(now=0.05, to=0.05) == told(now=0.04, to=0.04) == 1.0
    pressing = [jnp.array([0.0, 0.0, x, -x]) for x in (0.015, 0.02)]
    assert chain.invert(*pressing)[-1] == -1.0  # nobody says what the targets have been: the joints are further open


def test_a_continuous_gripper_is_as_far_open_as_it_is_told():
    """Of fingers from 0 and -1 mm to 50 and -60: a quarter is 12.5 and -15.75; -60 is beyond the range."""
    chain = {**ARM, "gripper": Term(actions.ContinuousGripper)}
    out = play(chain, [[0.0, 0.0, a] for a in (-7.0, -1.0, -0.5, 0.0, 9.0)])
    want = [[0.0, -0.001], [0.0, -0.001], [0.0125, -0.01575], [0.025, -0.0305], [0.05, -0.05]]
    np.testing.assert_allclose(out[:, 2:], want, atol=1e-7)


@pytest.mark.parametrize(("home", "action"), [([0.0, -0.001], -1.0), ([0.05, -0.06], 1.0), ([0.0125, -0.01575], -0.5)])
def test_a_continuous_gripper_knows_how_far_open_it_is_at_home(home, action):
    hand = drives(home, -0.05, 0.05, open=[0.05, -0.06], close=[0.0, -0.001])
    chain = actions.Chain({"gripper": Term(actions.ContinuousGripper)}, {"arm": GROUPS["arm"], "gripper": hand})
    np.testing.assert_allclose(chain.home, [action], atol=1e-6)
    none = {"arm": GROUPS["arm"], "gripper": drives([], 0.0, 0.0, open=[], close=[])}
    np.testing.assert_array_equal(actions.Chain({**ARM, "gripper": Term(actions.ContinuousGripper)}, none).home, [0.0, 0.0])


def test_without_a_term_of_its_own_the_gripper_stays_at_home():
    np.testing.assert_array_equal(play(ARM, [[1.0, 0.0]])[0, 2:], np.float32([0.05, -0.05]))


def test_drive_targets_are_the_action_within_the_ranges():
    chain = {"drives": Term(actions.DriveTargets)}
    np.testing.assert_array_equal(play(chain, [[1.0, -9.0, 0.01, 0.2]])[0], np.float32([1.0, -1.5, 0.01, 0.05]))
    np.testing.assert_array_equal(actions.Chain(chain, GROUPS).home, np.float32([0.25, 2.0, 0.05, -0.05]))


def test_a_speed_limit_moves_targets_step_by_step():
    out = play({**ARM, **GRIPPER, "limit": Term(actions.SpeedLimit)}, [[0.1, -2.0, -1.0]] * 2)
    np.testing.assert_allclose(out[0], [0.28, 1.97, 0.02, -0.02], atol=1e-7)
    np.testing.assert_allclose(out[1], [0.30, 1.94, 0.0, -0.001], atol=1e-7)


def test_a_delay_of_two_steps_begins_at_home():
    late = {"delay": Term(actions.Delay, params={"steps": (2, 2)})}
    inputs = [[1.0, 0.0], [2.0, -1.0], [3.0, 0.0], [0.0, 1.0]]
    np.testing.assert_allclose(play({**late, **ARM}, inputs)[2:], play(ARM, inputs)[:2])
    np.testing.assert_allclose(play({**late, **ARM}, inputs)[:2, :2], [[0.25, 2.0]] * 2)
    absolute = {**late, "drives": Term(actions.DriveTargets)}  # the home of drive targets is not zero
    np.testing.assert_allclose(play(absolute, [[1.0, 1.0, 0.0, 0.0]] * 2), [[0.25, 2.0, 0.05, -0.05]] * 2)


def test_a_low_pass_comes_nearer_by_a_constant_share():
    out = play({"smooth": Term(actions.LowPass, params={"time": 0.1, "dt": 0.1 * math.log(2)}), **ARM}, [[2.0, 0.0]] * 3)
    np.testing.assert_allclose(out[:, 0] - 0.25, [0.5, 0.75, 0.875], rtol=1e-6)


def test_actions_that_read_nothing_are_refused():
    with pytest.raises(UserError, match="^none of the actions limit reads the policy's output$"):
        actions.Chain({"limit": Term(actions.SpeedLimit)}, GROUPS)


def delays(steps, hold, number=400, length=60):
    """How late a line's values come, [number, length]: the time goes in."""
    line = Delay(steps, hold)

    def run(key):
        def step(memory, t):
            memory, late = line.step(memory, t)
            return memory, t - late

        return jax.lax.scan(step, line.init(key, jnp.zeros(())), jnp.arange(10.0, 10.0 + length))[1]

    return np.asarray(jax.jit(jax.vmap(run))(jax.random.split(KEY, number)))[:, 10:]


def test_a_delay_is_drawn_once_an_episode():
    late = delays((1, 3), 1.0)
    assert (late == late[:, :1]).all()
    assert [int((late[:, 0] == n).sum()) for n in range(5)] == pytest.approx([0, 133, 133, 133, 0], abs=35)  # 3.7 sigma


def test_a_delay_that_is_not_held_is_drawn_anew():
    late = delays((0, 1), 0.75)
    changes = (late[:, 1:] != late[:, :-1]).mean()  # a quarter of the steps draws, and half of the draws differ
    assert changes == pytest.approx(0.125, abs=0.01) and late.mean() == pytest.approx(0.5, abs=0.05)


def test_a_history_has_the_newest_at_the_end():
    line = History(3)
    memory, seen = line.init(KEY, jnp.array([1.0, 2.0])), []
    for t in (3.0, 4.0):
        memory, value = line.step(memory, jnp.array([t, -t]))
        seen.append(value.tolist())
    assert seen == [[1, 2, 1, 2, 3, -3], [1, 2, 3, -3, 4, -4]]


def test_uniform_pose_fills_its_ranges():
    ranges = {"x": (0.1, 0.3), "y": (-0.2, 0.0), "z": (0.5, 0.5), "roll": (0.0, 0.0), "pitch": (0.0, 0.0), "yaw": (-1.0, 2.0)}
    pos, quat = jax.jit(jax.vmap(lambda key: commands.uniform_pose(key, **ranges)))(jax.random.split(KEY, 2000))
    assert ((pos >= jnp.array([0.1, -0.2, 0.5])) & (pos <= jnp.array([0.3, 0.0, 0.5]))).all()
    yaw = 2 * np.arctan2(quat[:, 3], quat[:, 0])
    assert yaw.min() == pytest.approx(-1, abs=0.01) and yaw.max() == pytest.approx(2, abs=0.01)
    np.testing.assert_allclose(quat[:, 1:3], 0, atol=1e-6)
    np.testing.assert_allclose(pos.mean(axis=0), [0.2, -0.1, 0.5], atol=0.005)


def starts(event, joints, cube, number=2000, **params):
    """The joints and cubes of many draws of an event."""
    start = Start(joint_pos=joints, object_pos_w={"cube": cube, "other": cube}, object_quat_w={})
    after = jax.jit(jax.vmap(lambda k: event(k, start, **params)))(jax.random.split(KEY, number))
    return after.joint_pos, after.object_pos_w["cube"], after.object_pos_w["other"]


def test_joints_are_scaled_one_by_one():
    joints, start = jnp.array([1.0, -2.0, 0.0]), jnp.array([1.0, 2.0, 3.0])
    moved, cubes, _ = starts(events.joints_by_scale, joints, start, low=0.5, high=1.5)
    np.testing.assert_array_equal(cubes, np.tile(start, (2000, 1)))
    np.testing.assert_allclose(moved.min(axis=0), [0.5, -3.0, 0.0], atol=0.01)
    np.testing.assert_allclose(moved.max(axis=0), [1.5, -1.0, 0.0], atol=0.01)
    assert abs(np.corrcoef(moved[:, 0], moved[:, 1])[0, 1]) < 0.1


def test_uniform_position_fills_its_box():
    box = {"x": (0.3, 0.35), "y": (-0.2, 0.2), "z": (0.2, 0.2)}
    points = jax.jit(jax.vmap(lambda k: commands.uniform_position(k, **box)))(jax.random.split(KEY, 2000))
    low, high = np.float32([0.3, -0.2, 0.2]), np.float32([0.35, 0.2, 0.2])
    assert (points >= low).all() and (points <= high).all()
    np.testing.assert_allclose(points.min(0), low, atol=0.002)
    np.testing.assert_allclose(points.max(0), high, atol=0.002)
    np.testing.assert_allclose(points.mean(0), (low + high) / 2, atol=0.01)


@pytest.mark.parametrize("name", ["cube", "other"])
def test_object_event_places_one_object(name):
    box = {"x": (0.3, 0.4), "y": (-0.1, 0.2), "z": (0.0, 0.1)}
    joints, start = jnp.array([1.0, 2.0]), jnp.array([0.7, 0.6, 0.015])  # it rests at 15 mm
    same, *objects = starts(events.object_position_uniform, joints, start, **box, object=name)
    placed, left = objects if name == "cube" else objects[::-1]
    assert (same == joints).all() and (left == start).all()
    np.testing.assert_allclose(placed.min(0), [0.3, -0.1, 0.015], atol=0.001)
    np.testing.assert_allclose(placed.max(0), [0.4, 0.2, 0.115], atol=0.001)


def test_one_joint_is_turned():
    joints, start = jnp.array([1.0, 2.0]), jnp.array([0.2, 0.0, 0.015])
    moved, cubes, _ = starts(events.joint_turned, joints, start, joint=1, by=(-0.3, 0.1))
    assert (cubes == start).all() and (moved[:, 0] == 1.0).all()
    np.testing.assert_allclose([moved[:, 1].min(), moved[:, 1].max()], [1.7, 2.1], atol=0.001)


@pytest.mark.parametrize(("count", "weight"), [(0, -1e-4), (10_000, -1e-4), (10_001, -0.1), (20_000, -0.1)])
def test_step_weight(count, weight):
    got = curriculum.step_weight(jnp.asarray(count), None, -1e-4, to=-0.1, num_steps=10_000)
    assert float(got) == np.float32(weight)


@pytest.mark.parametrize(("level", "weight"), [(0.0, -1.0), (0.5, -5.5), (1.0, -10.0), (None, -10.0)])
def test_level_weight(level, weight):
    change = {"speed": Term(curriculum.level_weight, params={"start": -1.0})}
    recall = terms.Recall({} if level is None else {LEVEL: jnp.asarray(level)})
    group = {"speed": RewardTerm(rewards.joint_vel_l2, weight=-10.0)}
    out = terms.rewards(group, change, view(), jnp.asarray(0), 0.02, recall)
    assert float(out["speed"]) == pytest.approx(0.02 * weight * 13.0, rel=1e-6)


def test_rewards_fold_weighs_scales_by_time_and_follows_the_curriculum():
    group = {
        "near": RewardTerm(rewards.object_ee_distance, weight=2.0, params={"std": 0.05}),
        "speed": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
    }
    change = {"speed": Term(curriculum.step_weight, params={"to": -1e-1, "num_steps": 10})}
    for count, speed_weight in [(10, -1e-4), (11, -1e-1)]:
        out = terms.rewards(group, change, view(), jnp.asarray(count), 0.02, RECALL)
        assert list(out) == ["near", "speed"]
        assert float(out["near"]) == pytest.approx(0.02 * 2.0 * (1 - TANH_1), rel=1e-4)
        assert float(out["speed"]) == pytest.approx(0.02 * speed_weight * 13.0, rel=1e-6)
    assert float(terms.rewards(group, {}, view(), jnp.asarray(11), 0.02, RECALL)["speed"]) == pytest.approx(
        -1e-4 * 13 * 0.02, rel=1e-6
    )


EXACT = {
    "b": ObservationGroup(
        {"command": ObservationTerm(observations.command), "actions": ObservationTerm(observations.last_action)}
    ),
    "a": ObservationGroup(
        {"actions": ObservationTerm(observations.last_action), "command": ObservationTerm(observations.command)}
    ),
}
NOISY = {
    "state": ObservationGroup(
        {
            "joint_pos": ObservationTerm(observations.joint_pos_rel, noise=0.01),
            "command": ObservationTerm(observations.command),
            "joint_vel": ObservationTerm(observations.joint_vel_rel, noise=0.1),
        }
    ),
    "privileged_state": ObservationGroup({"joint_pos": ObservationTerm(observations.joint_pos_rel, noise=0.01)}),
}
QUIET = {name: dataclasses.replace(group, corruption=False) for name, group in NOISY.items()}


def test_observe_concatenates_in_the_order_of_the_config():
    out = terms.observe(EXACT, view(), view(), KEY, RECALL)
    assert list(out) == ["b", "a"]
    np.testing.assert_allclose(out["b"], [0, 0, 0.3, 0.5, -1, 2], atol=1e-7)
    np.testing.assert_allclose(out["a"], [0.5, -1, 2, 0, 0, 0.3], atol=1e-7)


def test_noise_keeps_its_bounds_and_is_independent():
    exact = np.array([0.25, -0.5, 0, 0, 0.3, 2, -3], np.float32)
    off = terms.observe(QUIET, view(), view(), KEY, RECALL)
    np.testing.assert_array_equal(off["state"], exact)
    np.testing.assert_array_equal(off["privileged_state"], exact[:2])

    draws = jax.jit(jax.vmap(lambda k: terms.observe(NOISY, view(), view(), k, RECALL)))(jax.random.split(KEY, 4000))
    noise = np.asarray(draws["state"]) - exact
    assert (noise[:, 2:5] == 0).all()  # no noise asked for
    bounds = np.array([0.01, 0.01, 0.1, 0.1])
    noise = noise[:, [0, 1, 5, 6]]
    assert (np.abs(noise) <= bounds + 3e-7).all()  # 3e-7: rounding of the sum
    np.testing.assert_allclose(noise.min(0), -bounds, rtol=0.01)
    np.testing.assert_allclose(noise.max(0), bounds, rtol=0.01)
    np.testing.assert_allclose(noise.std(0), bounds / math.sqrt(3), rtol=0.05)  # uniform
    other_group = np.asarray(draws["privileged_state"]) - exact[:2]
    correlation = np.corrcoef(np.hstack([noise, other_group]).T) - np.eye(6)
    assert np.abs(correlation).max() < 0.08  # 5 sigma of 4,000 independent draws


def always(view: View, *, hit: bool):
    return jnp.asarray(hit)


@pytest.mark.parametrize(
    ("fails", "times_out", "terminated", "truncated"),
    [(False, False, False, False), (True, False, True, False), (False, True, False, True), (True, True, True, False)],
)
def test_termination_takes_precedence_over_truncation(fails, times_out, terminated, truncated):
    dones = {"out": DoneTerm(always, params={"hit": times_out}, time_out=True), "fall": DoneTerm(always, params={"hit": fails})}
    for order in (dones, dict(reversed(dones.items()))):
        got = terms.terminations(order, view(), RECALL)
        assert (bool(got[0]), bool(got[1])) == (terminated, truncated)


def test_any_of_several_terms_ends_the_episode():
    dones = {n: DoneTerm(always, params={"hit": n == "b"}) for n in "abc"}
    assert bool(terms.terminations(dones, view(), RECALL)[0])
    assert not any(bool(x) for x in terms.terminations({}, view(), RECALL))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda: RewardTerm(rewards.object_ee_distance, weight=1.0),
            "object_ee_distance takes the parameters std, object; given: none",
        ),
        (
            lambda: RewardTerm(rewards.object_ee_distance, weight=1.0, params={"sdt": 1.0}),
            "object_ee_distance takes the parameters std, object; given: sdt",
        ),
        (
            lambda: RewardTerm(rewards.object_goal_distance, weight=1.0, params={"std": 0.1}),
            "object_goal_distance takes the parameters std, minimal_height, object; given: std",
        ),
        (lambda: ObservationTerm(observations.command, params={"x": 1}), "command takes the parameters none; given: x"),
        (lambda: DoneTerm(terminations.object_below), "object_below takes the parameters minimum_height, object; given: none"),
        (
            lambda: CommandTerm(commands.uniform_position, params={"x": (0, 1)}),
            "uniform_position takes the parameters x, y, z; given: x",
        ),
        (
            lambda: Term(success.ee_at_goal, params={"at": 1.0}),
            "ee_at_goal takes the parameters threshold; given: at",
        ),
        (lambda: Term(commands.circle, params={"radius": 1.0}), "circle takes the parameters radius, frequency; given: radius"),
        (lambda: Term(curriculum.step_weight, params={"to": 1.0}), "step_weight takes the parameters to, num_steps; given: to"),
    ],
)
def test_wrong_parameters_are_refused_when_the_term_is_made(make, message):
    with pytest.raises(UserError, match=f"^{message}$"):
        make()


@pytest.mark.parametrize(
    ("value", "got"),
    [(jnp.zeros(3), "an array of shape \\(3,\\)"), (None, "None"), ("much", "'much'"), (jnp.zeros((1, 1)), "\\(1, 1\\)")],
)
def test_what_a_term_must_return(value, got):
    """The message names the term: an array would be broadcast, or fail far from here."""
    recall = terms.Recall({})
    mine = terms.RewardTerm(lambda seen: value, weight=1.0)
    with pytest.raises(UserError, match=f"rewards.mine must return a number for one environment, got .*{got}"):
        terms.rewards({"mine": mine}, {}, view(), jnp.array(0), 0.02, recall)
    done = terms.DoneTerm(lambda seen: value)
    with pytest.raises(UserError, match=f"terminations.mine must return a number for one environment, got .*{got}"):
        terms.terminations({"mine": done}, view(), recall)


def test_what_an_observation_must_return():
    group = terms.ObservationGroup({"mine": terms.ObservationTerm(lambda seen: jnp.zeros((2, 2)))}, corruption=False)
    with pytest.raises(UserError, match=r"the observation mine must return a vector .*, got an array of shape \(2, 2\)"):
        terms.observe({"state": group}, view(), view(), KEY, terms.Recall({}))


def test_an_error_within_a_term_names_it():
    with pytest.raises(ZeroDivisionError) as error:
        terms.rewards({"mine": terms.RewardTerm(lambda seen: 1 / 0, weight=1.0)}, {}, view(), jnp.array(0), 0.02, RECALL)
    assert error.value.__notes__ == ["in the term rewards.mine"]
