"""Buttons, sliders and keys for the hand, beside the picture."""

from collections.abc import Callable
from typing import Any

from mjx_nero.errors import UserError
from mjx_nero.tools.view import gamepad
from mjx_nero.tools.view import leader as leader_arm
from mjx_nero.tools.view.hand import NAME, STEP, TURN, Hand, Recording
from mjx_nero.tools.view.orders import Orders
from mjx_nero.tools.view.panel import Panel

KEYS = (  # key, its label, by how much it shifts the hand [m]
    ("arrowup", "hand away (x)", (STEP, 0.0, 0.0)),
    ("arrowdown", "hand back (x)", (-STEP, 0.0, 0.0)),
    ("arrowleft", "hand left (y)", (0.0, STEP, 0.0)),
    ("arrowright", "hand right (y)", (0.0, -STEP, 0.0)),
    ("pageup", "hand up", (0.0, 0.0, STEP)),
    ("pagedown", "hand down", (0.0, 0.0, -STEP)),
)

WHEN = ("when I say", "while I steer")  # the second records only the user's corrections, and nothing that the policy does

OWN = (NAME, leader_arm.NAME)  # agents that the user steers


class HandPanel:
    """The folder ``Hand``.

    Args:
        server: a ``viser.ViserServer``.
        panel: its dropdown says which agent acts.
        recording: recorder of demonstrations; None: there is none.
        leader: lets a leader arm take over; None: there is none.
    """

    def __init__(
        self,
        server,
        panel: Panel,
        hand: Hand,
        recording: Recording | None,
        orders: Orders,
        leader: Callable[[], object] | None = None,
    ):
        self._panel, self._hand, self._recording, self._orders = panel, hand, recording, orders
        self._before, self._gui = panel.agent.value, server.gui
        panel.parameters[NAME] = hand.begin
        gui = server.gui
        with gui.add_folder("Hand", expand_by_default=recording is not None):
            gui.add_markdown(f"drag the hand; arrows, page up and down move it, Z and X turn it, space grips\n\n{gamepad.HELP}")
            self.open = gui.add_slider("Open", min=0.0, max=1.0, step=0.01, initial_value=1.0)
            self.open.on_update(lambda _: orders.give("grip", lambda: hand.grip(self.open.value)))
            self._button("Give back", self.give_back)
            if leader:
                self._button("Follow the leader arm (L)", leader)
                self._key("follow the leader arm", "L", leader)
            if recording is not None:  # a recording without steps counts as false
                self._when = gui.add_dropdown("Record", WHEN, initial_value=WHEN[0])
                for label, key, work in self._recorder(recording):
                    self._button(f"{label} ({key})", work)
                    self._key(label, key, work)
            self._message = gui.add_markdown("")
        for key, label, by in KEYS:
            self._key(label, key, lambda by=by: hand.shift(by))  # type: ignore[misc]
        for key, degrees in (("Z", TURN), ("X", -TURN)):
            self._key(f"turn the hand by {degrees:g} degrees", key, lambda degrees=degrees: hand.turn(degrees))  # type: ignore[misc]
        self._key("open or close the gripper", "space", self._grip)
        buttons = {gamepad.GRIP: self._grip, gamepad.BACK: self.give_back}
        if recording is not None:
            buttons |= {gamepad.RECORD: recording.begin, gamepad.SAVE: self._save, gamepad.DISCARD: recording.discard}
        self.gamepad = gamepad.Gamepad(hand, orders, buttons)

    def _recorder(self, recording: Recording) -> tuple[tuple[str, str, Callable[[], None]], ...]:
        return (
            ("Record", "R", recording.begin),
            ("Discard", "D", recording.discard),
            ("Replay", "P", lambda: self._panel.replay(recording.tape())),
            ("Save", "S", self._save),
        )

    def take_over(self, name: str = NAME) -> bool:
        """Lets the hand or another of the user's agents act; returns True if a different agent acted until now."""
        if self._panel.agent.value == name:
            return False
        if self._panel.agent.value not in OWN:
            self._before = self._panel.agent.value
        self._panel.agent.value = name
        if (mine := self._of_corrections) is not None:
            mine.begin()
        return True

    def give_back(self) -> None:
        """Lets the previous agent act again, for example after the user has corrected a policy."""
        if self._panel.agent.value in OWN and self._before not in OWN:
            self._panel.agent.value = self._before
            if self._of_corrections:
                self._save()

    @property
    def _of_corrections(self) -> Recording | None:
        """Returns the recorder if it records only the user's corrections."""
        return self._recording if self._recording is not None and self._when.value == WHEN[1] else None

    def _grip(self) -> None:
        self._set_open(0.0 if self._hand.open > 0.5 else 1.0)

    def _set_open(self, share: float) -> None:
        self.open.value = share
        self._hand.grip(share)

    def _save(self) -> None:
        assert self._recording
        try:
            self._message.content = self._recording.save()
        except UserError as error:
            self._message.content = f"**{error}**"

    def _button(self, label: str, work: Callable[[], object]) -> None:
        self._gui.add_button(label).on_click(lambda _: self._orders.give(label, work))

    def _key(self, label: str, key: Any, work: Callable[[], object]) -> None:
        self._gui.add_command(label, hotkey=key).on_trigger(lambda _: self._orders.give(label, work))
