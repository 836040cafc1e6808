"""Terms about fixtures' joints, with values by hand."""

import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import views
from views import STILL

from mjx_nero.mdp import commands, fixtures, randomization
from mjx_nero.mdp.fixtures import Handle
from mjx_nero.mdp.randomization import Model
from mjx_nero.types import FixtureStart, FixtureView, Start, View

DOOR = Handle("cabinet", "door", "bar", target=1.0, lever=0.2)
KNOB = Handle("cabinet", "door", "bar", lever=0.2)  # where the command says


def seen(at=0.5, ee=(0.4, 0.0, 0.3), turn=STILL, command=0.0, fingers=(0.0, 0.0), upper=2.0, speed=0.0) -> View:
    """A handle at (0.4, 0.3, 0.3), its joint at ``at``, and a hand with two fingers that close from 0.04 to 0."""
    fixture = FixtureView(
        pos_w=jnp.zeros(3),
        quat_w=STILL,
        joint_pos={"door": jnp.array(at)},
        joint_vel={"door": jnp.array(speed)},
        joint_range={"door": jnp.array([0.0, upper])},
        site_pos_w={"bar": jnp.array([0.4, 0.3, 0.3])},
        site_quat_w={"bar": STILL},
    )
    return views.blank(
        ctrl=jnp.array([0.7, *fingers]),
        ee_pos_w=jnp.array(ee),
        ee_quat_w=jnp.asarray(turn),
        command=jnp.array([command, 0.0, 0.0]),
        fixtures={"cabinet": fixture},
    )


def about(axis: int, degrees: float):
    half = math.radians(degrees) / 2
    return jnp.array([math.cos(half), *(math.sin(half) * np.eye(3)[axis])])


def test_ways_and_success_of_an_opening():
    """Half a radian short of one, at 0.2 m/rad: 10 cm. Beyond the target nothing is left."""
    assert float(fixtures.opening_way(seen(0.5), handle=DOOR)) == pytest.approx(0.1)
    assert float(fixtures.opening_way(seen(1.3), handle=DOOR)) == 0.0
    assert not fixtures.opened(seen(0.99), handle=DOOR) and fixtures.opened(seen(1.01), handle=DOOR)
    np.testing.assert_allclose([fixtures.opening(seen(at), handle=DOOR) for at in (-0.1, 0.25, 3.0)], [0.0, 0.25, 1.0])
    assert [float(fixtures.is_opened(seen(at), handle=DOOR)) for at in (0.9, 1.1)] == [0.0, 1.0]


def test_a_target_may_be_a_share_of_the_drawn_limit():
    most = Handle("cabinet", "door", "bar", target=0.8, share=True)
    assert float(fixtures.target(seen(upper=0.2), most)) == pytest.approx(0.16)
    assert fixtures.opened(seen(0.15, upper=0.18), handle=most) and not fixtures.opened(seen(0.15, upper=0.2), handle=most)


def test_ways_and_success_of_a_commanded_turn():
    """From 0.5 to the command -0.25: 0.75 rad, 15 cm at 0.2 m/rad, on either side."""
    assert float(fixtures.turning_way(seen(0.5, command=-0.25), handle=KNOB)) == pytest.approx(0.15)
    assert fixtures.turned(seen(0.5, command=0.45), handle=KNOB, within=0.06)
    assert not fixtures.turned(seen(0.5, command=0.57), handle=KNOB, within=0.06)
    assert float(fixtures.turning(seen(0.5, command=0.0), handle=KNOB, std=0.25)) == pytest.approx(1 - math.tanh(2.0), rel=1e-5)
    assert float(fixtures.is_turned(seen(0.5, command=0.5), handle=KNOB, within=0.06)) == 1.0
    np.testing.assert_allclose(fixtures.joint(seen(0.5, command=-0.25), handle=KNOB), [0.5, -0.75])
    np.testing.assert_allclose(fixtures.joint_velocity(seen(speed=-0.3), handle=KNOB), [-0.3])


def test_the_hand_and_the_handle():
    """30 cm beside it. Turned by 170 degrees about the way in, x, it is 10 degrees from the grip's other half turn."""
    np.testing.assert_allclose(fixtures.ee_to_handle(seen(), handle=DOOR), [0.0, 0.3, 0.0], atol=1e-6)
    assert float(fixtures.handle_distance(seen(), handle=DOOR, std=0.3)) == pytest.approx(1 - math.tanh(1.0), rel=1e-5)
    for turn, wanted in ((about(2, 40), [0, 0, -40]), (about(0, 170), [10, 0, 0])):
        found = fixtures.turn_to_handle(seen(turn=turn), handle=DOOR)
        np.testing.assert_allclose(np.degrees(found), wanted, atol=1e-3)
    angle = math.radians(40)
    reward = fixtures.handle_turn(seen(turn=about(2, 40)), handle=DOOR, std=angle)
    assert float(reward) == pytest.approx(1 - math.tanh(1.0), rel=1e-4)


