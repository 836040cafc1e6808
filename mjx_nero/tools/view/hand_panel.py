"""Buttons, sliders and keys of the hand, beside the picture."""

from collections.abc import Callable
from typing import Any

from mjx_nero.errors import UserError
from mjx_nero.tools.view.hand import NAME, STEP, TURN, Hand, Recording
from mjx_nero.tools.view.orders import Orders
from mjx_nero.tools.view.panel import Panel

KEYS = (  # key, what it does, how far it shifts the hand
    ("arrowup", "hand away (x)", (STEP, 0.0, 0.0)),
    ("arrowdown", "hand back (x)", (-STEP, 0.0, 0.0)),
    ("arrowleft", "hand left (y)", (0.0, STEP, 0.0)),
    ("arrowright", "hand right (y)", (0.0, -STEP, 0.0)),
    ("pageup", "hand up", (0.0, 0.0, STEP)),
    ("pagedown", "hand down", (0.0, 0.0, -STEP)),
)


class HandPanel:
    """The folder ``Hand``.

    Args:
        server: a ``viser.ViserServer``.
        panel: knows who acts.
        recording: None: nothing is recorded.
    """

    def __init__(self, server, panel: Panel, hand: Hand, recording: Recording | None, orders: Orders):
        self._panel, self._hand, self._recording, self._orders = panel, hand, recording, orders
        self._before, self._gui = panel.agent.value, server.gui
        panel.parameters[NAME] = hand.begin
        gui = server.gui
        with gui.add_folder("Hand", expand_by_default=recording is not None):
            gui.add_markdown("drag the hand; arrows, page up and down move it, Z and X turn it, space grips")
            self.open = gui.add_slider("Open", min=0.0, max=1.0, step=0.01, initial_value=1.0)
            self.open.on_update(lambda _: orders.give("grip", lambda: hand.grip(self.open.value)))
            self._button("Give back", self.give_back)
            recorder = (
                (("Record", "R", recording.begin), ("Discard", "D", recording.discard), ("Save", "S", self._save))
                if recording
                else ()
            )
            for label, key, work in recorder:
                self._button(f"{label} ({key})", work)
                self._key(label, key, work)
            self._message = gui.add_markdown("")
        for key, label, by in KEYS:
            self._key(label, key, lambda by=by: hand.shift(by))  # type: ignore[misc]
        for key, degrees in (("Z", TURN), ("X", -TURN)):
            self._key(f"turn the hand by {degrees:g} degrees", key, lambda degrees=degrees: hand.turn(degrees))  # type: ignore[misc]
        self._key("open or close the gripper", "space", lambda: self._set_open(0.0 if hand.open > 0.5 else 1.0))

    def take_over(self) -> bool:
        """Lets the hand act; True if somebody else acted till now."""
        if self._panel.agent.value == NAME:
            return False
        self._before, self._panel.agent.value = self._panel.agent.value, NAME
        return True

    def give_back(self) -> None:
        """Whoever acted before does so again, as after a policy's error that the user has mended."""
        if self._panel.agent.value == NAME and self._before != NAME:
            self._panel.agent.value = self._before

    def _set_open(self, share: float) -> None:
        self.open.value = share
        self._hand.grip(share)

    def _save(self) -> None:
        assert self._recording
        try:
            self._message.content = self._recording.save()
        except UserError as error:
            self._message.content = f"**{error}**"

    def _button(self, label: str, work: Callable[[], None]) -> None:
        self._gui.add_button(label).on_click(lambda _: self._orders.give(label, work))

    def _key(self, label: str, key: Any, work: Callable[[], None]) -> None:
        self._gui.add_command(label, hotkey=key).on_trigger(lambda _: self._orders.give(label, work))
