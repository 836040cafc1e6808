"""Terms of a box that is to lie on a commanded side, with values by hand."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from views import blank

from mjx_nero import UserError
from mjx_nero import math as quats
from mjx_nero.mdp import sides
from mjx_nero.mdp.sides import Lying
from mjx_nero.types import ObjectView, Start, View

LYING = Lying(object="box", rest=0.02, within=(0.17, 0.005), minimal_height=0.04, grasp_radius=0.04, clearance=0.05)
X, Z = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def about(axis: int, degrees: float):
    half = math.radians(degrees) / 2
    return jnp.array([math.cos(half), *(math.sin(half) * np.eye(3)[axis])])


def view(quat, height=0.02, side=X, hand=(0.3, 0.0, 0.1), fingers=(0.0, 0.0), told=(0.05, -0.05), spin=0.0) -> View:
    box = ObjectView(jnp.array([0.3, 0.0, height]), jnp.asarray(quat), jnp.zeros(3), jnp.array([0.0, spin, 0.0]))
    return blank(
        ctrl=jnp.array([0.7, *told]),
        ee_pos_w=jnp.array(hand),
        ee_quat_w=about(0, 180),
        objects={"box": box},
        command=jnp.array(side),
        readings={} if fingers is None else {"fingers": jnp.array(fingers)},
    )


@pytest.mark.parametrize(
    ("quat", "side", "degrees"),
    [
        (about(0, 0), X, 90),
        (about(1, -90), X, 0),  # x is turned up about -y
        (about(1, 90), X, 180),
        (about(1, -80), X, 10),
        (about(0, 0), Z, 0),
        (about(2, 33), Z, 0),  # turns about the vertical do not matter
        (about(0, 60), Z, 60),
    ],
)
def test_the_angle_of_the_commanded_side_from_up(quat, side, degrees):
    seen = view(quat, side=side)
    assert float(sides.angle(seen, "box")) == pytest.approx(math.radians(degrees), abs=1e-3)
    assert float(sides.tilt(seen, object="box", lever=0.02)) == pytest.approx(0.02 * math.radians(degrees), abs=1e-4)
    wanted = 1 - math.tanh(math.radians(degrees) / 0.5)
    assert float(sides.turned(seen, object="box", std=0.5)) == pytest.approx(wanted, abs=1e-3)


UP = about(1, -90)


@pytest.mark.parametrize(
    ("changed", "wanted"),
    [
        ({}, True),
        ({"quat": about(1, -79)}, False),
        ({"height": 0.026}, False),
        ({"hand": (0.3, 0.0, 0.06)}, False),
        ({"fingers": (0.1, 0.0)}, False),
        ({"spin": 0.06}, False),
    ],
)
def test_success_is_a_box_that_lies_and_is_left(changed, wanted):
    seen = view(**{"quat": UP, **changed})
    assert bool(sides.turned_up(seen, lying=LYING, max_speed=0.005)) == wanted
    assert float(sides.completed(seen, lying=LYING, max_speed=0.005)) == wanted


def test_success_needs_fingers_that_feel():
    with pytest.raises(UserError, match="needs 'fingers' among scene.sensors"):
        sides.turned_up(view(UP, fingers=None), lying=LYING, max_speed=0.005)


def test_what_is_paid_on_the_way():
    """The hand 8 cm away; then in the hand at 6 cm; then down and let go of by three quarters."""
    far, held = view(about(0, 0)), view(about(1, -85), height=0.06, hand=(0.3, 0.0, 0.06))
    assert float(sides.reached(far, lying=LYING, std=0.08)) == pytest.approx(1 - math.tanh(1.0), rel=1e-5)
    assert float(sides.carried(far, lying=LYING)) == 0.0 and float(sides.carried(held, lying=LYING)) == 1.0
    params = {"lying": LYING, "std": 0.04, "near": 0.3}
    assert float(sides.lowered(held, **params)) == pytest.approx(1 - math.tanh(1.0), rel=1e-5)
    assert float(sides.lowered(view(about(0, 0), height=0.06, hand=(0.3, 0.0, 0.06)), **params)) == 0.0  # not turned yet
    down = view(UP, hand=(0.3, 0.0, 0.06), told=(0.04, -0.04))
    fingers = {"open": (0.05, -0.05), "hold": (0.01, -0.01)}
    assert float(sides.told_to_open(down, lying=LYING, **fingers)) == pytest.approx(0.75)
    assert float(sides.told_to_open(held, lying=LYING, **fingers)) == 0.0
    assert float(sides.left(down, lying=LYING)) == pytest.approx(0.8) and float(sides.standing(down, lying=LYING)) == 1.0


def test_every_command_is_a_side_and_another_side_is_up_at_first():
    keys = jax.random.split(jax.random.PRNGKey(0), 600)
    commands = jax.jit(jax.vmap(sides.any_side))(keys)
    assert len(np.unique(np.asarray(commands), axis=0)) == 6
    start = Start(joint_pos=jnp.zeros(1), object_pos_w={}, object_quat_w={"box": about(0, 0)})

    def laid(key, command):
        base = (0.1, 0.2, 0.3)
        begun = dataclasses.replace(start, goal_pos_w=command + jnp.array(base))
        return sides.other_side_up(key, begun, base=base, yaw=(-0.3, 0.3), object="box").object_quat_w["box"]

    turned = jax.jit(jax.vmap(laid))(keys, commands)
    up = np.asarray(jax.jit(jax.vmap(quats.rotate))(turned, commands))[:, 2]
    assert set(np.round(up, 3)) == {0.0, -1.0} and 0.1 < (up < -0.5).mean() < 0.3  # four sides of five lie level
    level = np.abs(np.asarray(jax.jit(jax.vmap(quats.rotation_matrix))(turned))[:, 2]).max(axis=1)
    np.testing.assert_allclose(level, 1.0, atol=1e-5)  # it lies flat
