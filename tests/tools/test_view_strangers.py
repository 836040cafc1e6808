"""The browser view against strangers: who gets in, what a page may say, and that no page harms another or the server."""

import asyncio
import contextlib
import http.client
import http.server
import os
import random
import socket
import stat
import struct
import threading
import time
import urllib.parse

import msgspec
import pytest

from mjx_nero.tools import view
from mjx_nero.tools.view import log, request
from mjx_nero.tools.view.orders import Orders

viser = pytest.importorskip("viser")

from viser import _messages  # noqa: E402
from viser.infra._messages import wire_field_names  # noqa: E402
from websockets.exceptions import ConnectionClosed  # noqa: E402
from websockets.sync.client import connect, unix_connect  # noqa: E402

from mjx_nero.tools.view import inner, messages  # noqa: E402
from mjx_nero.tools.view.door import Door  # noqa: E402

SPOKEN = f"viser-v{viser.__version__}"
KEY = "dGhlIHNhbXBsZSBub25jZQ=="


def token_of(door):
    return urllib.parse.parse_qs(urllib.parse.urlsplit(door.url).query)["token"][0]


def cookie_of(door):
    return f"mjx_nero_view_{door.port}={token_of(door)}"


@pytest.fixture(scope="module")
def page():
    """An empty page behind its socket."""
    shown = inner.Inner()
    yield shown
    shown.close()


@pytest.fixture(scope="module")
def doors(page):
    """One for this machine, one for its network."""
    both = {host: Door(host, 0, page.path) for host in ("127.0.0.1", "0.0.0.0")}
    yield both
    for door in both.values():
        door.close()


@pytest.fixture(scope="module")
def lift():
    shown = view.open_view(env_name="nero_lift", agent="zero", port=18400)
    yield shown
    shown.close()


def raw(port, data, seconds=15.0, end=False):
    """What comes back for these bytes."""
    with socket.create_connection(("127.0.0.1", port), timeout=seconds) as client:
        with contextlib.suppress(OSError):
            client.sendall(data)
            if end:
                client.shutdown(socket.SHUT_WR)
        answer = b""
        with contextlib.suppress(OSError):
            while b"\r\n\r\n" not in answer and (more := client.recv(1 << 16)):
                answer += more
        return answer


def knock(port, host, origin=None, cookie=None, socket_=False, path="/"):
    """Status of a request for the page, or for a websocket."""
    lines = [f"GET {path} HTTP/1.1", f"Host: {host}"]
    lines += [f"Origin: {origin}"] if origin else []
    lines += [f"Cookie: {cookie}"] if cookie else []
    if socket_:
        lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {KEY}"]
        lines += [f"Sec-WebSocket-Protocol: {SPOKEN}"]
    return int(raw(port, "\r\n".join([*lines, "", ""]).encode()).split(b" ")[1])


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
@pytest.mark.parametrize("socket_", [False, True], ids=["page", "websocket"])
def test_who_gets_in(doors, host, socket_):
    """Every Host with every Origin with every token, and by which rule the few get in that do."""
    door = doors[host]
    port, name = door.port, socket.gethostname()
    hosts = {f"127.0.0.1:{port}": True, f"localhost:{port}": True, f"LOCALHOST:{port}": True, "localhost:9000": True}
    hosts |= {f"[::1]:{port}": True, f"192.0.2.7:{port}": host == "0.0.0.0", f"{name}:{port}": host == "0.0.0.0"}
    hosts |= dict.fromkeys((f"evil.example:{port}", "evil.example", f"localhost.evil.example:{port}", "127.0.0.1.evil"), False)
    cookies = {cookie_of(door): True, "a={b}; " + cookie_of(door): True, None: False, f"mjx_nero_view_{port}=x": False}
    cookies |= {f"mjx_nero_view_{port}=": False, f"mjx_nero_view={token_of(door)}": False}
    for sent, mine in hosts.items():
        origins = {
            f"http://{sent}": True,
            None: not socket_,
            "null": False,
            f"https://{sent}": False,
            "http://evil.example": False,
        }
        origins |= {f"http://{sent}1": False, f"http://{sent}.evil.example": False, "http://127.0.0.1:1": False, "file://": False}
        for origin, own in origins.items():
            for cookie, known in cookies.items():
                expected = (101 if socket_ else 200) if mine and own and known else 403
                assert knock(port, sent, origin, cookie, socket_) == expected, (sent, origin, cookie)
            given = knock(port, sent, origin, None, socket_, f"/?token={token_of(door)}")
            assert given == (303 if mine and own else 403), (sent, origin)


