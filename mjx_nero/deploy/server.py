"""The arm's own process, with bus, safety layer and log. It holds the arm if the policy's process hangs or ends.

    python -m mjx_nero.deploy.server SOCKET

The policy's process (``remote.Remote``) starts it with the number of an open socket. Messages are JSON, one per packet; each
request, such as ``{"do": "read"}``, has one answer. After ``start``, silence of ``SafetyCfg.silence`` seconds is a fault, and so
is the end of the socket.
"""

import contextlib
import dataclasses
import json
import pathlib
import select
import signal
import socket
import sys
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy import drivers, setup
from mjx_nero.deploy.alone import alone
from mjx_nero.deploy.arm import ArmError, Feedback
from mjx_nero.deploy.fence import FenceCfg
from mjx_nero.deploy.guard import Dry, Guard, WallClock, urgent
from mjx_nero.deploy.identified import Offset
from mjx_nero.deploy.log import Log
from mjx_nero.deploy.safety import Fault, SafetyCfg
from mjx_nero.errors import UserError, missing

PACKET = 1 << 17  # maximum bytes of a message


@dataclasses.dataclass(frozen=True)
class Spec:
    """Everything that the arm's process must know, as plain values.

    Attributes:
        kind, options: driver and its options, see ``drivers.make``.
        metadata: metadata of the policy.
        safety, fence: fields of ``SafetyCfg`` and ``FenceCfg``.
        log: file of the log; empty: no log.
        dry: send nothing to the arm.
        offsets: encoder offsets of the joints [rad or m]; empty: all zero.
        notes: lines for the head of the log.
    """

    kind: str
    options: Mapping[str, Any]
    metadata: Mapping[str, Any]
    safety: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    fence: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    log: str = ""
    dry: bool = False
    notes: tuple[str, ...] = ()
    offsets: tuple[float, ...] = ()


class Server:
    """Answers requests about one arm.

    Raises:
        UserError, ArmError: the arm cannot be used.
    """

    def __init__(self, spec: Spec):
        self.spec, self.clock = spec, WallClock()
        self.cfg = SafetyCfg(**spec.safety)
        self.dt = float(spec.metadata["control_dt"])
        arm = drivers.make(spec.kind, spec.options, spec.metadata, self.clock)
        if any(spec.offsets):
            arm = Offset(arm, np.array(spec.offsets))
        self._arm = Dry(arm) if spec.dry else arm
        self._taken = [alone(name) for name in (*drivers.ports(spec.kind, spec.options), spec.log) if name]
        self._arm.connect()
        safety = setup.safety_of(spec.metadata, self.cfg, FenceCfg(**spec.fence), self._arm.ranges())
        self.guard, self.running, self.heard = Guard(self._arm, safety, self.clock), False, 0.0

    def answer(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """Answers one request with the fault and the requested value."""
        does: dict[str, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
            "start": self._start,
            "read": lambda _: plain(self.guard.read()),
            "command": self._command,
            "hold": self._hold,
        }
        try:
            found = does[request["do"]](request)
        except (UserError, ArmError) as error:
            found = {"error": str(error)}
        self.heard = self.clock.now()
        return {**found, "fault": self.guard.fault and dataclasses.astuple(self.guard.fault)}

    def _start(self, request: Mapping[str, Any]) -> dict[str, Any]:
        feedback = self.guard.start(bool(request["anywhere"]))
        if not self.running:  # an arm that cannot start gets no torque
            self._arm.engage()
            feedback = self.guard.start(bool(request["anywhere"]))
        if self.spec.log and self.guard.log is None:
            told, actions = self.guard.safety.position, int(request["actions"])
            path, joints = pathlib.Path(self.spec.log), self._arm.joints
            self.guard.log = Log(path, joints, told, self.clock.now(), actions, self.spec.notes)
        self.running = True
        return plain(feedback)

    def _command(self, request: Mapping[str, Any]) -> dict[str, Any]:
        command = self.guard.command(np.array(request["target"], float), request["notes"])
        out = {"position": command.position.tolist(), "velocity": command.velocity.tolist(), "limited": command.limited}
        return {**out, "sent": self.guard.sent}

    def _hold(self, request: Mapping[str, Any]) -> dict[str, Any]:
        self.guard.hold(Fault(*request["fault"]))
        return {}

    def watch(self) -> float:
        """Does what is due; returns the time until the next call is needed [s]."""
        if not self.running:
            return 1.0
        now, guard = self.clock.now(), self.guard
        if guard.fault is None and now - self.heard > self.cfg.silence:
            guard.hold(Fault("silence", f"the policy sent nothing for {1e3 * (now - self.heard):.0f} ms"))
        if guard.fault is None:
            return max(self.heard + self.cfg.silence - now, 0.0) + 1e-3
        if now - self.heard > self.dt and not guard.safety.at_rest:
            guard.read()
            guard.command(guard.safety.position)  # brakes
        return self.dt if not guard.safety.at_rest else 1.0


def plain(feedback: Feedback) -> dict[str, Any]:
    """Converts a feedback to plain values for JSON."""
    values = dataclasses.asdict(feedback)
    return {name: value.tolist() if isinstance(value, np.ndarray) else value for name, value in values.items()}


def serve(channel: socket.socket) -> None:
    """Answers until the other side closes the connection; then brakes, holds and ends."""
    spec = Spec(**json.loads(channel.recv(PACKET)))
    try:
        server = Server(spec)
    except (UserError, ArmError, ModuleNotFoundError) as error:
        said = missing(error) if isinstance(error, ModuleNotFoundError) else str(error)
        with contextlib.suppress(OSError):  # the other side waits no longer
            channel.send(json.dumps({"error": said}).encode())
        return
    try:
        channel.send(json.dumps({"fault": None}).encode())
        while True:
            ready, _, _ = select.select([channel], [], [], server.watch())
            if ready:
                packet = channel.recv(PACKET)
                if not packet:
                    break
                channel.send(json.dumps(server.answer(json.loads(packet))).encode())
    except (BrokenPipeError, ConnectionResetError):
        pass
    finally:
        server.guard.hold(Fault("silence", "the policy's process ended"))
        server.guard.close()
        if server.guard.log and server.guard.log.error:
            print(server.guard.log.error, file=sys.stderr, flush=True)


def main() -> None:
    """Runs the process."""
    for number in (signal.SIGINT, signal.SIGHUP):  # handled by the policy's process, which then tells this one
        signal.signal(number, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    with urgent():
        serve(socket.socket(fileno=int(sys.argv[1])))


if __name__ == "__main__":
    main()
