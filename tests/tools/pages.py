"""A page of the browser view without a browser: what it sends, as tests say it."""

import contextlib
import time
import urllib.parse

import msgspec
import viser
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


def wait(condition, seconds=30):
    deadline = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < deadline, "waited in vain"
        time.sleep(0.02)
    return found


def controls(shown):
    """Label -> (uuid, handle)."""
    return {handle.label: (uuid, handle) for uuid, handle in shown.server.gui._gui_input_handle_from_uuid.items()}


def drain(client):
    with contextlib.suppress(ConnectionClosed):
        while True:
            client.recv()
