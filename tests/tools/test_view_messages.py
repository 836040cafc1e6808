"""What pages say to the browser view: only what their controls can say is heard, and no page harms another or the server."""

import asyncio
import random
import struct
import threading
import time

import msgspec
import pytest

from mjx_nero.tools.view import log, opening
from mjx_nero.tools.view.orders import Orders

pytest.importorskip("viser")

from pages import DRAG, INF, NAN, SPOKEN, controls, drain, look, odd_messages, say, talk
from viser import _messages, _viser
from viser.infra._messages import wire_field_names
from waiting import wait
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import unix_connect

from mjx_nero.tools.view import messages


@pytest.fixture(scope="module")
def lift():
    shown = opening.open_view(env_name="nero_lift", agent="zero", port=18400)
    yield shown
    shown.close()


def serves_a_normal_client(shown):
    """A button, a choice, a slider and a drag do what they should, for a page that comes now."""
    session, named = shown.session, controls(shown)
    assert session.failure is None and shown._thread.is_alive() and shown._orders._thread.is_alive()
    with talk(shown) as client:
        assert client.recv(timeout=120)  # what there is to see
        look(shown, client)
        uuid, curve = named["Curve"]
        for option in (curve.options[-1], curve.options[0]):
            say(client, "GuiUpdateMessage", uuid=uuid, updates={"value": option})
            wait(lambda option=option: curve.value == option)
        say(client, "GuiUpdateMessage", uuid=named["Agent"][0], updates={"value": "zero"})
        uuid, speed = named["Speed"]
        for value in (2.0, 1):
            say(client, "GuiUpdateMessage", uuid=uuid, updates={"value": value})
            wait(lambda value=value: session.speed == value)
        if not session.running:
            say(client, "GuiUpdateMessage", uuid=named["Run"][0], updates={"value": True})
            wait(lambda: session.running)
        step = session.frame.step
        wait(lambda: session.frame.step != step)
        cube = next(n for n in shown.server.scene._handle_from_node_name if n.startswith("/cube/"))
        for phase, height in (("start", 0.0), ("update", 0.3), ("update", 0.5), ("end", 0.5)):
            say(client, "SceneNodeDragMessage", **DRAG | {"phase": phase, "name": cube, "end_position": [0.0, 0.0, height]})
        wait(lambda: session.frame.qpos[0, -5] > 0.3)
        say(client, "GuiUpdateMessage", uuid=named["Reset"][0], updates={"value": True})
        wait(lambda: session.frame.qpos[0, -5] < 0.1)


@pytest.mark.usefixtures("silence")
def test_the_viewer_outlives_odd_messages(lift, capfd):
    draw, sent, connections = random.Random(43), 0, 0
    serves_a_normal_client(lift)
    with talk(lift) as other:  # somebody else, who stays all the time
        look(lift, other)
        pages = odd_messages(lift, draw)
        threading.Thread(target=drain, args=(other,), daemon=True).start()
        while sent < 2000:
            connections += 1
            with talk(lift) as client:
                threading.Thread(target=drain, args=(client,), daemon=True).start()
                look(lift, client)
                for _ in range(200):
                    raw_message = next(pages)
                    client.send(raw_message[:1000].decode("latin-1") if draw.random() < 0.05 else raw_message)
                    sent += 1
                time.sleep(1.5)  # the server reads 200 a second
        say(other, "GuiUpdateMessage", uuid=controls(lift)["Speed"][0], updates={"value": 3.0})
        wait(lambda: lift.session.speed == 3.0)
    assert connections == 10
    serves_a_normal_client(lift)


@pytest.mark.usefixtures("silence")
def test_odd_frames_end_their_own_connection_alone(lift):
    frames = {  # masked with zeros
        "oversize": struct.pack("!BBQ", 0x82, 0xFF, 1 << 40) + bytes(4),
        "a bit too large": struct.pack("!BBH", 0x82, 0xFE, messages.LONGEST + 1) + bytes(4) + bytes(messages.LONGEST + 1),
        "unmasked": b"\x82\x01a",
        "no such opcode": b"\x83\x80" + bytes(4),
        "compressed": b"\xc2\x81" + bytes(4) + b"a",
        "no start": b"\x80\x81" + bytes(4) + b"a",
        "long ping": struct.pack("!BBH", 0x89, 0xFE, 200) + bytes(4) + bytes(200),
        "many fragments": b"\x02\x80" + bytes(4) + (b"\x00\x80" + bytes(4)) * 5000,
        "not UTF-8": b"\x81\x82" + bytes(4) + b"\xff\xff",
        "close with one byte": b"\x88\x81" + bytes(4) + b"a",
    }
    with talk(lift) as other:
        threading.Thread(target=drain, args=(other,), daemon=True).start()
        look(lift, other)
        for name, data in frames.items():
            with talk(lift) as client:
                look(lift, client)
                client.socket.sendall(data)
                if name == "not UTF-8":  # text is read as bytes, and makes no message
                    continue
                with pytest.raises(ConnectionClosed):
                    while True:
                        client.recv(timeout=120)
        assert other.ping().wait(120)
    serves_a_normal_client(lift)


