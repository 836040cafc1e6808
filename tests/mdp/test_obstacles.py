"""What stands between start and goal: in the way, out of both their rooms, and within its own bounds."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from test_terms import view

from mjx_nero import UserError
from mjx_nero.mdp import obstacles

PARAMS = {"thickness": (0.02, 0.04), "width": (0.2, 0.3), "above": (0.0, 0.05), "top": 0.4, "room": 0.12}
# From the grasp point 0.5 m along a 3-4-5 triangle to the goal; the foot at (1, 2, 0).
START, GOAL = np.array([1.0, 2.0, 0.2]), np.array([1.3, 2.4, 0.3])
ALONG, SIDE = np.array([0.6, 0.8, 0.0]), np.array([-0.8, 0.6, 0.0])
N = 500


def drawn(kind: str, goal=GOAL, **changes):
    """Centres and edges [n, 2, 3] of both boxes, in the frame of the way."""
    at = view(ee_pos_w=START, goal_pos_w=goal, root_pos_w=[1.0, 2.0, 0.0])
    params = {**PARAMS, "kinds": (kind,), **changes}
    boxes = jax.jit(jax.vmap(lambda key: obstacles.across(key, at, **params)))(jax.random.split(jax.random.PRNGKey(0), N))
    pos = np.stack([boxes[name].pos_w for name in ("one", "two")], axis=1)
    size = np.stack([boxes[name].size for name in ("one", "two")], axis=1)
    # Turned about z to face the way: its angle is that of 3-4-5.
    half = np.arctan2(0.8, 0.6) / 2
    np.testing.assert_allclose(boxes["one"].quat_w, np.tile([np.cos(half), 0, 0, np.sin(half)], (N, 1)), atol=1e-6)
    local = np.stack([(pos - START) @ axis for axis in (ALONG, SIDE)] + [pos[..., 2]], axis=-1)
    return local, size


def line(along):
    """Height of the straight way."""
    return 0.2 + 0.1 * along / 0.5


def is_parked(local, size):
    return (local[..., 2] == -0.5) & (size == np.float32(0.05)).all(-1)


def test_a_wall_stands_on_the_table_across_the_way():
    local, size = drawn("wall")
    (wall, other), (edges, small) = np.moveaxis(local, 1, 0), np.moveaxis(size, 1, 0)
    assert is_parked(other, small).all()
    np.testing.assert_allclose(wall[:, 2], edges[:, 2] / 2, atol=1e-6)
    np.testing.assert_allclose(wall[:, 1], 0.0, atol=1e-6)
    over = edges[:, 2] - line(wall[:, 0])
    assert -1e-6 < over.min() < 0.005 and 0.045 < over.max() < 0.05 + 1e-6
    assert (wall[:, 0] - edges[:, 0] / 2).min() > 0.12 - 1e-6 and (wall[:, 0] + edges[:, 0] / 2).max() < 0.38 + 1e-6
    for axis, (low, high) in ((0, PARAMS["thickness"]), (1, PARAMS["width"])):
        assert low <= edges[:, axis].min() < low + 0.1 * (high - low) and high >= edges[:, axis].max() > high - 0.1 * (high - low)


def test_a_bar_is_a_wall_without_its_lower_part():
    local, size = drawn("bar")
    np.testing.assert_allclose(size[:, 0, 2], size[:, 0, 0], atol=1e-6)
    over = local[:, 0, 2] + size[:, 0, 2] / 2 - line(local[:, 0, 0])
    assert -1e-6 < over.min() and over.max() < 0.05 + 1e-6
    assert is_parked(local[:, 1], size[:, 1]).all()


def test_posts_stand_at_either_side():
    local, size = drawn("posts")
    np.testing.assert_allclose(local[:, 0, 1], -local[:, 1, 1], atol=1e-6)
    gap = local[:, 1, 1] - local[:, 0, 1]
    assert 0.1 <= gap.min() and gap.max() <= 0.3
    np.testing.assert_allclose(local[..., 2], size[..., 2] / 2, atol=1e-6)
    np.testing.assert_allclose(size[..., 0], size[..., 1], atol=1e-6)


def test_a_shelf_is_below_the_goal_and_shut_towards_the_start():
    local, size = drawn("shelf")
    (board, end), (wide, upright) = np.moveaxis(local, 1, 0), np.moveaxis(size, 1, 0)
    below = 0.3 - (board[:, 2] + wide[:, 2] / 2)
    assert 0.06 <= below.min() and below.max() <= 0.1 + 1e-6
    assert (board[:, 0] - wide[:, 0] / 2 < 0.5 - 0.119).all() and (board[:, 0] + wide[:, 0] / 2 > 0.5 + 0.119).all()
    np.testing.assert_allclose(end[:, 0] + upright[:, 0] / 2, 0.5 - 0.12, atol=1e-6)
    np.testing.assert_allclose(end[:, 2], upright[:, 2] / 2, atol=1e-6)
    assert (upright[:, 2] > board[:, 2]).all()


def test_every_length_of_an_obstacle_is_drawn_by_itself():
    """No two of what differs from draw to draw go together, but what follows from one another."""
    local, size = drawn("shelf")
    board, top, thick, wide = local[:, 0, 2], size[:, 1, 2], size[:, 1, 0], size[:, 1, 1]
    posts, edges = drawn("posts")
    share = (posts[:, 1, 1] - posts[:, 0, 1]) / 2 / 0.25  # of the widths, which posts do not show
    over = edges[:, 0, 2] - line(posts[:, 0, 0])
    for name, each in {"shelf": (board, top, thick, wide), "posts": (share, over, edges[:, 0, 0], posts[:, 0, 0])}.items():
        together = np.corrcoef(np.stack(each)) - np.eye(len(each))
        assert np.abs(together).max() < 0.15, (name, together)  # of 500 independent pairs, 0.045 is one deviation
    assert all(each.std() > 0.005 for each in (board, top, over))


def test_nothing_is_higher_than_the_top():
    for kind in ("wall", "bar", "posts"):
        local, size = drawn(kind, top=0.22)
        assert (local[..., 2] + size[..., 2] / 2).max() <= 0.22 + 1e-6


def test_nothing_stands_where_there_is_no_room():
    near = START + 0.25 * ALONG  # two rooms of 12 cm leave 1 cm
    for kind in obstacles.KINDS:
        assert is_parked(*drawn(kind, goal=near)).all()


def test_each_kind_is_as_likely():
    at = view(ee_pos_w=START, goal_pos_w=GOAL, root_pos_w=[1.0, 2.0, 0.0])
    boxes = jax.jit(jax.vmap(lambda key: obstacles.across(key, at, **PARAMS)))(jax.random.split(jax.random.PRNGKey(1), 2000))
    two = boxes["two"].pos_w[:, 2] > 0  # posts and shelves
    assert float(jnp.mean(two)) == pytest.approx(0.5, abs=0.05)


def test_unknown_kinds_are_refused():
    with pytest.raises(UserError, match="obstacles.params.kinds takes some of wall, bar, posts, shelf, got wall, moat"):
        obstacles.across(jax.random.PRNGKey(0), view(), **PARAMS, kinds=("wall", "moat"))
