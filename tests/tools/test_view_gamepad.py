"""A gamepad steers the hand: by what a page says of it, through the door, and from a real browser."""

import gzip
import json
import time

import numpy as np
import pytest

pytest.importorskip("viser")

import http.client

from pages import SPOKEN, cookie_of, token_of
from waiting import wait
from websockets.sync.client import connect

from mjx_nero.tools.view import gamepad, inner
from mjx_nero.tools.view.door import Door


class Hand:
    """Notes what it is asked for."""

    def __init__(self):
        self.moved, self.turned = np.zeros(3), 0.0

    def shift(self, by):
        self.moved += by

    def turn(self, degrees):
        self.turned += degrees


class AtOnce:
    """Orders that are carried out where they are given."""

    def give(self, name, work):
        work()


def said(axes=(0, 0, 0, 0), pressed=()):
    return json.dumps({"axes": list(axes), "buttons": [i in pressed for i in range(17)]}).encode()


@pytest.fixture
def made():
    hand, pressed = Hand(), []
    return gamepad.Gamepad(hand, AtOnce(), {i: lambda i=i: pressed.append(i) for i in (0, 3)}), hand, pressed


def test_sticks_move_and_turn(made):
    """Away is up on the left stick, +x; a second of a stick pushed all the way is 15 cm or 60 degrees."""
    pad, hand, _ = made
    for _ in range(20):
        pad.hear(said((0, -1, 0, 0)))
    np.testing.assert_allclose(hand.moved, [0.15, 0, 0], atol=1e-9)
    for _ in range(20):
        pad.hear(said((0.5, 0, 1, -1)))
    np.testing.assert_allclose(hand.moved, [0.15, -0.075, 0.15], atol=1e-9)
    assert hand.turned == pytest.approx(-60)
    pad.hear(said((0.1, -0.1, 0.1, 0.1)))  # let go
    np.testing.assert_allclose(hand.moved, [0.15, -0.075, 0.15], atol=1e-9)


def test_a_button_counts_once_a_press(made):
    pad, _, pressed = made
    for held in ((0,), (0,), (0, 3), (), (0,), (5,)):
        pad.hear(said(pressed=held))
    assert pressed == [0, 3, 0]


@pytest.mark.parametrize(
    "raw",
    [b"", b"{", b"[" * 4000, b"\xff\x00", said((2, 0, 0, 0)), said((float("nan"), 0, 0, 0)), b'{"axes": [0,0,0,0]}']
    + [json.dumps({"axes": [0] * 4, "buttons": [True] * 33}).encode(), json.dumps({"axes": [1] * 5, "buttons": []}).encode()],
)
def test_nonsense_is_ignored(made, raw):
    pad, hand, pressed = made
    pad.hear(raw)
    assert not hand.moved.any() and not pressed


@pytest.fixture(scope="module")
def served():
    """An empty page behind a door, whose gamepad is heard."""
    page, heard = inner.Inner(), []
    page.gamepad = type("Ear", (), {"hear": staticmethod(heard.append)})
    door = Door("127.0.0.1", 0, page.path)
    yield door, heard
    door.close()
    page.close()


def test_a_page_has_the_script_and_says_what_it_holds(served):
    door, heard = served
    for encoding in ("gzip", "identity"):
        ask = http.client.HTTPConnection("127.0.0.1", door.port)
        ask.request("GET", "/", headers={"Cookie": cookie_of(door), "Accept-Encoding": encoding})
        answer = ask.getresponse()
        body = answer.read()
        text = gzip.decompress(body) if encoding == "gzip" else body
        assert answer.status == 200 and text.count(b"navigator.getGamepads") == 1 and b"location.host}/gamepad`" in text
        ask.close()
    headers = {"Cookie": cookie_of(door)}
    where = {"origin": f"http://127.0.0.1:{door.port}", "subprotocols": [SPOKEN], "compression": None}
    with connect(f"ws://127.0.0.1:{door.port}{gamepad.PATH}", additional_headers=headers, **where) as client:
        client.send(said((0, 1, 0, 0)))
        client.send(said())
        wait(lambda: len(heard) == 2)
        assert heard[0] == said((0, 1, 0, 0))
        with pytest.raises(TimeoutError):
            client.recv(timeout=0.3)  # nothing of the picture comes this way
    with pytest.raises(Exception, match="403"), connect(f"ws://127.0.0.1:{door.port}{gamepad.PATH}", **where):
        pass


@pytest.mark.slow
def test_a_browsers_gamepad_is_heard(served, browser):
    """The browser is given a gamepad; the page's own script tells of it, past all rules of the page."""
    door, heard = served
    held = "{connected: true, mapping: 'standard', axes: [0, -1, 0, 0], buttons: [{pressed: true}]}"
    fake = f"navigator.getGamepads = () => [null, {held}]"
    browser.execute_cdp_cmd("Page.addScriptToEvaluateOnNewDocument", {"source": fake})
    heard.clear()
    browser.get(f"http://127.0.0.1:{door.port}/?token={token_of(door)}")
    wait(lambda: len(heard) > 3, 60)
    time.sleep(0.5)
    assert json.loads(heard[-1]) == {"axes": [0, -1, 0, 0], "buttons": [True]}
