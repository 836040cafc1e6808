"""The log of a run: the table that ``identify`` reads, with further columns for gripper, velocities, actions and times.

    time,target.joint1,...,position.joint1,...,velocity.joint1,...,inferring,inferred,limited,held,action.0,...

Each feedback and each command makes a row; times are seconds since the log began. ``target`` is what was sent to the drives. Rows
are written immediately, so that a log is complete up to the moment its program ends. A thread writes them, because the arm must
never wait for a disk.
"""

import pathlib
import queue
import threading
from collections.abc import Sequence

import numpy as np

from mjx_nero.deploy.arm import Feedback
from mjx_nero.deploy.safety import Command, Fault
from mjx_nero.errors import UserError


class Log:
    """Writes a run's table.

    Args:
        joints: names of all joints, in the order of the arrays.
        start: targets at the beginning [rad or m].
        begun: time of the beginning [s].
        actions: size of an action.
        notes: lines for the head of the file.

    Attributes:
        error: why the log ends early; empty if it does not.

    Raises:
        UserError: the file cannot be written.
    """

    def __init__(
        self, path: pathlib.Path, joints: Sequence[str], start: np.ndarray, begun: float, actions: int, notes: Sequence[str] = ()
    ):
        self._n, self._begun, self._actions, self._last = len(joints), begun, actions, -1e-6
        columns = [f"{what}.{j}" for what in ("target", "position", "velocity") for j in joints]
        head = ["time", *columns, "inferring", "inferred", "limited", "held", *(f"action.{i}" for i in range(actions))]
        try:
            self._file = open(path, "w", buffering=1)
            self._file.writelines(f"# {' '.join(note.split())}\n" for note in notes)
            self._file.write(",".join(head) + "\n")
        except OSError as error:
            raise UserError(f"cannot write {path}: {error.strerror or error}") from None
        self.error, self._rows = "", queue.SimpleQueue[str]()
        self._thread = threading.Thread(target=self._write, daemon=True)
        self._thread.start()
        self._row(begun, start, None, None)

    def read(self, feedback: Feedback) -> None:
        """Adds a row for a feedback."""
        if feedback.time > self._begun + self._last:  # ignores feedback that is already logged
            self._row(feedback.time, None, feedback.position, feedback.velocity)

    def sent(self, time: float, told: np.ndarray, command: Command, fault: Fault | None, notes: Sequence[float]) -> None:
        """Adds a row for a command.

        Args:
            notes: start and end of inference [s], then the action.
        """
        times = [f"{t - self._begun:.6f}" for t in notes[:2]] or ["", ""]
        action = [f"{x:.6g}" for x in notes[2:]] or [""] * self._actions
        self._row(time, told, None, None, [*times, "+".join(command.limited), fault.kind if fault else "", *action])

    def _row(
        self, time: float, told: np.ndarray | None, at: np.ndarray | None, speed: np.ndarray | None, rest: Sequence[str] = ()
    ) -> None:
        self._last = max(time - self._begun, self._last + 1e-6)  # readers need ascending times
        cells = [f"{self._last:.7f}"]
        for values in (told, at, speed):
            cells += [""] * self._n if values is None else [f"{x:.7g}" for x in values]
        self._rows.put(",".join([*cells, *(rest or [""] * (4 + self._actions))]) + "\n")

    def _write(self) -> None:
        try:
            with self._file:
                while row := self._rows.get():
                    self._file.write(row)
        except OSError as error:  # a full disk must not stop the arm
            self.error = f"the log {self._file.name} ends early: {error.strerror or error}"

    def close(self) -> None:
        """Writes the remaining rows and closes the file."""
        self._rows.put("")
        self._thread.join()
