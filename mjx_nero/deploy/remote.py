"""The arm as the policy's process sees it: behind a socket, in a separate process that lives until the arm holds."""

import contextlib
import json
import socket
import subprocess
from collections.abc import Sequence
from typing import Any

import numpy as np

from mjx_nero.deploy import children
from mjx_nero.deploy.arm import ArmError, Feedback
from mjx_nero.deploy.safety import Command, Fault
from mjx_nero.deploy.server import PACKET, Spec
from mjx_nero.errors import UserError

_PATIENCE = 10.0  # time limit for an answer [s]; a bus fails long before


class Remote:
    """Starts the arm's process; see ``Guarded``. Other work can be done before ``ready`` is called.

    Attributes:
        fault, sent: see ``Guarded``, as of the last answer.
        pid: id of the process.
    """

    def __init__(self, spec: Spec):
        self.fault: Fault | None = None
        self.sent = 0.0
        told = json.dumps(vars(spec)).encode()
        if len(told) > PACKET:
            raise UserError(f"the policy describes its robot in {len(told):,} bytes: more than {PACKET:,} are not supported")
        self._channel, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._channel.settimeout(_PATIENCE)
        argv, own = children.command("mjx_nero.deploy.server", str(theirs.fileno())), children.environment()
        fds, none = (theirs.fileno(),), subprocess.DEVNULL
        self._process = subprocess.Popen(argv, pass_fds=fds, stdin=none, start_new_session=True, env=own)
        self.pid = self._process.pid
        theirs.close()
        self._channel.send(told)

    def ready(self) -> None:
        """Waits until the arm answers.

        Raises:
            UserError: the arm cannot be used.
        """
        self._hear()

    def start(self, anywhere: bool = False, actions: int = 0) -> Feedback:
        """See ``Guard.start``.

        Args:
            actions: size of an action, for the log.

        Raises:
            UserError: the arm is far from home, or already at fault.
        """
        return _feedback(self._ask({"do": "start", "anywhere": anywhere, "actions": actions}))

    def read(self) -> Feedback:
        """See ``Guard.read``."""
        return _feedback(self._ask({"do": "read"}))

    def command(self, target: np.ndarray, notes: Sequence[float] = ()) -> Command:
        """See ``Guard.command``."""
        told = self._ask({"do": "command", "target": np.asarray(target).tolist(), "notes": [float(x) for x in notes]})
        self.sent = told["sent"]
        return Command(np.array(told["position"]), np.array(told["velocity"]), tuple(told["limited"]))

    def hold(self, fault: Fault) -> None:
        """See ``Guard.hold``."""
        self._ask({"do": "hold", "fault": [fault.kind, fault.text]})

    def close(self) -> None:
        """Closes the connection: the arm brakes and holds, and its process ends.

        Raises:
            ArmError: its process does not end, even when it is told to.
        """
        self._channel.close()
        for end in (self._process.terminate, lambda: None):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_PATIENCE)
                return
            end()
        raise ArmError(f"the arm's process {self.pid} does not end: cut the arm's power, and kill that process")

    def _ask(self, request: dict[str, Any]) -> dict[str, Any]:
        try:
            self._channel.send(json.dumps(request).encode())
        except OSError:
            raise ArmError("the arm's process has ended: the drives hold their last target") from None
        return self._hear()

    def _hear(self) -> dict[str, Any]:
        try:
            packet = self._channel.recv(PACKET)
        except OSError:
            packet = b""
        if not packet:
            raise ArmError("the arm's process does not answer: the drives hold their last target")
        answer = json.loads(packet)
        if "error" in answer:
            raise UserError(answer["error"])
        self.fault = Fault(*answer["fault"]) if answer["fault"] else None
        return answer


def _feedback(answer: dict[str, Any]) -> Feedback:
    arrays = {name: None if answer[name] is None else np.array(answer[name], float) for name in ("load", "temperature")}
    return Feedback(answer["time"], np.array(answer["position"], float), np.array(answer["velocity"], float), **arrays)
