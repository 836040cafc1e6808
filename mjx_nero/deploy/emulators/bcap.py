"""An emulated Cobotta Pro controller with its RG6: b-CAP over TCP and UDP, and Modbus over TCP.

In slave mode it executes a target every 8 ms. Three targets can wait; the sender of a fourth has to wait itself. If targets stop,
the controller leaves slave mode and the arm stands still. It counts what a runtime must never do: ``torque_cuts``.
"""

import contextlib
import dataclasses
import os
import select
import socket
import struct
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mjx_nero.deploy.drivers import bcap, cobotta, rg6
from mjx_nero.deploy.emulators.plant import Plant

_BUFFER, _LATE = 3, 4  # targets that can wait; cycles by which the next one may be late
_FAIL, _TOO_LATE = 0x80004005 - (1 << 32), 0x84201482 - (1 << 32)
_ARM = 6
_GRIPS = 0.1  # [m/s]: the RG6 opens and closes at 51 to 160 mm/s, by its data sheet
_FASTEST = 3.0  # maximum speed between two targets, as a multiple of the model's


@dataclasses.dataclass
class BusFaults:
    """Faults of the buses, which can be set while they run.

    Attributes:
        cut: nothing answers.
        corrupt: answers lose their last byte.
        closed: connections are closed at the next request.
        lost: every ``lost``-th answer to a datagram is lost; 0: none.
        error: result of every slvMove; 0: no error.
        tripped: a safety switch of the gripper has tripped.
    """

    cut: bool = False
    corrupt: bool = False
    closed: bool = False
    lost: int = 0
    error: int = 0
    tripped: bool = False


class Controller:
    """The controller: answers requests, and moves the plant.

    Args:
        speed: maximum speed of the arm's joints [rad/s].
        wait: whether senders must wait for their turn.
    """

    def __init__(self, plant: Plant, speed: np.ndarray, wait: bool = True):
        self.plant, self.faults, self.torque_cuts, self.slave = plant, BusFaults(), 0, False
        self._speed, self._wait, self._goal = speed, wait, plant.position()
        self._turn = self._before = 0.0
        self._width = self._grip_to = rg6.width(float(self._goal[_ARM]))
        plant.powered[:_ARM] = False
        plant.gears = 1e5  # brakes
        plant.model.opt.timestep = cobotta.CYCLE / 2  # frequent answers must not show the physics steps
        plant.stiffen()

    def answer(self, data: bytes) -> bytes:
        """Returns the answer to a packet."""
        try:
            serial, function, values = bcap.parse(data)
            result, value = self._do(function, values)
        except (bcap.Damaged, IndexError, TypeError, ValueError):
            return bcap.packet(struct.unpack_from("<H", data, 5)[0], _FAIL, [])
        return bcap.packet(serial, result, [value])

    def _do(self, function: int, values: list[Any]) -> tuple[int, Any]:
        if function in (bcap.CONNECT, bcap.GET_ROBOT):
            return 0, function
        if function == bcap.ROBOT_NAMES:
            return 0, ["Arm"]
        if function == bcap.EXECUTE:
            return self._execute(values[1], values[2])
        return (0, None) if function in (bcap.SERVICE_START, bcap.SERVICE_STOP, bcap.DISCONNECT, bcap.RELEASE) else (_FAIL, None)

    def _advance(self) -> None:
        """Catches up with the clock; the gripper moves to its width at its own speed."""
        now, left = self.plant.time, self._grip_to - self._width
        if left:
            most = _GRIPS * max(now - self._before, 0.0)
            self._width += min(max(left, -most), most)
            angle = rg6.angle(self._width)
            self._goal[_ARM:] = angle, -angle
            self.plant.target(self._goal)
        self._before = now
        self.plant.advance()

    def _execute(self, command: str, argument: Any) -> tuple[int, Any]:
        self._advance()
        if command == "HighCurJntEx":
            return 0, [0.0, *self._degrees()]
        if command == "Motor":
            on = bool(argument[0])
            self.torque_cuts += bool(self.plant.powered[:_ARM].any()) and not on
            self.plant.powered[:_ARM] = on
            self._goal[:_ARM] = self.plant.position()[:_ARM]
            self.plant.target(self._goal)
        elif command == "slvChangeMode":
            self.slave, self._turn = argument == cobotta.SLAVE, self.plant.time
        elif command == "slvMove":
            return self._move(np.radians(argument[:_ARM]))
        elif command == "GiveArm":
            self.torque_cuts += 1
        elif command not in ("TakeArm", "slvSendFormat", "slvRecvFormat"):
            return _FAIL, None
        return 0, None

    def _degrees(self) -> list[float]:
        return [*np.degrees(self.plant.position()[:_ARM]).tolist(), 0.0, 0.0]

    def _move(self, target: np.ndarray) -> tuple[int, Any]:
        if self.faults.error or not self.slave:
            self.slave = False
            return self.faults.error - (1 << 32) if self.faults.error else _FAIL, None
        now, cycle = self.plant.time, cobotta.CYCLE
        if now - self._turn > _LATE * cycle or np.any(np.abs(target - self._goal[:_ARM]) > _FASTEST * self._speed * cycle):
            self.slave = False
            return _TOO_LATE if now - self._turn > _LATE * cycle else _FAIL, None
        self._turn = max(self._turn + cycle, now)
        self._goal[:_ARM] = target
        self.plant.target(self._goal, self._turn - now)
        if self._wait and (early := self._turn - now - _BUFFER * cycle) > 0:
            time.sleep(early)
        self._advance()
        return 0, self._degrees()

    def grip(self, request: bytes) -> bytes:
        """Returns the gripper's answer to a Modbus request (functions 3 and 16)."""
        self._advance()
        head, (unit, function, first, count) = request[:4], struct.unpack(">BBHH", request[6:12])
        here = rg6.width(float(self.plant.position()[_ARM]))
        if function == 16 and first == rg6.FORCE and count == 3:
            _, width, control = struct.unpack(">HHH", request[13:19])
            if control == rg6.GRIP:
                self._grip_to = width * 1e-4
            body = struct.pack(">BBHH", unit, function, first, count)
        elif function == 3 and first == rg6.WIDTH and count <= 2:
            busy = self._width != self._grip_to or bool(abs(self.plant.velocity()[_ARM]) > 0.02)
            status = busy * rg6.BUSY | self.faults.tripped * 8
            body = struct.pack(">BBB", unit, function, 2 * count)
            body += struct.pack(">HH", max(0, round(here * 1e4)), status)[: 2 * count]
        else:
            body = struct.pack(">BBB", unit, function | 0x80, 2)
        return head + struct.pack(">H", len(body)) + body


