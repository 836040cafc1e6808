"""The controller that puts things in: which way up they belong. The tasks test what comes of it."""

import jax.numpy as jnp
import numpy as np
import views

from mjx_nero.control.put_in import PutIn

ROLLED = (0.75**0.5, 0.5, 0.0, 0.0)  # by 60 degrees about x: sin 60 = 0.866, cos 60 = 0.5


def test_what_is_up_is_as_at_the_goal_by_hand():
    """A thing that rests on another side than its file's keeps to that side, whatever its heading."""
    turned = (0.75**0.5 * 0.8, 0.5 * 0.8, 0.5 * 0.6, 0.75**0.5 * 0.6)  # the same, then turned about the vertical
    for goal, up in (((0.8, 0.0, 0.0, 0.6), [0, 0, 1]), (ROLLED, [0, 0.75**0.5, 0.5]), (turned, [0, 0.75**0.5, 0.5])):
        np.testing.assert_allclose(PutIn._own_up(views.blank(goal_quat_w=jnp.array(goal))), up, atol=1e-6)
