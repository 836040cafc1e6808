"""A page of the browser view without a browser: what it sends, as tests say it."""

import contextlib
import urllib.parse

import msgspec
import viser
from viser import _messages
from viser.infra._messages import wire_field_names
from waiting import wait
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

SPOKEN = f"viser-v{viser.__version__}"


def token_of(door):
    return urllib.parse.parse_qs(urllib.parse.urlsplit(door.url).query)["token"][0]


def cookie_of(door):
    return f"mjx_nero_view_{door.port}={token_of(door)}"


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
DRAG = {
    "phase": "start",
    "name": "",
    "instance_index": 0,
    "start_position": [0, 0, 0],
    "start_screen_pos": [1, 1],
    "end_position": [0, 0, 0],
    "end_screen_pos": [1, 1],
    "button": "left",
    "modifier": None,
    "owner": "",
}


def look(shown, client):
    """Makes a connection a client of viser's, as its first message does."""
    before = set(shown.server.get_clients())
    say(client, "ViewerCameraMessage", **CAMERA)
    wait(lambda: set(shown.server.get_clients()) - before)


def controls(shown):
    """Label -> (uuid, handle)."""
    return {handle.label: (uuid, handle) for uuid, handle in shown.server.gui._gui_input_handle_from_uuid.items()}


def drain(client):
    with contextlib.suppress(ConnectionClosed):
        while True:
            client.recv()


NAN, INF = float("nan"), float("inf")
ODD = [None, True, False, 0, -1, 1e308, -1e308, NAN, INF, 2**63, 2**64 - 1, "", "x" * 300, "no such", "\x1b[2J", b"\xff"]
ODD += [[], {}, [1, 2, 3], ["a"], {"a": 1}, [NAN] * 3, [1e300] * 3, [[[[]]]], "rewards: nothing", "nothing: all", -0.0]


def odd_messages(shown, draw):
    """Raw messages of which hardly one is right, without an end: noise, cut and bent ones, of all kinds, about what there is."""
    kinds = {c.__name__: wire_field_names(c) for c in _messages.Message.get_subclasses() if hasattr(c, "__dataclass_fields__")}
    names, uuids = list(shown.server.scene._handle_from_node_name), list(shown.server.gui._gui_input_handle_from_uuid)
    props = ["value", "options", "min", "max", "label", "removed", "update_cb", "gui_api", "is_button", "sync_cb", "_x"]
    bombs = [b"\x91" * 4000, b"\x81\xa1a" * 1300, b"\xdd\xff\xff\xff\xff", b"\xdf\xff\xff\xff\xff", b"\xc6\xff\xff\xff\xffa"]

    def odd():
        return draw.choice(ODD)

    def update():
        return {"type": "GuiUpdateMessage", "uuid": draw.choice([*uuids, odd()]), "updates": {draw.choice(props): odd()}}

    def drags():
        at = draw.choice([0, -1, 99.0, odd()])
        index, phase = draw.choice([None, 0, 0, 1, -1, 10**6, odd()]), draw.choice(["start", "update", "end", odd()])
        said = {"phase": phase, "name": draw.choice([*names, odd()]), "instance_index": index, "end_position": [0, 0.3, at]}
        return {"type": "SceneNodeDragMessage"} | DRAG | said

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
        cut = packed[: draw.randrange(len(packed))]
        yield draw.choices([packed, bytes(bent), cut, noise, draw.choice(bombs)], [6, 2, 1, 1, 1])[0]


def odd_requests(door, draw):
    """Requests of which few are right, without an end: a good one with some of its bytes cut, doubled and exchanged."""
    good = f"GET / HTTP/1.1\r\nHost: localhost:{door.port}\r\nCookie: {cookie_of(door)}\r\nOrigin: http://localhost:{door.port}\r\n\r\n"
    upgrade = f"GET / HTTP/1.1\r\nHost: localhost:{door.port}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\nCookie: a\r\n\r\n"
    pieces = (b"", b"\r\n", b"\x00", b":", b"[", b"]", b"\xff", b"GET ", b"%", b"?", b"//[::1", b"http://[", b"@", b"\n", b";")
    while True:
        data = bytearray(draw.choice((good, good, upgrade)).encode())
        for _ in range(draw.randint(1, 6)):
            at = draw.randrange(len(data) + 1)
            what = draw.choice((*pieces, bytes([draw.randrange(256)])))
            data[at : at + draw.randint(0, 3)] = what * draw.choice((1, 1, 1, 50))
        yield bytes(data)