def test_the_server_opens_no_tunnel(lift, monkeypatch):
    """Whatever is said, at the door or right at the inner server, or if it got past every check."""
    opened = []
    monkeypatch.setattr(_viser, "ViserTunnel", lambda *args, **kwargs: opened.append(args) or (_ for _ in ()).throw(OSError))
    kinds = [c for c in _messages.Message.get_subclasses() if hasattr(c, "__dataclass_fields__")]
    assert {_messages.ShareUrlRequest, _messages.ShareUrlDisconnect} <= set(kinds) and len(kinds) > 50
    straight = unix_connect(str(lift._page.path), subprotocols=[SPOKEN], compression=None, max_size=None)
    with talk(lift) as by_door, straight:
        for client in (by_door, straight):
            threading.Thread(target=drain, args=(client,), daemon=True).start()
            for kind in kinds:
                say(client, kind.__name__)
                say(client, kind.__name__, **dict.fromkeys(wire_field_names(kind), "x"))
            look(lift, client)  # all before has been read
    handlers = lift.server._websock_server._incoming_handlers
    assert not [kind for kind in handlers if "share" in kind.__name__.lower()]
    loop = lift.server._event_loop
    for share in (_messages.ShareUrlRequest(), _messages.ShareUrlDisconnect()):
        asyncio.run_coroutine_threadsafe(lift.server._websock_server._handle_incoming_message(0, share), loop).result(timeout=120)
    time.sleep(0.5)
    assert opened == [] and lift.server._share_tunnel is None
    serves_a_normal_client(lift)


def test_only_choices_of_a_control_are_messages(lift):
    named = controls(lift)

    def update(label, **updates):
        return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": named[label][0], "updates": updates})

    right = [("Curve", "rewards: all"), ("Agent", "zero"), ("Step", True), ("Speed", 1), ("Speed", 0.1), ("Speed", 4.0)]
    for label, value in right:
        told = msgspec.msgpack.decode(messages.checked(update(label, value=value), lift.server))
        assert told == {"type": "GuiUpdateMessage", "uuid": named[label][0], "updates": {"value": value}}
    wrong = {"Curve": ["rewards: no", "", 1, True], "Agent": ["policy"], "Step": [False, "x", 1]}
    wrong["Speed"] = [0.0, 4.1, NAN, INF, "1", True, 2**64 - 1]
    for label, value in [(label, value) for label, values in wrong.items() for value in values]:
        with pytest.raises(ValueError, match="not a value of an existing control"):
            messages.checked(update(label, value=value), lift.server)
    for updates in ({"min": -5.0}, {"value": 1.0, "max": 100}, {}, {"update_cb": "x"}):
        with pytest.raises(ValueError):
            messages.checked(update("Speed", **updates), lift.server)


def test_a_key_moves_the_hand_and_only_commands_that_there_are_are_heard(lift):
    """The hand takes over from whoever acts, and gives back."""
    commands = {handle._impl.props.label: uuid for uuid, handle in lift.server.gui._command_handle_from_uuid.items()}
    assert {"hand up", "open or close the gripper"} <= set(commands) and "Record" not in commands  # without --demos
    with pytest.raises(ValueError, match="not an existing command"):
        messages.checked(msgspec.msgpack.encode({"type": "CommandTriggerMessage", "uuid": "x"}), lift.server)
    agent = lift.panel.agent
    with talk(lift) as client:
        threading.Thread(target=drain, args=(client,), daemon=True).start()
        look(lift, client)
        say(client, "CommandTriggerMessage", uuid=commands["hand up"])
        wait(lambda: agent.value == "your hand")
        say(client, "GuiUpdateMessage", uuid=controls(lift)["Give back"][0], updates={"value": True})
        wait(lambda: agent.value == "zero")


def test_of_the_orders_that_wait_the_last_is_done():
    orders, done, gate = Orders(), [], threading.Event()
    orders.give("first", gate.wait)
    time.sleep(0.1)
    for i in range(1000):
        orders.give("a", lambda i=i: done.append(i))
    orders.give("b", lambda: 1 / 0)
    orders.give("c", lambda: done.append("c"))
    gate.set()
    wait(lambda: "c" in done)
    assert done == [999, "c"]
    orders.close()
    assert not orders._thread.is_alive()


def test_a_line_now_and_then(caplog):
    log.LOG.filters[0]._next = 0.0
    for i in range(100):
        log.LOG.warning("bad \x1b[2J thing %d\n%s", i, "y" * 1000)
    (line,) = caplog.messages
    assert line.startswith("view: bad \\x1b[2J thing 0\\n") and len(line) < 200