def test_the_token_comes_once_and_a_cookie_keeps_it(doors):
    door = doors["127.0.0.1"]
    assert len(token_of(door)) >= 20
    for path in ("/?token=wrong", "/?token=", "/?token=%00", "/?token=%C3%A4", f"/?token={token_of(door)}&websocket=ws://evil"):
        assert knock(door.port, "localhost", path=path) == 403
    # viser's page would connect to a server, or play a file, that its address names
    for path in ("/?websocket=ws://evil.example", "/?playbackPath=http://evil.example/a", "/?"):
        assert knock(door.port, "localhost", path=path, cookie=cookie_of(door)) == (200 if path == "/?" else 403)
    connection = http.client.HTTPConnection("127.0.0.1", door.port, timeout=20)
    connection.request("GET", f"/?token={token_of(door)}")
    answer = connection.getresponse()
    given = answer.getheader("Set-Cookie")
    assert answer.status == 303 and answer.getheader("Location") == "/" and "HttpOnly" in given and "SameSite=Strict" in given
    connection = http.client.HTTPConnection("127.0.0.1", door.port, timeout=20)
    connection.request("GET", "/", headers={"Cookie": given.partition(";")[0]})
    answer = connection.getresponse()
    assert answer.status == 200 and len(answer.read()) > 100_000
    assert answer.getheader("X-Frame-Options") == "DENY" and "frame-ancestors 'none'" in answer.getheader(
        "Content-Security-Policy"
    )


def test_nobody_else_reaches_the_inner_server(page):
    folder = page.path.parent
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700 and folder.stat().st_uid == os.getuid()
    mine = {os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}")}

    def listening():
        for table in ("tcp", "tcp6"):
            for line in open(f"/proc/self/net/{table}").read().splitlines()[1:]:
                _, local, _, state, *_, inode = line.split()[:10]
                if state == "0A" and f"socket:[{inode}]" in mine:
                    yield int(local.rpartition(":")[2], 16)

    before = set(listening())
    another = inner.Inner()
    try:
        mine = {os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}")}
        assert set(listening()) == before
    finally:
        folder = another.path.parent
        another.close()
    assert not folder.exists()


BAD_HEADS = [
    b"GET http://[::1/x HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET /?token=[::1 HTTP/1.1\r\nHost: [::1\r\n\r\n",
    b"GET //[::1/ HTTP/1.1\r\nHost: [\r\n\r\n",
    b"GET / HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: user@localhost\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost:99999999\r\n\r\n",
    b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n",
    b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n",
    b"GET\r\n\r\n",
    b"\r\n\r\n",
    b"GET /\x00 HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET /../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET /%2e%2e/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"CONNECT localhost:1 HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: h2c\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\n folded: x\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nA: \x07\r\n\r\n",
    b"GET / HTTP/1.1\nHost: localhost\n\n\r\n\r\n",
    b"GET /?token=" + b"a" * 100_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nA: " + b"a" * 1_000_000 + b"\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"".join(b"A%d: 1\r\n" % i for i in range(5000)) + b"\r\n",
    b"GET / HTTP/1.1\r\n" + b"a" * 20_000,
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\x00" * 500,
]


