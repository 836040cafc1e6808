"""Steers the hand by a gamepad in the browser: a script in the page reports the gamepad's state, and this module moves the
hand."""

import functools
import gzip
from collections.abc import Callable, Mapping
from typing import Annotated

import msgspec
import viser

from mjx_nero.tools.view.hand import Hand
from mjx_nero.tools.view.log import LOG
from mjx_nero.tools.view.orders import Orders

PATH = "/gamepad"  # path of its websocket
RATE = 20  # messages per second
SPEED, TURN = 0.15, 60.0  # [m/s], [degrees/s] at full deflection of a stick
REST = 0.15  # dead zone, as a share of a stick's range
# Buttons of the standard layout (W3C, Gamepad, "Remapping"): the right cluster's bottom, right, left and top, and the left one of
# the center cluster.
GRIP, BACK, RECORD, SAVE, DISCARD = 0, 1, 2, 3, 8
HELP = "gamepad: left stick moves the hand, right stick lifts and turns it, A grips, B hands back control, X records, Y saves"

# A browser reports a gamepad only after one of its buttons was pressed, and only to the page that has the focus.
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
    """The state of a gamepad: right and down of the left stick, then of the right one, and whether each button is pressed."""

    axes: tuple[_Axis, _Axis, _Axis, _Axis]
    buttons: Annotated[list[bool], msgspec.Meta(max_length=32)]


_DECODER = msgspec.json.Decoder(_Said)


class Gamepad:
    """Steers a hand by the gamepads that pages report.

    Args:
        orders: thread that carries out the movements.
        buttons: number of a button -> action of pressing it.
    """

    def __init__(self, hand: Hand, orders: Orders, buttons: Mapping[int, Callable[[], None]]):
        self._hand, self._orders, self._buttons = hand, orders, buttons
        self._held: set[int] = set()

    def hear(self, raw: bytes) -> None:
        """Handles a page's message; ignores anything that is not a gamepad's state."""
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
    """Adds the script to viser's page, which stays compressed if it was."""
    packed = page[:2] == b"\x1f\x8b"
    text = gzip.decompress(page) if packed else page
    text = text.replace(b"</head>", _SCRIPT.encode() + b"</head>", 1)
    return gzip.compress(text) if packed else text
