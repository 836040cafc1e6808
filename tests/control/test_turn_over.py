"""The choice of the next turn of a cube: by what its rotation does to the side that has to be up. The task tests the motion."""

from types import SimpleNamespace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import math
from mjx_nero.control.ik import InverseKinematics
from mjx_nero.control.turn_over import ABOVE, TurnOver, TurnOverCfg
from mjx_nero.control.turns import Table, Turns
from mjx_nero.mdp import sides
from mjx_nero.tasks.arms.nero import NERO

LEAN, N = float(np.pi / 4), len(NERO.arm.joints)


@pytest.fixture(scope="module")
def turns():
    return Turns(NERO, InverseKinematics(NERO), (0.35, 0.0, 0.02), LEAN, beyond=0.0, before=0.07, lift=0.05)


def table(fails=None, go=None) -> Table:
    """An arm that can do all, but for what fails."""
    fails = np.zeros((8, 2)) if fails is None else fails
    return Table(jnp.asarray(fails, jnp.float32), jnp.zeros((8, 2, N)), jnp.zeros(8), jnp.full(8, 8.0) if go is None else go)


@pytest.fixture(scope="module")
def then(turns):
    """Where a side looks after the turn, and how far the hand leans before and after it."""
    plan = jax.jit(turns.plan)

    def made(quat, wanted, known=None) -> tuple[np.ndarray, list[float]]:
        found = plan(known or table(), quat, wanted, jnp.zeros(N))
        turn = math.quat_mul(found.end, math.quat_conj(found.grasp))
        return np.asarray(math.rotate(turn, wanted)), [float(jnp.arccos(-turns.into(q)[2])) for q in (found.grasp, found.end)]

    return made


def test_the_hand_leans_where_it_is_told_and_closes_across(turns):
    for angle, flip in ((0.0, 0), (1.0, 1), (-2.0, 0)):
        quat = turns._hand(jnp.array(angle), jnp.array(flip), LEAN)
        into = np.asarray(turns.into(quat))
        np.testing.assert_allclose(into, [np.cos(angle) / 2**0.5, np.sin(angle) / 2**0.5, -(0.5**0.5)], atol=1e-6)
        closes = math.rotate(quat, math.rotate(math.quat_conj(jnp.array(NERO.down)), jnp.array([0.0, 1.0, 0.0])))
        np.testing.assert_allclose(closes, (1 - 2 * flip) * np.array([np.sin(angle), -np.cos(angle), 0.0]), atol=1e-6)


def test_a_level_side_is_up_after_one_turn(then):
    for i, quat in enumerate(sides.cube_turns()[::3]):
        about = math.axis_angle(jnp.array([0.0, 0.0, 1.0]), jnp.array(0.1 * i - 0.3))
        quat = math.quat_mul(about, jnp.asarray(quat))
        for normal in sides.NORMALS:
            wanted = math.rotate(quat, jnp.asarray(normal))
            if abs(float(wanted[2])) < 0.5:
                looks, leans = then(quat, wanted)
                np.testing.assert_allclose(looks, [0.0, 0.0, 1.0], atol=1e-5)
                np.testing.assert_allclose(leans, LEAN, atol=1e-4)


def test_a_side_that_looks_down_is_level_after_one_turn(then):
    looks, _ = then(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([0.0, 0.0, -1.0]))
    assert abs(looks[2]) < 1e-5


def test_where_the_arm_cannot_lean_it_first_makes_the_side_look_elsewhere(then):
    """The side looks away from the robot, so the hand would have to lean towards it, and only away and to the sides it can."""
    fails = np.ones((8, 2))
    fails[[0, 2, 6]] = 0.0  # away, left and right
    go = jnp.asarray(8.0 + 100.0 * np.roll(fails, 4, axis=0).min(axis=1), jnp.float32)
    looks, _ = then(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.array([1.0, 0.0, 0.0]), table(fails, go))
    assert abs(looks[2]) < 1e-5
    assert any(np.allclose(looks[:2], way, atol=1e-5) for way in ((-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)))  # to the robot, or aside


def _on_its_way(count) -> Any:
    return SimpleNamespace(phase=jnp.array(ABOVE), count=count)


def test_a_hand_on_its_way_to_the_cube_passes_over_it():
    """It rises at first, is as high as a lifted cube, and comes down at the end."""
    script, home = TurnOver(NERO, 0.02, TurnOverCfg(rises=0.15)), jnp.asarray(NERO.arm.home)
    place = jax.jit(lambda q: script._ik.chain.poses(q)[0][0])
    above = jax.jit(lambda count, end: script._above(_on_its_way(count), home, end, place(home)))
    for count, left, rises in ((0, 1.0, 0.0), (4, 1.0, 0.02), (50, 1.0, 0.06), (50, 0.2, 0.03), (50, 0.0, 0.0)):
        q = above(jnp.array(count), home.at[0].add(left))
        assert float(place(q)[2] - place(home)[2]) == pytest.approx(rises, abs=2e-3)
