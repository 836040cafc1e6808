"""Terms of tasks with several objects, and of poses on the table, against numbers worked out by hand."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_terms import view

from mjx_nero import UserError
from mjx_nero.mdp import events, observations, randomization, rewards, success, terminations
from mjx_nero.types import Start

NAMES = ("a", "b", "c", "d", "e")
WAY = {"x": (0.3, 0.4), "y": (-0.1, 0.2), "pitch": 0.1, "jitter": 0.02, "away": (4.0, -4.0)}
TANH_1 = 0.76159416
HALF = 0.5**0.5


def start() -> Start:
    """Five objects, 1 to 5 cm above the table; the last lies on its side."""
    heights = {name: jnp.array([9.0, 9.0, 0.01 * (i + 1)]) for i, name in enumerate(NAMES)}
    turns = {name: jnp.array([HALF, 0.0, HALF, 0.0] if name == "e" else [1.0, 0.0, 0.0, 0.0]) for name in NAMES}
    return Start(jnp.zeros(2), heights, turns)


@pytest.fixture(scope="module")
def scattered():
    """A thousand starts with two to four of the five."""
    scatter = jax.jit(jax.vmap(lambda key: events.scatter(key, start(), objects=NAMES, count=(2, 4), **WAY)))
    return jax.jit(scatter)(jax.random.split(jax.random.PRNGKey(0), 1000))


def test_scattered_objects_are_never_in_one_another(scattered):
    at = np.stack([scattered.object_pos_w[name] for name in NAMES], axis=1)
    np.testing.assert_allclose(at[:, :, 2], np.tile(0.01 * np.arange(1, 6), (1000, 1)), atol=1e-7)  # as high as they were
    there = np.abs(at[:, :, 0]) < 2
    apart = np.linalg.norm(at[:, :, None, :2] - at[:, None, :, :2], axis=-1)
    apart[:, range(5), range(5)] = 1.0
    assert apart.min() >= 0.06 - 1e-6  # pitch less twice the jitter
    parked = np.array([[4.0 + 0.1 * i, -4.0] for i in range(5)])
    np.testing.assert_allclose(np.where(there[:, :, None], 0.0, at[:, :, :2] - parked), 0.0, atol=1e-6)
    assert set(there.sum(axis=1)) == {2, 3, 4}
    assert (np.bincount(there.sum(axis=1))[2:] > 270).all()  # a third of 1,000 each, give or take four deviations
    assert (there.sum(axis=0) > 530).all()  # 600 each, likewise


def test_the_commanded_one_lies_in_the_box_and_the_others_around_it(scattered):
    at = np.stack([scattered.object_pos_w[name] for name in NAMES], axis=1)[:, :, :2]
    target = np.asarray(scattered.target)
    assert (np.bincount(target, minlength=5) > 145).all()  # 200 each
    commanded = at[np.arange(1000), target]
    low, high = commanded.min(axis=0), commanded.max(axis=0)
    np.testing.assert_allclose([low, high], [[0.3, -0.1], [0.4, 0.2]], atol=2e-3)
    assert (low >= [0.3, -0.1]).all() and (high <= [0.4, 0.2]).all()
    off = np.abs(at - commanded[:, None])[np.abs(at[:, :, 0]) < 2]
    assert off.max() <= 0.12 + 1e-6 and (off.max(axis=1)[off.max(axis=1) > 0] > 0.08 - 1e-6).all()


def test_scattered_objects_are_turned_about_the_vertical_alone(scattered):
    for name in NAMES:
        w, x, y, z = np.asarray(scattered.object_quat_w[name]).T
        up = 1 - 2 * (x * x + y * y)  # of the object's own z axis
        np.testing.assert_allclose(up, 0.0 if name == "e" else 1.0, atol=1e-6)
        if name != "e":
            yaw = 2 * np.arctan2(z, w)
            assert abs(np.mean(np.exp(1j * yaw))) < 0.13  # four deviations of the mean of 1,000 directions


@pytest.mark.parametrize(("objects", "count"), [(NAMES, (0, 3)), (NAMES, (2, 6)), (tuple("abcdefghij"), (1, 2))])
def test_more_than_can_be_scattered_is_refused(objects, count):
    with pytest.raises(UserError, match="scatter takes up to 9 objects and a count from 1 to their number, got "):
        events.scatter(jax.random.PRNGKey(0), start(), objects=objects, count=count, **WAY)


def test_objects_are_seen_only_so_far():
    """The cube is (-0.03, -0.04, 0) from the grasp point; the other, at twice its place, (0.97, 1.96, 3.2): 3.876 m."""
    seen = observations.ee_to_objects(view(), objects=("cube", "other"), limit=0.5)
    far = math.sqrt(0.97**2 + 1.96**2 + 3.2**2)
    np.testing.assert_allclose(seen, [-0.03, -0.04, 0.0, *(0.5 * np.array([0.97, 1.96, 3.2]) / far)], atol=1e-5)


@pytest.mark.parametrize(("x", "left"), [(1.0, False), (1.49, False), (1.51, True), (2.9, True), (3.1, False)])
def test_objects_leave_the_table_unless_they_are_parked(x, left):
    """A table from 0.5 to 1.5 along x and 1 to 3 along y; the other object, at (2 x, 4), is far off by its y."""
    params = {"center": (1.0, 2.0), "size": (1.0, 2.0), "parked": 2.0}
    assert bool(terminations.any_off_table(view(object_pos_w=[x, 2.0, 0.0]), objects=("cube", "other"), **params)) == left
    there = view(object_pos_w=[x, 2.0, 0.0])
    assert bool(terminations.any_off_table(there, objects=("other",), **params)) is False


def test_colours_are_bright_and_none_is_green():
    model = randomization.Model({"geom_rgba": jnp.zeros((3, 4))}, {"geom": {"a": 0, "b": 2}})
    draw = jax.jit(jax.vmap(lambda key: randomization.color(key, model, geoms=("b", "a"))["geom_rgba"][1]))
    rows = randomization.color(jax.random.PRNGKey(0), model, geoms=("b", "a"))["geom_rgba"][0]
    np.testing.assert_array_equal(rows, [2, 0])
    rgba = np.asarray(draw(jax.random.split(jax.random.PRNGKey(0), 500))).reshape(-1, 4)
    red, green, blue, alpha = rgba.T
    assert (alpha == 1).all() and (rgba[:, :3].max(axis=1) == pytest.approx(0.85)) and rgba.min() >= 0.2 - 1e-6
    assert (green <= np.maximum(red, blue) + 1e-5).all() and (blue > 0.8).any() and (red > 0.8).any()


# --- poses: the object is upright, turned by 30 degrees, at the goal's place but for 3 cm


def turned(degrees: float) -> list[float]:
    return [math.cos(math.radians(degrees) / 2), 0.0, 0.0, math.sin(math.radians(degrees) / 2)]


def lying(degrees: float = 30.0, off: float = 0.03, quat=None):
    place = {"object_pos_w": [1.0 + off, 2.0, 3.3], "object_quat_w": quat or turned(degrees)}
    return view(**place, goal_pos_w=[1.0, 2.0, 3.3], goal_quat_w=turned(0.0))


@pytest.mark.parametrize(
    ("degrees", "fold", "wanted"),
    [(30, 1, -30), (150, 1, -150), (150, 2, 30), (-100, 2, -80), (100, 4, -10), (45.1, 4, 44.9), (180, 2, 0), (-170, 1, 170)],
)
def test_the_turn_to_the_goal_by_hand(degrees, fold, wanted):
    turn = success.object_turn(lying(degrees), fold=fold)
    np.testing.assert_allclose(np.degrees(turn), [0, 0, wanted], atol=1e-3)
    np.testing.assert_array_equal(observations.object_turn_to_goal(lying(degrees), fold=fold), turn)


def test_a_tipped_object_is_turned_too():
    """On its side, by a right angle about y: none of the turns about its own z axis helps."""
    turn = success.object_turn(lying(quat=[HALF, 0.0, HALF, 0.0]), fold=4)
    assert float(jnp.linalg.norm(turn)) == pytest.approx(math.pi / 2, abs=1e-3)


@pytest.mark.parametrize(
    ("degrees", "off", "there"), [(14, 0.019, True), (16, 0.019, False), (14, 0.021, False), (166, 0.0, True), (164, 0.0, False)]
)
def test_at_a_pose_by_hand(degrees, off, there):
    params = {"threshold": 0.02, "angle": math.radians(15), "fold": 2}
    assert bool(success.object_at_pose(lying(degrees, off), **params)) == there
    assert float(rewards.object_at_pose(lying(degrees, off), **params)) == there


def test_the_reward_of_a_pose_by_hand():
    """3 cm and half a radian off, each its own scale: (1 - tanh 1) squared."""
    reward = rewards.object_goal_pose(lying(math.degrees(0.5)), std=0.03, angle_std=0.5)
    assert float(reward) == pytest.approx((1 - TANH_1) ** 2, rel=1e-3)


@pytest.mark.parametrize(("degrees", "wanted"), [(0, (1, 0)), (90, (0, 1)), (-150, (-0.8660254, -0.5))])
def test_where_an_object_points(degrees, wanted):
    np.testing.assert_allclose(observations.object_heading(lying(degrees)), wanted, atol=1e-6)


def test_an_object_is_turned_from_how_it_lay():
    """About the vertical by a quarter, one that lies on its side: its z axis, along x before, is along y then."""
    turned = events.object_yaw_uniform(jax.random.PRNGKey(0), start(), yaw=(math.pi / 2, math.pi / 2), object="e")
    np.testing.assert_allclose(turned.object_quat_w["e"], [0.5, -0.5, 0.5, 0.5], atol=1e-6)
    np.testing.assert_array_equal(turned.object_quat_w["a"], [1, 0, 0, 0])