class Port:
    """Controller and gripper at ports of this machine.

    Attributes:
        name, gripper: their addresses, for ``--port`` and ``--gripper``.
    """

    def __init__(self, controller: Controller):
        self.controller = controller
        self._arm, self._hand = (socket.create_server(("127.0.0.1", 0)) for _ in range(2))
        self.name, self.gripper = (f"127.0.0.1:{door.getsockname()[1]}" for door in (self._arm, self._hand))
        self._guests: dict[socket.socket, bool] = {}
        self._post = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._post.bind(self._arm.getsockname())
        self._before, self._count = (0, b""), 0

    def serve(self, until: Callable[[], bool] = lambda: False, other: int | None = None) -> None:
        """Answers requests, until ``until`` returns True or the file descriptor ``other`` ends."""
        while not until():
            watched: list[Any] = [self._arm, self._hand, self._post, *self._guests, *([] if other is None else [other])]
            ready, _, _ = select.select(watched, [], [], 0.02)
            if other in ready and not os.read(other or 0, 1000):
                return
            for door in {self._arm, self._hand} & set(ready):
                guest, _ = door.accept()
                guest.settimeout(0.5)
                guest.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._guests[guest] = door is self._arm
            if self._post in ready:
                self._reply()
            for guest in set(self._guests) & set(ready):
                self._serve(guest)

    def _reply(self) -> None:
        """Answers a datagram; a repeated one gets the same answer as before."""
        with contextlib.suppress(OSError, struct.error):
            data, sender = self._post.recvfrom(bcap.LONGEST)
            faults, (serial, first) = self.controller.faults, struct.unpack_from("<HH", data, 5)
            if first != self._before[0]:
                self._before = first, self.controller.answer(data)
            self._count += 1
            if not faults.cut and not (faults.lost and self._count % faults.lost == 0):
                answer = self._before[1]
                self._post.sendto(answer[:5] + struct.pack("<H", serial) + answer[7:], sender)

    def _serve(self, guest: socket.socket) -> None:
        faults, arm = self.controller.faults, self._guests[guest]
        with contextlib.suppress(OSError, bcap.Damaged, struct.error):
            if request := (bcap.receive(guest) if arm else guest.recv(256)):
                if not faults.closed:
                    answer = b"" if faults.cut else self.controller.answer(request) if arm else self.controller.grip(request)
                    guest.sendall(answer[:-1] + b"\0" if faults.corrupt and answer else answer)
                    return
        del self._guests[guest]
        guest.close()

    def close(self) -> None:
        """Closes all sockets."""
        for each in (self._arm, self._hand, self._post, *self._guests):
            each.close()


def port_of(plant: Plant, told: Mapping[str, Any]) -> Port:
    """Makes the arm that ``emulators.started`` describes."""
    return Port(Controller(plant, np.array(told["metadata"]["joints"]["speed"])[:_ARM]))