@pytest.fixture
def silence(capfd, caplog):
    """Nothing with a traceback is written while the test runs; a line for ten seconds at most."""
    log.LOG.filters[0]._next = 0.0
    started = time.monotonic()
    yield
    out, err = capfd.readouterr()
    everything = out + err + caplog.text
    assert "Traceback" not in everything
    assert everything.count("view: ") <= 2 * (1 + (time.monotonic() - started) // log.EVERY_S)  # caplog has them a second time
    assert len(everything) < 5000


@pytest.mark.usefixtures("silence")
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_odd_requests_get_400(doors, host):
    port = doors[host].port
    for head in BAD_HEADS:
        assert raw(port, head, end=True).startswith(b"HTTP/1.1 400 Bad Request\r\n"), head[:80]
    assert knock(port, "localhost", cookie=cookie_of(doors[host])) == 200


@pytest.mark.usefixtures("silence")
def test_a_thousand_random_requests(doors):
    door, draw = doors["127.0.0.1"], random.Random(43)
    good = f"GET / HTTP/1.1\r\nHost: localhost:{door.port}\r\nCookie: {cookie_of(door)}\r\nOrigin: http://localhost:{door.port}\r\n\r\n"
    statuses = set()
    for _ in range(1000):
        data = bytearray(good.encode())
        for _ in range(draw.randint(1, 6)):
            at = draw.randrange(len(data))
            what = draw.choice((b"", b"\r\n", b"\x00", b":", b"[", b"\xff", bytes([draw.randrange(256)]), b"GET ", b"%", b"?"))
            data[at : at + draw.randint(0, 3)] = what * draw.choice((1, 1, 1, 50))
        statuses.add(raw(door.port, bytes(data), end=True).split(b" ")[1])
    assert statuses <= {b"200", b"303", b"400", b"403", b"404"} and {b"400", b"403"} <= statuses
    assert knock(door.port, "localhost", cookie=cookie_of(door)) == 200


def test_slow_clients_go_when_others_come(doors, monkeypatch):
    from mjx_nero.tools.view import door as module

    monkeypatch.setattr(module, "PATIENCE_S", 2.0)
    port = doors["127.0.0.1"].port
    slow = [socket.create_connection(("127.0.0.1", port)) for _ in range(2 * module.GUESTS)]
    try:
        for each in slow:
            with contextlib.suppress(OSError):
                each.sendall(b"GET / HT")
        assert knock(port, "localhost", cookie=cookie_of(doors["127.0.0.1"])) == 200  # at once
        started = time.monotonic()
        slow[-1].settimeout(10)
        assert slow[-1].recv(100).startswith(b"HTTP/1.1 400") and time.monotonic() - started < 5
        assert len(doors["127.0.0.1"]._waiting) <= module.GUESTS
    finally:
        for each in slow:
            each.close()


def test_what_is_read_of_a_request():
    asked = request.parse(b"GET /?token=a%20b HTTP/1.1\r\nhOST: [::1]:80\r\nOrigin: http://[::1]:80\r\nCookie: a=1; b=2\r\n\r\n")
    assert (asked.host, asked.query, asked.cookie("b"), asked.cookie("c")) == ("[::1]", {"token": "a b"}, "2", "")
    assert asked.own_origin and not asked.upgrades
    assert asked.head() == b"GET / HTTP/1.1\r\nhost: [::1]:80\r\norigin: http://[::1]:80\r\ncookie: a=1; b=2\r\n\r\n"


# What a page says


@contextlib.contextmanager
def talk(shown, **kwargs):
    """A page's connection, by its door."""
    door = shown._door
    with connect(
        f"ws://127.0.0.1:{door.port}",
        origin=f"http://127.0.0.1:{door.port}",
        subprotocols=[SPOKEN],
        additional_headers={"Cookie": cookie_of(door)},
        compression=None,
        max_size=None,
        **kwargs,
    ) as client:
        yield client


def say(client, kind, **fields):
    client.send(msgspec.msgpack.encode({"type": kind, **fields}))


CAMERA = {
    "wxyz": [1, 0, 0, 0],
    "position": [2.0, 0, 1],
    "fov": 0.8,
    "near": 0.01,
    "far": 1000,
    "image_height": 600,
    "image_width": 800,
    "look_at": [0, 0, 0.5],
    "up_direction": [0, 0, 1],
}


def look(shown, client):
    """Makes a connection a client of viser's, as its first message does."""
    before = set(shown.server.get_clients())
    say(client, "ViewerCameraMessage", **CAMERA)
    wait(lambda: set(shown.server.get_clients()) - before)


def wait(condition, seconds=30):
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)
    return found


def controls(shown):
    """Label -> (uuid, handle)."""
    return {handle.label: (uuid, handle) for uuid, handle in shown.server.gui._gui_input_handle_from_uuid.items()}


def serves_a_normal_client(shown):
    """A button, a choice, a slider and a drag do what they should, for a page that comes now."""
    session, named = shown.session, controls(shown)
    assert session.failure is None and shown._thread.is_alive() and shown._orders._thread.is_alive()
    with talk(shown) as client:
        assert client.recv(timeout=30)  # what there is to see
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
        drag = {"name": cube, "instance_index": 0, "start_screen_pos": [1, 1], "end_screen_pos": [1, 1], "button": "left"}
        for phase, height in (("start", 0.0), ("update", 0.3), ("update", 0.5), ("end", 0.5)):
            end = [0.0, 0.0, height]
            say(
                client,
                "SceneNodeDragMessage",
                phase=phase,
                start_position=[0, 0, 0],
                end_position=end,
                modifier=None,
                owner="",
                **drag,
            )
        wait(lambda: session.frame.qpos[0, -5] > 0.3)
        say(client, "GuiUpdateMessage", uuid=named["Reset"][0], updates={"value": True})
        wait(lambda: session.frame.qpos[0, -5] < 0.1)


