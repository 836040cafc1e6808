"""A hand on the arm: it goes where the user wants it, and what it does becomes an episode."""

import jax
import numpy as np
import pytest

import mjx_nero
from mjx_nero.data import episode as names
from mjx_nero.data import open_dataset
from mjx_nero.errors import UserError
from mjx_nero.tools.view import agents
from mjx_nero.tools.view.hand import NAME, Hand, Recording
from mjx_nero.tools.view.session import Session


@pytest.fixture(scope="module")
def shown():
    """A session that a zero agent plays, the hand on it, and who took over."""
    env = mjx_nero.make("nero_lift", impl="native", corruption=False, episode_length_s=3.0)
    makers, taken = agents.known(env, "nero_lift", []), []
    session = Session(env, 1, makers["zero"]())
    hand = Hand(session, lambda: not taken and not taken.append(NAME))
    hand.maker = makers[NAME]
    return session, hand, taken


def test_the_hand_goes_where_it_is_wanted(shown):
    session, hand, taken = shown
    start = hand.pos.copy()
    hand.shift((0.0, 0.03, 0.0))
    hand.turn(20.0)
    hand.grip(0.0)
    assert taken == [NAME]  # the first alone takes over
    session.play(hand.maker(), hand.begin())
    for _ in range(80):
        session.step()
    pos, quat = hand._pose(session.frame.qpos[0].astype(np.float32))
    np.testing.assert_allclose(pos, start + [0, 0.03, 0], atol=0.012)  # the arm sinks by its weight
    assert abs(np.asarray(quat) @ hand.quat) > np.cos(np.radians(5) / 2)
    opened = session.frame.qpos[0, 7:9] @ [1, -1]
    assert opened < 0.01  # from 0.1 m
    hand.grip(3.0)
    assert hand.open == 1.0


def test_what_the_hand_does_is_saved(shown, tmp_path):
    """Observations and actions are the record's; states lie before the step; the task's end ends the recording, too."""
    session, _, _ = shown
    recording, seen = Recording(session, tmp_path / "d", "nero_lift", "default", "arrays"), []
    session.recorders.append(lambda record: seen.append(jax.tree.map(np.array, record)))
    with pytest.raises(UserError, match="nothing was recorded: press Record first"):
        recording.save()
    session.reset()
    recording.begin()
    session.step()
    recording.discard()
    session.reset()
    seen.clear()
    recording.begin()
    start = session.frame.qpos[0].copy()
    for _ in range(session.env.episode_length + 3):
        session.step()
    assert len(recording) == session.env.episode_length and not recording.on
    assert recording.save() == f"150 steps saved; {tmp_path / 'd'} has 1 episodes"
    recording.begin()
    session.step()
    assert recording.save() == f"1 steps saved; {tmp_path / 'd'} has 2 episodes"
    found = open_dataset(tmp_path / "d")
    assert found.numbers.tolist() == [0, 1] and found.success.all() and found.schema.about["agent"] == NAME
    first = found.episodes()[0].arrays
    np.testing.assert_allclose(first[names.QPOS][0], start, atol=1e-6)
    np.testing.assert_array_equal(first[names.QPOS][1], seen[0].qpos[0])
    np.testing.assert_array_equal(first[names.STATE], first[names.QPOS][:, :9])
    np.testing.assert_array_equal(first[names.SEEN][7], seen[7].obs["state"][0])
    np.testing.assert_array_equal(first[names.DONE_BY][7], seen[7].action[0])
    np.testing.assert_array_equal(first[names.ACTION][7], seen[7].targets[0])
    place = list(found.schema.features[names.ENVIRONMENT].names).index("cube.x")
    np.testing.assert_array_equal(first[names.ENVIRONMENT][:, place], first[names.QPOS][:, 9])
    session.recorders.clear()
