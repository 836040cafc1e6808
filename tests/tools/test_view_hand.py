"""A hand on the arm: it goes where the user wants it, and what it does becomes an episode."""

import dataclasses
import threading
import time

import jax
import numpy as np
import pytest

pytest.importorskip("viser")

from pages import controls
from waiting import wait

import mjx_nero
from mjx_nero.data import episode as names
from mjx_nero.data import open_dataset
from mjx_nero.errors import UserError
from mjx_nero.tools.view import agents, hand_panel, opening, tape
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


def test_a_recording_that_ended_takes_no_further_step(shown, tmp_path):
    """Not even of a step that the session was about to hand over when the user ended it."""
    session, _, _ = shown
    session.recorders.clear()
    recording, seen = Recording(session, tmp_path / "d", "nero_lift", "default", "arrays"), []
    session.recorders.append(seen.append)
    session.reset()
    session.step()
    session.recorders.clear()
    ended = threading.Event()
    steps = threading.Thread(target=lambda: [recording(seen[0]) for _ in iter(ended.is_set, True)])
    steps.start()
    try:
        for _ in range(200):
            recording.begin()
            wait(lambda: len(recording) > 0)
            recording.discard()
            time.sleep(1e-3)
            assert len(recording) == 0 and not recording.on
    finally:
        ended.set()
        steps.join()


def test_a_tape_shows_what_was_recorded(shown, tmp_path):
    """From the recorder and from the data set alike; then the physics goes on from where it stood."""
    session, _, _ = shown
    recording = Recording(session, tmp_path / "d", "nero_lift", "default", "arrays")
    session.reset()
    recording.begin()
    for _ in range(5):
        session.step()
    before = [qpos for qpos, _ in recording._steps]
    session.move_goal(0, np.array([0.3, 0.1, 0.3]))
    live = session.frame
    tapes = [recording.tape()]
    recording.save()
    tapes.append(tape.of_dataset(tmp_path / "d", 0, live))
    for each in tapes:
        session.replay(each)
        for step, qpos in enumerate(before):
            session.step()
            assert session.frame.step == step
            np.testing.assert_allclose(session.frame.qpos[0], qpos, atol=1e-6)
            assert np.abs(session.frame.scenery.goal_pos_w[0] - [0.3, 0.1, 0.3]).max() > 1e-3  # as it was
        session.step()
        np.testing.assert_array_equal(session.frame.qpos, live.qpos)
    session.step()
    assert session.frame.step == live.step + 1
    with pytest.raises(UserError, match="has 1 episodes: --episode takes a number from 0 to 0"):
        tape.of_dataset(tmp_path / "d", 1, live)
    other = dataclasses.replace(live, qpos=live.qpos[:, :5])
    with pytest.raises(UserError, match="has 16 positions, but this environment has 5: pass the data set's --env"):
        tape.of_dataset(tmp_path / "d", 0, other)
    session.recorders.clear()


def test_a_folder_that_cannot_be_recorded_into_is_told_before_anybody_steers(shown, tmp_path):
    session, _, _ = shown
    recording = Recording(session, tmp_path / "d", "nero_lift", "default", "arrays")
    session.recorders.clear()
    recording.check()
    assert not list(tmp_path.iterdir())
    (tmp_path / "d").write_text("")
    with pytest.raises(UserError, match="d is not a folder: pass another folder"):
        recording.check()


def test_what_the_hand_did_is_played_again_in_physics(shown, tmp_path, call):
    """The hand stands still, so a start at rest comes to the same."""
    session, _, _ = shown
    session.recorders.clear()
    recording = Recording(session, tmp_path / "d", "nero_lift", "default", "arrays", fields={"episode_length_s": 3.0})
    session.reset()
    recording.begin()
    for _ in range(10):
        session.step()
    recording.save()
    session.recorders.clear()
    code, out, err = call("mjx_nero", "demos", "--replay", tmp_path / "d")
    assert code == 0 and "episode 0 (number 0): 10 steps, succeeds" in out, err
    assert float(out.split("differs from the recording by at most ")[1].split()[0]) < 0.02


def test_corrections_are_recorded_while_the_user_steers(tmp_path):
    """Taking over begins an episode, giving back saves it; what the policy does by itself is not in it."""
    page = opening.open_view(env_name="nero_lift", agent="zero", port=18500, demos=tmp_path / "d")
    try:
        hands = page.hands
        assert {"Record (R)", "Discard (D)", "Replay (P)", "Save (S)", "Give back"} <= set(controls(page))
        hands._when.value = hand_panel.WHEN[1]
        recording, session = hands._recording, page.session
        wait(lambda: session.frame.step > 2)
        assert len(recording) == 0
        hands._hand.shift((0.0, 0.01, 0.0))
        assert page.panel.agent.value == NAME
        wait(lambda: len(recording) > 5)
        hands.give_back()
        assert page.panel.agent.value == "zero"
        found = open_dataset(tmp_path / "d")
        assert len(found) == 1 and found.lengths[0] > 5 and len(recording) == 0
        step = session.frame.step
        wait(lambda: session.frame.step > step + 3)
        assert len(recording) == 0
    finally:
        page.close()