ODD = [
    None,
    True,
    False,
    0,
    -1,
    1e308,
    -1e308,
    float("nan"),
    float("inf"),
    2**63,
    2**64 - 1,
    "",
    "x" * 300,
    "no such",
    "\x1b[2J",
    b"\xff",
]
ODD += [[], {}, [1, 2, 3], ["a"], {"a": 1}, [float("nan")] * 3, [1e300] * 3, [[[[]]]], "rewards: nothing", "nothing: all", -0.0]


def odd_messages(shown, draw):
    """Raw messages of which hardly one is right, without an end: noise, cut and bent ones, of all kinds, about what there is."""
    kinds = {c.__name__: wire_field_names(c) for c in _messages.Message.get_subclasses() if hasattr(c, "__dataclass_fields__")}
    names, uuids = list(shown.server.scene._handle_from_node_name), list(shown.server.gui._gui_input_handle_from_uuid)
    props = [
        "value",
        "options",
        "min",
        "max",
        "label",
        "removed",
        "update_cb",
        "gui_api",
        "is_button",
        "sync_cb",
        "visible",
        "_x",
    ]
    drag = {"start_screen_pos": [1, 1], "end_screen_pos": [1, 1], "button": "left", "modifier": None, "owner": ""}

    def odd():
        return draw.choice(ODD)

    def update():
        return {"type": "GuiUpdateMessage", "uuid": draw.choice([*uuids, odd()]), "updates": {draw.choice(props): odd()}}

    def drags():
        where = {"start_position": [0, 0, odd()], "end_position": [odd(), 0, 0.1]} | (
            {"end_position": [0, 0, 0]} if draw.random() < 0.3 else {}
        )
        return {"type": "SceneNodeDragMessage", "phase": draw.choice(["start", "update", "end", odd()])} | where | drag | {
            "name": draw.choice([*names, odd()]),
            "instance_index": draw.choice([None, 0, 1, -1, 10**6, odd()]),
        }  # fmt: skip

    def any_kind():
        kind = draw.choice([*kinds, "Message", "object", odd()])
        fields = kinds.get(kind, ["value"]) if isinstance(kind, str) else ["value"]
        return {"type": kind} | {field: odd() for field in fields}

    def camera():
        return {"type": "ViewerCameraMessage"} | CAMERA | {draw.choice(list(CAMERA)): odd()}

    while True:
        packed = msgspec.msgpack.encode(draw.choice([update, update, drags, any_kind, any_kind, camera])())
        bent = bytearray(packed)
        bent[draw.randrange(len(bent))] = draw.randrange(256)
        noise = draw.randbytes(draw.randint(0, 300))
        bomb = draw.choice(
            [b"\x91" * 4000, b"\x81\xa1a" * 1300, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xffa"]
        )
        yield draw.choices([packed, bytes(bent), packed[: draw.randrange(len(packed))], noise, bomb], [6, 2, 1, 1, 1])[0]


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


def drain(client):
    with contextlib.suppress(ConnectionClosed):
        while True:
            client.recv()


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
                        client.recv(timeout=20)
        assert other.ping().wait(20)
    serves_a_normal_client(lift)


def test_the_server_opens_no_tunnel(lift, monkeypatch):
    """Whatever is said, at the door or right at the inner server, or if it got past every check."""
    from viser import _viser

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
        asyncio.run_coroutine_threadsafe(lift.server._websock_server._handle_incoming_message(0, share), loop).result(timeout=10)
    time.sleep(0.5)
    assert opened == [] and lift.server._share_tunnel is None
    serves_a_normal_client(lift)


def test_only_choices_of_a_control_are_messages(lift):
    named = controls(lift)

    def update(label, **updates):
        return msgspec.msgpack.encode({"type": "GuiUpdateMessage", "uuid": named[label][0], "updates": updates})

    for label, value in (
        ("Curve", "rewards: all"),
        ("Agent", "zero"),
        ("Speed", 1),
        ("Speed", 0.1),
        ("Speed", 4.0),
        ("Step", True),
    ):
        told = msgspec.msgpack.decode(messages.checked(update(label, value=value), lift.server))
        assert told == {"type": "GuiUpdateMessage", "uuid": named[label][0], "updates": {"value": value}}
    wrong = [("Curve", v) for v in ("rewards: no", "", 1, True)] + [
        ("Agent", "policy"),
        ("Step", False),
        ("Step", "x"),
        ("Step", 1),
    ]
    for label, value in wrong + [("Speed", v) for v in (0.0, 4.1, float("nan"), float("inf"), "1", True, 2**64 - 1)]:
        with pytest.raises(ValueError, match="no choice of a control"):
            messages.checked(update(label, value=value), lift.server)
    for updates in ({"min": -5.0}, {"value": 1.0, "max": 100}, {}, {"update_cb": "x"}):
        with pytest.raises(ValueError):
            messages.checked(update("Speed", **updates), lift.server)


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


EVIL = """<!doctype html><title>evil</title><body><script>
const seen = {};
const done = (name, what) => { seen[name] = what; document.title = JSON.stringify(seen); };
function tryAll(port, version, update) {
  for (const host of ["127.0.0.1", "localhost", "evil.example"])
    for (const path of ["/", "/?token=", "/x"]) {
      const name = "ws " + host + path;
      const socket = new WebSocket(`ws://${host}:${port}${path}`, [version]);
      socket.onopen = () => {
        done(name, "open");
        for (const each of update) socket.send(Uint8Array.from(each));
      };
      socket.onerror = () => seen[name] || done(name, "refused");
    }
  for (const mode of ["cors", "no-cors"])
    fetch(`http://127.0.0.1:${port}/`, {mode, credentials: "include"})
      .then(r => r.text()).then(t => done("fetch " + mode, t.length)).catch(() => done("fetch " + mode, "refused"));
  const frame = document.createElement("iframe");
  frame.onload = () => {
    let inside = "nothing";
    try { inside = frame.contentDocument === null ? "hidden" : "page"; } catch (e) {}
    done("frame", frame.contentWindow.length + inside);
  };
  frame.src = `http://127.0.0.1:${port}/?websocket=ws://127.0.0.1:1`;
  document.body.append(frame);
}
</script>"""


@pytest.fixture
def evil():
    """A web page of somebody else's on this machine: every port is another origin."""

    class Page(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(EVIL.encode())

        def log_message(self, *args):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_port
    server.shutdown()
    server.server_close()


@pytest.mark.slow
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_page_of_another_origin_neither_steers_nor_shares(browser, evil, host, monkeypatch, tmp_path):
    """While the user has the view open in the same browser, whose cookie goes along where the other page is of the same site."""
    from selenium.webdriver.common.by import By
    from viser import _viser

    opened = []
    monkeypatch.setattr(_viser, "ViserTunnel", lambda *args, **kwargs: opened.append(args))
    shown = view.open_view(env_name="nero_lift", agent="zero", port=18500, host=host)
    try:
        port = shown._door.port
        browser.get(f"http://127.0.0.1:{port}/?token={token_of(shown._door)}")
        own = browser.current_window_handle
        wait(lambda: shown.server.get_clients(), 120)
        wait(lambda: "Agent" in browser.find_element(By.TAG_NAME, "body").text, 120)
        named = controls(shown)
        orders = [{"type": "ViewerCameraMessage"} | CAMERA]
        orders += [{"type": "GuiUpdateMessage", "uuid": named["Speed"][0], "updates": {"value": 4.0}}]
        orders += [{"type": "GuiUpdateMessage", "uuid": named["Pause"][0], "updates": {"value": True}}]
        orders += [{"type": "ShareUrlRequest"}]
        packed = [list(msgspec.msgpack.encode(each)) for each in orders]
        for origin in (f"http://127.0.0.1:{evil}", f"http://localhost:{evil}", f"http://evil.example:{evil}"):
            browser.switch_to.new_window("tab")
            browser.get(origin)
            browser.execute_script("tryAll(...arguments)", port, SPOKEN, packed)
            wait(lambda: len(seen := browser.execute_script("return seen")) == 12 and seen, 60)
            seen = browser.execute_script("return seen")
            assert {what for name, what in seen.items() if name.startswith("ws")} == {"refused"}, seen
            assert seen["fetch cors"] == "refused" and seen["fetch no-cors"] in ("refused", 0) and seen["frame"] != "0page", seen
            browser.close()
            browser.switch_to.window(own)
        browser.switch_to.new_window("tab")
        browser.get(f"http://evil.example:{port}/?token={token_of(shown._door)}")  # a name that is made to lead here
        assert "Open the address that the program printed" in browser.find_element(By.TAG_NAME, "body").text
        browser.close()
        browser.switch_to.window(own)
        assert len(shown.server.get_clients()) == 1 and opened == []
        assert shown.session.running and shown.session.speed == 1.0
        # The page itself steers, and it draws.
        browser.find_element(By.XPATH, "//button[.//*[text()='Pause'] or text()='Pause']").click()
        wait(lambda: not shown.session.running)
        browser.save_screenshot(str(tmp_path / "view.png"))
        errors = [line["message"] for line in browser.get_log("browser") if line["level"] == "SEVERE"]
        assert not [e for e in errors if "Content Security Policy" in e]
    finally:
        shown.close()
