"""A gamepad in the browser that steers the hand: a script in the page reports its state, which becomes motion here."""

import functools
import gzip
from collections.abc import Callable, Mapping
from typing import Annotated

import msgspec
import viser

from mjx_nero.tools.view.hand import Hand
from mjx_nero.tools.view.log import LOG
from mjx_nero.tools.view.orders import Orders

PATH = "/gamepad"  # of its websocket
RATE = 20  # messages a second
SPEED, TURN = 0.15, 60.0  # [m/s], [degrees/s] of a stick that is pushed all the way
REST = 0.15  # share of a stick's way in which it counts as let go
# Buttons of the standard layout (W3C, Gamepad, "Remapping"): the four on the right from the lowest on, and the middle left one.
GRIP, BACK, RECORD, SAVE, DISCARD = 0, 1, 2, 3, 8
HELP = "gamepad: left stick moves the hand, right stick lifts and turns it, A grips, B gives back, X records, Y saves"

# The browser tells a page of a gamepad once a button of it is pressed, and only the page that has the focus.
_SCRIPT = f"""<script>(() => {{
  let socket = null;
  setInterval(() => {{
    const pad = Array.from(navigator.getGamepads()).find((each) => each && each.connected && each.mapping === "standard");
    if (!pad) return;
    if (!socket || socket.readyState > 1) socket = new WebSocket(`ws://${{location.host}}{PATH}`, "viser-v{viser.__version__}");
    if (socket.readyState === 1 && !socket.bufferedAmount)
      socket.send(JSON.stringify({{ axes: pad.axes.slice(0, 4), buttons: pad.buttons.slice(0, 32).map((b) => b.pressed) }}));
  }}, {1000 // RATE});
}})();</script>"""

_Axis = Annotated[float, msgspec.Meta(ge=-1.0, le=1.0)]


class _Said(msgspec.Struct, forbid_unknown_fields=True):
    """The state of a gamepad: sticks to the right and down, the left one first, and which buttons are pressed."""

    axes: tuple[_Axis, _Axis, _Axis, _Axis]
    buttons: Annotated[list[bool], msgspec.Meta(max_length=32)]


_DECODER = msgspec.json.Decoder(_Said)


class Gamepad:
    """Steers a hand by the gamepads that pages report.

    Args:
        orders: where it is done.
        buttons: number of a button -> what a press of it does.
    """

    def __init__(self, hand: Hand, orders: Orders, buttons: Mapping[int, Callable[[], None]]):
        self._hand, self._orders, self._buttons = hand, orders, buttons
        self._held: set[int] = set()

    def hear(self, raw: bytes) -> None:
        """Takes a page's message; ignores everything else."""
        try:
            said = _DECODER.decode(raw)
        except (msgspec.MsgspecError, RecursionError) as error:
            LOG.warning("a gamepad's message was ignored: %s", error)
            return
        pressed = {i for i, on in enumerate(said.buttons) if on}
        for i in (pressed - self._held) & set(self._buttons):
            self._orders.give(("gamepad", i), self._buttons[i])
        self._held = pressed
        right, down, turn, sink = (0.0 if abs(x) < REST else x for x in said.axes)
        if right or down or sink:
            step = -SPEED / RATE
            self._orders.give("gamepad shifts", lambda: self._hand.shift((step * down, step * right, step * sink)))
        if turn:
            self._orders.give("gamepad turns", lambda: self._hand.turn(-TURN / RATE * turn))


@functools.lru_cache(maxsize=4)
def with_script(page: bytes) -> bytes:
    """viser's page with the script in it, packed as it came."""
    packed = page[:2] == b"\x1f\x8b"
    text = gzip.decompress(page) if packed else page
    text = text.replace(b"</head>", _SCRIPT.encode() + b"</head>", 1)
    return gzip.compress(text) if packed else text
