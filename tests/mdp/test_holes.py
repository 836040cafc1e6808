"""Terms of objects that go into holes or over posts, with values by hand."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from views import STILL, blank

from mjx_nero import UserError
from mjx_nero.mdp import fixtures, holes, towers
from mjx_nero.types import FixtureStart, FixtureView, ObjectView, Start, View

# A peg of 6 cm in a hole whose ground is at (0.4, 0.1, 0); the goal says 2 mm farther along x.
PLACE = towers.Place(
    tower=("socket/hole", "peg"),
    rise=0.03,
    within=(0.003, 0.005, math.pi),
    minimal_height=0.045,
    grasp_radius=0.04,
    clearance=0.05,
)
IN, OVER, BESIDE = (0.4, 0.1, 0.03), (0.4, 0.1, 0.07), (0.44, 0.1, 0.05)


def view(peg, hand=(0.0, 0.0, 0.5), fingers=(0.0, 0.0), speed=0.0) -> View:
    at = {"hole": jnp.array([0.4, 0.1, 0.0])}
    socket = FixtureView(at["hole"], STILL, {}, {}, {}, at, {"hole": STILL})
    return blank(
        ee_pos_w=jnp.array(hand),
        objects={"peg": ObjectView(jnp.array(peg), STILL, jnp.array([speed, 0.0, 0.0]), jnp.zeros(3))},
        goal_pos_w=jnp.array([0.402, 0.1, 0.03]),
        fixtures={"socket": socket},
        readings={} if fingers is None else {"fingers": jnp.array(fingers)},
    )


def test_a_fixtures_site_is_the_place_and_not_the_goal():
    np.testing.assert_allclose(holes.to_place(view(BESIDE), place=PLACE), [-0.04, 0.0, -0.02], atol=1e-6)
    assert float(towers.distance(view(OVER), place=PLACE)) == pytest.approx(0.04)
    assert float(towers.standing(view(IN), place=PLACE)) == 1.0 and float(towers.standing(view(OVER), place=PLACE)) == 0.0


@pytest.mark.parametrize(
    ("peg", "way"),
    [
        (OVER, 0.04),  # straight above: the height alone
        (IN, 0.0),
        (BESIDE, 0.04 + 0.02 + 2 * 0.01),  # 4 cm beside, 2 cm up, 1 cm below the top that it has to pass
        ((0.44, 0.1, 0.08), 0.04 + 0.05),  # above the top there is nothing to climb
    ],
)
def test_the_way_down_leads_over_the_top(peg, way):
    held = view(peg, hand=peg)
    found = holes.lowered(held, place=PLACE, top=0.03, std=0.1, flat=0.003)
    assert float(found) == pytest.approx(1 - math.tanh(way / 0.1), abs=1e-5)


def test_what_nobody_holds_earns_nothing_beside_its_place():
    assert float(holes.lowered(view(BESIDE), place=PLACE, top=0.03, std=0.1, flat=0.003)) == 0.0


@pytest.mark.parametrize(
    ("changed", "wanted"),
    [
        ({}, True),
        ({"peg": OVER}, False),
        ({"fingers": (0.0, 0.01)}, False),  # a pad touches something
        ({"hand": (0.4, 0.1, 0.075)}, False),  # 4.5 cm from the peg's middle
        ({"hand": (0.4, 0.1, 0.085)}, True),
        ({"speed": 0.006}, False),
    ],
)
def test_success_is_a_peg_that_is_in_and_left(changed, wanted):
    assert bool(holes.let_be(view(**{"peg": IN, **changed}), place=PLACE, max_speed=0.005)) == wanted


def test_success_needs_fingers_that_feel():
    with pytest.raises(UserError, match="needs 'fingers' among scene.sensors"):
        holes.let_be(view(IN, fingers=None), place=PLACE, max_speed=0.005)


def test_a_fixture_stands_nearly_where_the_goal_says():
    begin = {"socket": FixtureStart(jnp.array([9.0, 9.0, 0.01]), STILL, {})}
    goal = {"goal_pos_w": jnp.array([0.4, 0.1, 0.3]), "goal_quat_w": jnp.array([math.cos(0.2), 0.0, 0.0, math.sin(0.2)])}
    start = Start(joint_pos=jnp.zeros(1), object_pos_w={}, object_quat_w={}, fixtures=begin, **goal)
    keys = jax.random.split(jax.random.PRNGKey(0), 500)
    found = jax.jit(jax.vmap(lambda key: fixtures.stand_at_goal(key, start, fixture="socket", off=0.002, turn=0.1)))(
        keys
    ).fixtures["socket"]
    off = np.array(found.pos_w) - [0.4, 0.1, 0.01]
    assert np.abs(off[:, 2]).max() < 1e-6 and 0.0019 < np.abs(off[:, :2]).max() <= 0.002 + 1e-6
    yaw = 2 * np.arctan2(found.quat_w[:, 3], found.quat_w[:, 0])
    assert 0.3 <= yaw.min() < 0.31 and 0.49 < yaw.max() <= 0.5 + 1e-6
    exact = fixtures.stand_at_goal(keys[0], dataclasses.replace(start), fixture="socket").fixtures["socket"]
    np.testing.assert_allclose(exact.pos_w, [0.4, 0.1, 0.01], atol=1e-6)