def test_gripping_pays_for_closing_at_the_handle_alone():
    fingers = {"open": (0.04, -0.04), "close": (0.0, 0.0)}
    at, away = (0.4, 0.27, 0.3), (0.4, 0.2, 0.3)
    for ee, targets, wanted in (
        (at, (0.01, -0.01), 0.75),
        (at, (0.04, -0.04), 0.0),
        (at, (0.0, 0.0), 1.0),
        (away, (0.0, 0.0), 0.0),
    ):
        found = fixtures.gripping(seen(ee=ee, fingers=targets), handle=DOOR, near=0.04, **fingers)
        assert float(found) == pytest.approx(wanted, abs=1e-6)


def test_moved_remembers_a_motion_in_the_hand():
    metric, at, away = fixtures.Moved(handle=DOOR, speed=0.1, near=0.04), (0.4, 0.3, 0.3), (0.4, 0.1, 0.3)
    memory = metric.init(jax.random.PRNGKey(0), seen())
    for view, wanted in ((seen(ee=away, speed=1.0), 0), (seen(ee=at, speed=0.05), 0), (seen(ee=at, speed=-0.2), 1), (seen(), 1)):
        memory, value = metric.step(memory, view)
        assert bool(value) == bool(wanted)


def test_resets_move_the_fixture_and_its_joint():
    begin = {"cabinet": FixtureStart(jnp.array([0.5, 0.1, 0.2]), STILL, {"door": jnp.zeros(()), "drawer": jnp.zeros(())})}
    start = Start(joint_pos=jnp.zeros(1), object_pos_w={}, object_quat_w={}, fixtures=begin)

    def drawn(key):
        k_stand, k_joint = jax.random.split(key)
        moved = fixtures.stand_uniform(k_stand, start, fixture="cabinet", x=(-0.1, 0.0), y=(0.2, 0.3), yaw=(-0.5, 0.5))
        return fixtures.joint_uniform(k_joint, moved, fixture="cabinet", joint="door", position=(0.1, 0.2)).fixtures["cabinet"]

    found = jax.jit(jax.vmap(drawn))(jax.random.split(jax.random.PRNGKey(0), 500))
    assert found.pos_w[:, 0].min() >= 0.4 and found.pos_w[:, 0].max() <= 0.5
    assert found.pos_w[:, 1].min() >= 0.3 - 1e-6 and found.pos_w[:, 1].max() <= 0.4 + 1e-6
    np.testing.assert_allclose(found.pos_w[:, 2], 0.2)
    yaw = 2 * np.arctan2(found.quat_w[:, 3], found.quat_w[:, 0])
    assert -0.5 <= yaw.min() < -0.45 and 0.45 < yaw.max() <= 0.5
    door = found.joint_pos["door"]
    assert 0.1 <= door.min() < 0.11 and 0.19 < door.max() <= 0.2 and not found.joint_pos["drawer"].any()


def test_commands_to_either_side():
    found = jax.jit(jax.vmap(lambda key: commands.either_side(key, size=(0.5, 1.0))))(
        jax.random.split(jax.random.PRNGKey(0), 400)
    )
    assert not found[:, 1:].any()
    sides = np.array(found[:, 0])
    assert 0.5 <= np.abs(sides).min() < 0.52 and 0.98 < np.abs(sides).max() <= 1.0 and 150 < (sides > 0).sum() < 250


def test_passive_joints_are_scaled_and_the_rest_stays():
    fields = {
        "dof_damping": jnp.array([1.0, 2.0]),
        "dof_frictionloss": jnp.array([3.0, 4.0]),
        "dof_armature": jnp.array([5.0, 6.0]),
        "jnt_range": jnp.array([[-1.0, 1.0], [0.0, 0.2]]),
    }
    model = Model(fields, {"dof": {"arm": 0, "cabinet/drawer": 1}, "joint": {"arm": 0, "cabinet/drawer": 1}})
    params = {"joints": ("cabinet/drawer",), "friction": (2.0, 2.0), "upper": (0.5, 0.5)}
    drawn = randomization.passive_joints(jax.random.PRNGKey(0), model, **params)
    assert set(drawn) == {"dof_frictionloss", "jnt_range"}
    (rows, friction), (joints, limits) = drawn["dof_frictionloss"], drawn["jnt_range"]
    assert rows.tolist() == [1] and joints.tolist() == [1]
    np.testing.assert_allclose(friction, [8.0])
    np.testing.assert_allclose(limits, [[0.0, 0.1]])
