"""Terms of towers, and the events that lay their objects out, on hand-made views, against numbers worked out by hand."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import views

from mjx_nero import UserError
from mjx_nero.mdp import commands, events, towers
from mjx_nero.types import ObjectView, Start, View

KEY = jax.random.PRNGKey(0)
TANH_HALF, TANH_1 = 0.46211716, 0.76159416
STRAIGHT, EIGHTH = (1.0, 0.0, 0.0, 0.0), (math.cos(math.pi / 8), 0.0, 0.0, math.sin(math.pi / 8))  # 45 degrees about z


def thing(pos, quat=STRAIGHT, linvel=(0.0, 0.0, 0.0), angvel=(0.0, 0.0, 0.0)) -> ObjectView:
    return ObjectView(*(jnp.array(x, jnp.float32) for x in (pos, quat, linvel, angvel)))


def view(
    red, *, blue=(0.4, 0.1, 0.02), top=(0.0, 0.0, 0.02), hand=(0.0, 0.0, 0.5), fingers=(0.05, -0.05), told=None, goal=STRAIGHT
) -> View:
    """Cubes of 4 cm, by position or whole; the goal is at (0.3, 0, 0.02). Fingers are where they are told to be, or ``told``."""
    given = {"blue": blue, "red": red, "top": top}
    objects = {name: at if isinstance(at, ObjectView) else thing(at) for name, at in given.items()}
    joints = jnp.array([0.7, *fingers])
    return views.blank(
        joint_pos=joints,
        default_joint_pos=joints,
        ctrl=joints if told is None else jnp.array([0.7, *told]),
        ee_pos_w=jnp.array(hand, jnp.float32),
        ee_quat_w=jnp.array([0.0, 1.0, 0.0, 0.0]),
        objects=objects,
        goal_pos_w=jnp.array([0.3, 0.0, 0.02]),
        goal_quat_w=jnp.array(goal, jnp.float32),
    )


WITHIN = (0.02, 0.005, 0.25)


def placed(params: dict) -> dict:
    """The parameters of a term, those of its place in one."""
    fields = {field.name for field in dataclasses.fields(towers.Place)}
    given = {"minimal_height": 0.0, "grasp_radius": 1.0, "clearance": 0.05, "within": WITHIN}
    place = towers.Place(**{**given, **{name: value for name, value in params.items() if name in fields}})
    return {"place": place, **{name: value for name, value in params.items() if name not in fields}}


STACK = {"tower": ("blue", "red"), "rise": 0.04, "within": WITHIN}
THREE = {**STACK, "tower": ("blue", "red", "top")}
PLACE = {**STACK, "tower": ("goal", "red")}
HELD = {"minimal_height": 0.03, "grasp_radius": 0.04}
GRIPPER = {"open": (0.05, -0.05), "hold": (0.02, -0.02), "clearance": 0.05}
RESTING = {"max_speed": 0.005, "clearance": 0.05, "std": 0.1}
WAY = {**HELD, "over": 0.03, "std": 0.05}
ON, LYING, TOP = (0.4, 0.1, 0.06), (0.4, -0.1, 0.02), (0.4, 0.1, 0.1)
IN_HAND = (0.4, -0.1, 0.06)  # 20 cm beside blue, as high as on it
HOLDING, HALF = (0.02, -0.02), (0.035, -0.035)
ABOVE = (0.4, 0.1, 0.09)
ASIDE = (0.4, 0.12, 0.06)


@pytest.mark.parametrize(
    ("func", "params", "at", "value"),
    [
        # The hand 5 cm above the red cube, which lies beside the blue one, or is on it: then it has no need to be near.
        (towers.reached, {**STACK, "std": 0.1}, view(LYING, hand=(0.4, -0.1, 0.07)), 1 - TANH_HALF),
        (towers.reached, {**STACK, "std": 0.1}, view(ON, hand=(0.4, 0.1, 0.11)), 1.0),
        (towers.reached, {**STACK, "std": 0.05}, view(LYING, hand=(0.4, -0.1, 0.07)), 1 - TANH_1),
        # The third cube counts from when the second stands.
        (
            towers.reached,
            {**THREE, "std": 0.1},
            view(LYING, hand=(0, 0, 0.02)),
            1 - math.tanh(math.hypot(4, 1)),
        ),
        (towers.reached, {**THREE, "std": 0.1}, view(ON, hand=(0, 0, 0.07)), 1 + 1 - TANH_HALF),
        # In the hand, let fly, or on the blue one without a hand.
        (towers.carried, {**STACK, **HELD}, view(IN_HAND, hand=(0.4, -0.1, 0.09)), 1.0),
        (towers.carried, {**STACK, **HELD}, view(IN_HAND, hand=(0.4, -0.1, 0.11)), 0.0),
        (towers.carried, {**STACK, **HELD}, view(ON), 1.0),
        # Over its place it may be as low as it likes, and turned, while the hand has it; not 3 cm beside it.
        (towers.carried, {**PLACE, **HELD}, view((0.31, 0.0, 0.028), hand=(0.31, 0.0, 0.028)), 1.0),
        (towers.carried, {**PLACE, **HELD}, view(thing((0.31, 0.0, 0.02), EIGHTH), hand=(0.31, 0.0, 0.02)), 1.0),
        (towers.carried, {**PLACE, **HELD}, view((0.31, 0.0, 0.028)), 0.0),
        (towers.carried, {**PLACE, **HELD}, view((0.33, 0.0, 0.028), hand=(0.33, 0.0, 0.028)), 0.0),
        (towers.carried, {**THREE, **HELD}, view(LYING, top=TOP, hand=TOP), 0.0),  # first the second one
        (towers.carried, {**THREE, **HELD}, view(ON, top=(0.0, 0.0, 0.1), hand=(0.0, 0.0, 0.1)), 2.0),
        # 20 cm beside, and 3 cm too low for the way over: hypot(0.2, 0.03) from there; on the cone at 2 cm beside; at its place.
        (towers.approached, {**STACK, **WAY}, view(IN_HAND, hand=IN_HAND), 1 - math.tanh(math.hypot(4.0, 0.6))),
        (towers.approached, {**STACK, **WAY}, view((0.4, 0.12, 0.08), hand=(0.4, 0.12, 0.08)), 1 - math.tanh(0.4)),
        (
            towers.approached,
            {**STACK, **WAY},
            view((0.4, 0.12, 0.07), hand=(0.4, 0.12, 0.07)),
            1 - math.tanh(0.2**0.5),
        ),
        # Straight down 2 cm beside its place, where the cone ends; where it ends at 1 cm it would still be 1 cm too low.
        (towers.approached, {**STACK, **WAY, "flat": 0.02}, view(ASIDE, hand=ASIDE), 1 - math.tanh(0.4)),
        (towers.approached, {**STACK, **WAY, "flat": 0.01}, view(ASIDE, hand=ASIDE), 1 - math.tanh(0.2**0.5)),
        (towers.approached, {**STACK, **WAY}, view(ON), 1.0),
        (towers.approached, {**STACK, **WAY}, view(LYING, hand=LYING), 0.0),  # pushed along the table it is not held
        (towers.approached, {**STACK, **WAY}, view((0.4, 0.1, 0.09)), 0.0),  # thrown
        # An eighth of a turn from the goal.
        (towers.aligned, {**PLACE, **HELD, "std": math.pi / 4}, view(thing(IN_HAND, EIGHTH), hand=IN_HAND), 1 - TANH_1),
        (towers.aligned, {**PLACE, **HELD, "std": 1.0}, view(thing(IN_HAND, EIGHTH), hand=IN_HAND, goal=EIGHTH), 1.0),
        (towers.aligned, {**PLACE, **HELD, "std": 1.0}, view(thing(LYING, EIGHTH), hand=LYING, goal=EIGHTH), 0.0),
        (towers.standing, STACK, view(ON), 1.0),
        (towers.standing, STACK, view((0.412, 0.115, 0.0645)), 1.0),  # 19.2 mm aside, 4.5 mm high
        (towers.standing, STACK, view((0.413, 0.116, 0.06)), 0.0),  # 20.6 mm
        (towers.standing, STACK, view((0.4, 0.1, 0.0655)), 0.0),
        (towers.standing, THREE, view(ON, top=TOP), 2.0),
        (towers.standing, THREE, view(LYING, top=TOP), 0.0),
        (towers.standing, PLACE, view(thing((0.31, 0.0, 0.02), EIGHTH), goal=EIGHTH), 1.0),
        (towers.standing, PLACE, view(thing((0.31, 0.0, 0.02), EIGHTH)), 0.0),  # turned
        # Told to hold, wherever they are; told to open by a fifth and not moved yet; told to shut; wide open; nothing stands.
        (towers.told_to_open, {**STACK, **GRIPPER}, view(ON, told=HOLDING), 0.0),
        (towers.told_to_open, {**STACK, **GRIPPER}, view(ON, fingers=HOLDING, told=(0.026, -0.026)), 0.2),
        (towers.told_to_open, {**STACK, **GRIPPER}, view(ON, fingers=HOLDING, told=(0.0, 0.0)), 0.0),
        (towers.told_to_open, {**STACK, **GRIPPER}, view(ON), 1.0),
        (towers.told_to_open, {**STACK, **GRIPPER}, view(LYING), 0.0),
        # All stand, wide open; away for the next one with shut fingers; 3 cm away; and at the topmost, which it holds.
        (towers.told_to_open, {**THREE, **GRIPPER}, view(ON, top=TOP), 2.0),
        (towers.told_to_open, {**THREE, **GRIPPER}, view(ON, told=(0.0, 0.0)), 1.0),
        (towers.told_to_open, {**THREE, **GRIPPER}, view(ON, hand=ABOVE, told=(0.026, -0.026)), 0.6),
        (towers.told_to_open, {**THREE, **GRIPPER}, view(ON, top=TOP, hand=TOP, told=HOLDING), 0.8),
        # 3 cm of 5 above it, open by half; holding it; 10 cm beside it, wide open; below it; on a table.
        (towers.left_with_open_fingers, {**STACK, **GRIPPER}, view(ON, hand=ABOVE, fingers=HALF), 0.3),
        (towers.left_with_open_fingers, {**STACK, **GRIPPER}, view(ON, hand=ABOVE, fingers=HOLDING), 0.0),
        (towers.left_with_open_fingers, {**STACK, **GRIPPER}, view(ON, hand=(0.4, 0.2, 0.06)), 1.0),
        (towers.left_with_open_fingers, {**STACK, **GRIPPER}, view(ON, hand=(0.4, 0.1, 0.02)), 0.0),
        (towers.left_with_open_fingers, {**STACK, **GRIPPER}, view(LYING), 0.0),
        (towers.left_with_open_fingers, {**THREE, **GRIPPER}, view(ON, fingers=HOLDING), 1.0),  # it holds the next one
        (towers.left_with_open_fingers, {**THREE, **GRIPPER}, view(ON, hand=ABOVE, fingers=HOLDING), 0.36),
        (towers.left_with_open_fingers, {**THREE, **GRIPPER}, view(ON, top=TOP, fingers=HOLDING), 1.0),
        # At the cube; 3 cm above it; beside it; far below it; as far away as it takes.
        (towers.left, {**STACK, "clearance": 0.05}, view(ON, hand=ON), 0.0),
        (towers.left, {**STACK, "clearance": 0.05}, view(ON, hand=(0.4, 0.1, 0.09)), 0.6),
        (towers.left, {**STACK, "clearance": 0.05}, view(ON, hand=(0.4, 0.07, 0.06)), 0.6),
        (towers.left, {**STACK, "clearance": 0.05}, view(ON, hand=(0.4, 0.1, 0.0)), 0.0),
        (towers.left, {**PLACE, "clearance": 0.05}, view((0.3, 0.0, 0.02), hand=(0.3, 0.0, 0.01)), 0.2),  # on the table
        (towers.left, {**STACK, "clearance": 0.05}, view(ON), 1.0),
        (towers.left, {**STACK, "clearance": 0.05}, view(LYING), 0.0),
        (towers.completed, {**STACK, "max_speed": 0.005, "clearance": 0.05}, view(ON), 1.0),
        (towers.completed, {**STACK, "max_speed": 0.005, "clearance": 0.05}, view(LYING), 0.0),
        # At rest; one of three joints moves at 0.3 rad/s: exp(-0.03 / 0.01); at rest beside a cube that lies elsewhere.
        (towers.rested, {**STACK, **RESTING}, view(ON), 1.0),
        (towers.rested, {**STACK, **RESTING}, dataclasses.replace(view(ON), joint_vel=jnp.array([0.3, 0.0, 0.0])), math.exp(-3)),
        (towers.rested, {**STACK, **RESTING}, view(LYING), 0.0),
        (towers.distance, {"tower": ("blue", "red"), "rise": 0.04}, view((0.43, 0.1, 0.02)), 0.05),
        (towers.distance, {"tower": ("blue", "red", "top"), "rise": 0.04}, view(ON, top=(0.4, 0.16, 0.02)), 0.1),
        (towers.distance, {"tower": ("goal", "red"), "rise": 0.04}, view((0.3, 0.3, 0.02)), 0.3),
    ],
)
def test_rewards_and_distance(func, params, at, value):
    got = func(at, **placed(params))
    assert got.shape == () and got.dtype == jnp.float32
    assert float(got) == pytest.approx(value, abs=2e-5)


BUILT = {**STACK, "max_speed": 0.005, "clearance": 0.05}


@pytest.mark.parametrize(
    ("params", "at", "met"),
    [
        (BUILT, view(ON), True),
        (BUILT, view(LYING), False),
        (BUILT, view(ON, hand=(0.4, 0.1, 0.109)), False),  # not let go of
        (BUILT, view(ON, hand=(0.4, 0.1, 0.111)), True),
        (BUILT, view(ON, hand=(0.4, 0.061, 0.02)), False),  # at the lower one
        (BUILT, view(thing(ON, linvel=(0.003, 0.0, -0.0041))), False),  # 5.1 mm/s
        (BUILT, view(thing(ON, linvel=(0.003, 0.0, -0.0039))), True),
        (BUILT, view(thing(ON, angvel=(0.0, 0.051, 0.0))), False),
        (BUILT, view(ON, blue=thing((0.4, 0.1, 0.02), linvel=(0.0, 0.006, 0.0))), False),  # what is below it slides
        ({**BUILT, "tower": ("goal", "red")}, view((0.315, 0.0, 0.02)), True),
        ({**BUILT, "tower": ("goal", "red")}, view((0.315, 0.0, 0.026)), False),  # on something else
        ({**BUILT, "tower": ("blue", "red", "top")}, view(ON), False),
        ({**BUILT, "tower": ("blue", "red", "top")}, view(ON, top=TOP), True),
    ],
)
def test_built(params, at, met):
    assert bool(towers.built(at, **placed(params))) is met


def test_a_tower_that_is_touched_is_not_left_alone():
    """However far away the grasp point is: an elbow may lean on it."""
    for at, force, met in ((ON, 0.0, True), (ON, 0.01, False), (LYING, 0.0, False)):
        seen = dataclasses.replace(view(at), readings={"hand": jnp.array(force)})
        assert bool(towers.left_alone(seen, **placed(BUILT))) is met
    with pytest.raises(UserError, match=r"towers.left_alone needs 'hand' among scene.sensors"):
        towers.left_alone(view(ON), **placed(BUILT))


def test_ways_and_turns():
    np.testing.assert_allclose(towers.way(view(LYING), below="blue", object="red", rise=0.04), [0.0, 0.2, 0.04], atol=1e-7)
    np.testing.assert_allclose(towers.way(view(LYING), below="goal", object="red", rise=0.04), [-0.1, 0.1, 0.0], atol=1e-7)
    turned = view(thing(LYING, EIGHTH))
    np.testing.assert_allclose(towers.turn_to_goal(turned, object="red"), [0.0, 0.0, -math.pi / 4], atol=1e-6)
    # The hand points down, half a turn about x: what is a turn to the left from above is one to the right for it.
    turn = towers.turn_to_object(turned, object="red", down=(0.0, 1.0, 0.0, 0.0))
    np.testing.assert_allclose(turn, [0.0, 0.0, -math.pi / 4], atol=1e-6)
    straight = view(LYING)
    np.testing.assert_allclose(towers.turn_to_object(straight, object="red", down=(0.0, 1.0, 0.0, 0.0)), [0, 0, 0], atol=1e-6)


def test_rewards_pay_more_for_every_phase_and_nothing_for_shortcuts():
    """Above, in the hand, above the place, at it, opened, away: each is paid more than the one before."""
    over, at = (0.4, 0.1, 0.09), ON
    terms = [
        (towers.reached, {**STACK, "std": 0.1}),
        (towers.carried, {**STACK, **HELD}),
        (towers.approached, {**STACK, **WAY}),
        (towers.standing, STACK),
        (towers.told_to_open, {**STACK, **GRIPPER}),
        (towers.left_with_open_fingers, {**STACK, **GRIPPER}),
        (towers.completed, BUILT),
    ]
    closed = {"fingers": HOLDING}
    phases = [
        view(LYING),
        view(LYING, hand=LYING),
        view(IN_HAND, hand=IN_HAND, **closed),
        view(over, hand=over, **closed),
        view(at, hand=at, **closed),
        view(at, hand=at),
        view(at, hand=(0.4, 0.1, 0.09)),
        view(at),
    ]
    paid = [sum(float(func(phase, **placed(params))) for func, params in terms) for phase in phases]
    assert all(np.diff(paid) > 0.05), paid
    thrown = sum(float(func(view(over), **placed(params))) for func, params in terms)
    assert thrown < paid[1]


# --- where things start


def start() -> Start:
    names = ("a", "b", "c")
    pos = {name: jnp.array([0.0, 0.0, 0.01 * i]) for i, name in enumerate(names)}
    return Start(joint_pos=jnp.zeros(2), object_pos_w=pos, object_quat_w={name: jnp.array(STRAIGHT) for name in names})


@pytest.mark.parametrize(("x", "y", "along"), [((0.3, 0.4), (-0.2, 0.2), 1), ((-0.2, 0.2), (0.1, 0.2), 0)])
def test_objects_start_apart(x, y, along):
    params = {"objects": ("a", "b", "c"), "x": x, "y": y, "apart": 0.15}
    draw = jax.jit(jax.vmap(lambda key: events.objects_apart(key, start(), **params).object_pos_w))
    at = np.stack([draw(jax.random.split(KEY, 2000))[name] for name in "abc"], axis=1)  # [2000, 3 objects, 3]
    np.testing.assert_array_equal(at[:, :, 2], np.broadcast_to(np.float32([0.0, 0.01, 0.02]), (2000, 3)))
    gaps = np.diff(np.sort(at[:, :, along], axis=1), axis=1)
    assert gaps.min() > 0.15 - 1e-6
    for axis, (low, high) in enumerate((x, y)):
        assert (at[:, :, axis] >= low - 1e-6).all() and (at[:, :, axis] <= high + 1e-6).all()
        assert np.ptp(at[:, :, axis]) > 0.97 * (high - low)
    # 10 cm are free; the first of three uniform points on them is at a quarter on average, a gap as long.
    assert (gaps - 0.15).mean() == pytest.approx(0.025, abs=0.002)
    first = np.argmin(at[:, :, along], axis=1)  # which one comes first: each as often
    assert np.bincount(first, minlength=3) == pytest.approx([667] * 3, abs=80)  # 3.8 sigma
    assert abs(np.corrcoef(at[:, 0, along], at[:, 0, 1 - along])[0, 1]) < 0.1


def test_an_object_starts_apart_from_the_goal():
    """Uniform on what is left of the box; where nothing is left, at its far end."""
    goal, box = start().replace(goal_pos_w=jnp.array([0.3, 0.0, 0.5])), {"x": (0.3, 0.4), "y": (-0.2, 0.2), "object": "b"}
    draw = jax.jit(jax.vmap(lambda key: events.object_apart_from_goal(key, goal, apart=0.1, **box).object_pos_w))
    placed = draw(jax.random.split(KEY, 4000))
    at = np.asarray(placed["b"])
    away = np.hypot(at[:, 0] - 0.3, at[:, 1])
    assert away.min() > 0.1 - 1e-6 and (at[:, 2] == np.float32(0.01)).all()
    assert (at[:, 0] >= 0.3 - 1e-6).all() and np.ptp(at[:, 0]) > 0.097 and np.ptp(at[:, 1]) > 0.39
    # Half a disc of 10 cm covers 0.0157 of 0.04 m2; beyond 20 cm along y nothing lies, and beyond 10 cm 0.02 of the 0.0243 left.
    assert (np.abs(at[:, 1]) > 0.1).mean() == pytest.approx(0.02 / (0.04 - np.pi * 0.1**2 / 2), abs=0.025)
    np.testing.assert_array_equal(placed["a"], np.zeros((4000, 3)))
    far = events.object_apart_from_goal(KEY, goal, apart=1.0, **box).object_pos_w["b"]
    assert np.hypot(far[0] - 0.3, far[1]) > 0.15


def test_no_room_for_objects_is_one_line():
    params = {"objects": ("a", "b", "c"), "x": (0.0, 0.1), "y": (-0.1, 0.15), "apart": 0.15}
    with pytest.raises(UserError, match=r"^3 objects 0.15 m apart need 0.3 m, but x \(0.0, 0.1\) and y .* are shorter$"):
        events.objects_apart(KEY, start(), **params)


def test_an_object_is_turned_about_the_vertical():
    lying = start()
    lying = lying.replace(object_quat_w={**lying.object_quat_w, "b": jnp.array([0.5**0.5, 0.5**0.5, 0.0, 0.0])})
    turned = events.object_yaw_uniform(KEY, lying, yaw=(math.pi / 2, math.pi / 2), object="b").object_quat_w
    np.testing.assert_allclose(turned["b"], [0.5, 0.5, 0.5, 0.5], atol=1e-6)  # x, then z: x -> y -> z -> x
    np.testing.assert_array_equal(turned["a"], STRAIGHT)
    draw = jax.jit(jax.vmap(lambda key: events.object_yaw_uniform(key, start(), yaw=(-0.2, 0.4), object="a").object_quat_w["a"]))
    angle = 2 * np.arcsin(np.asarray(draw(jax.random.split(KEY, 500))[:, 3]))
    assert angle.min() == pytest.approx(-0.2, abs=0.01) and angle.max() == pytest.approx(0.4, abs=0.01)


def test_no_goal_is_the_root():
    np.testing.assert_array_equal(commands.nothing(KEY), [0.0, 0.0, 0.0])
