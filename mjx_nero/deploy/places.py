"""Sources of object poses from outside: a constant, a file, or a tracker's datagrams or lines."""

import contextlib
import dataclasses
import json
import math
import pathlib
import socket
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import numpy as np

from mjx_nero import files
from mjx_nero.errors import UserError

LONGEST = 4096  # maximum bytes of a message
FRESH = 0.5  # maximum age of a pose from a tracker or a camera [s]
_FAR = 10.0  # maximum coordinate of an object [m]


@dataclasses.dataclass(frozen=True)
class Place:
    """Position [m] and orientation (wxyz) in the robot's root frame."""

    position: np.ndarray
    quaternion: np.ndarray


class Lost(ValueError):
    """The pose of an object is unknown or too old. ``kind``: kind of the fault."""

    kind = "object"


class Places(Protocol):
    """A source of object poses."""

    def find(self, name: str, now: float) -> Place:
        """Returns the pose of an object.

        Args:
            now: the time [s].

        Raises:
            Lost: it is unknown or too old.
        """

    def close(self) -> None:
        """Closes sockets."""


def parse(text: bytes | str) -> list[tuple[str | None, Place]]:
    """Parses the messages in a text.

    Raises:
        ValueError: the text holds something else.
    """
    if len(text) > LONGEST:
        raise ValueError(f"longer than {LONGEST} bytes")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("not JSON") from None
    return [_message(item) for item in (found if isinstance(found, list) else [found])]


def _message(item: Any) -> tuple[str | None, Place]:
    if not isinstance(item, Mapping) or "position" not in item:
        raise ValueError("it has no position")
    name = item.get("object")
    if not (name is None or isinstance(name, str)):
        raise ValueError("object takes a name")
    position, quat = _numbers(item["position"], 3), _numbers(item.get("quaternion", [1, 0, 0, 0]), 4)
    if np.abs(position).max() > _FAR or not 0.99 < np.linalg.norm(quat) < 1.01:
        raise ValueError(f"position takes metres up to {_FAR:g}, and quaternion has length 1 (wxyz)")
    return name, Place(position, quat)


def _numbers(value: Any, count: int) -> np.ndarray:
    right = isinstance(value, list) and len(value) == count
    if not right or not all(isinstance(x, int | float) and not isinstance(x, bool) and math.isfinite(x) for x in value):
        raise ValueError(f"takes {count} numbers")
    return np.array(value, float)


class Everywhere:
    """Every object, at one place in front of the robot; for tries without an arm."""

    def find(self, name: str, now: float) -> Place:
        """See ``Places``."""
        return Place(np.array([0.3, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))

    def close(self) -> None:
        """See ``Places``."""


class Known:
    """Poses that were reported, each with its time.

    Args:
        fresh: how long a pose is valid [s].
    """

    def __init__(self, fresh: float = math.inf):
        self.fresh, self.refused = fresh, 0
        self._places: dict[str | None, tuple[float, Place]] = {}

    def say(self, text: bytes | str, now: float) -> None:
        """Stores the poses of a message; invalid messages are counted in ``refused``."""
        try:
            self._places.update({name: (now, place) for name, place in parse(text)})
        except ValueError:
            self.refused += 1

    def find(self, name: str, now: float) -> Place:
        """See ``Places``."""
        told, place = self._places.get(name) or self._places.get(None) or (-math.inf, None)
        if place is None:
            raise Lost(f"nobody has said where the {name} is")
        if now - told > self.fresh:
            raise Lost(f"the {name} was last seen {now - told:.1f} s ago")
        return place

    def close(self) -> None:
        """Does nothing: there is nothing to close."""


class FromFile(Known):
    """Poses from a file that another program may replace at any time.

    Raises:
        UserError: it cannot be read now, or holds no pose.
    """

    def __init__(self, path: pathlib.Path):
        super().__init__()
        self._path, self._stamp = path, -1
        content = files.read_bytes(path, LONGEST)
        try:
            parse(content)
        except ValueError as error:
            raise UserError(f"{path} does not hold the position of an object: {error}") from None

    def find(self, name: str, now: float) -> Place:
        """See ``Places``."""
        with contextlib.suppress(OSError, UserError):  # it is being replaced
            if (stamp := self._path.stat().st_mtime_ns) != self._stamp:
                self.say(files.read_bytes(self._path, LONGEST), now)
                self._stamp = stamp
        return super().find(name, now)


class FromSocket(Known):
    """Poses from a tracker's datagrams, sent to ``udp://HOST:PORT``, or lines, from ``tcp://HOST:PORT``. The newest counts.

    Raises:
        UserError: the address is taken, or nothing answers.
    """

    def __init__(self, kind: str, host: str, port: int):
        super().__init__(FRESH)
        self._lines, self._rest = kind == "tcp", b""
        try:
            if self._lines:
                self._socket = socket.create_connection((host, port), timeout=2.0)
            else:
                self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
                self._socket.bind((host, port))
        except OSError as error:
            raise UserError(f"cannot get object positions from {kind}://{host}:{port}: {error.strerror or error}") from None
        self._socket.setblocking(False)
        self.port = self._socket.getsockname()[1]

    def find(self, name: str, now: float) -> Place:
        """See ``Places``."""
        for text in self._news():
            self.say(text, now)
        return super().find(name, now)

    def _news(self) -> list[bytes]:
        """Returns the texts that have arrived since the last call, oldest first."""
        found: list[bytes] = []
        for _ in range(1000):  # limits the work per step if a sender never stops
            try:
                chunk = self._socket.recv(LONGEST + 1)
            except OSError:
                break
            if self._lines and not chunk:
                break
            found.append(chunk)
        if self._lines:
            *found, self._rest = (self._rest + b"".join(found)).split(b"\n")
            self._rest = self._rest[-LONGEST:]
        return [text for text in found if text.strip()]

    def close(self) -> None:
        """See ``Places``."""
        self._socket.close()


def of(text: str) -> Places:
    """Opens the source that a flag names: ``0.35,0.02,0.015``, a file's path, ``udp://HOST:PORT`` or ``tcp://HOST:PORT``.

    Raises:
        UserError: it is none of these, or cannot be opened.
    """
    kind, separator, rest = text.partition("://")
    if separator:
        host, _, port = rest.rpartition(":")
        if kind not in ("udp", "tcp") or not host or not port.isdecimal() or not 0 <= int(port) < 65536:
            raise UserError(f"an object's address takes udp://HOST:PORT or tcp://HOST:PORT, got {text[:80]!r}")
        return FromSocket(kind, host, int(port))
    return _constant(text) or FromFile(pathlib.Path(text))


def _constant(text: str) -> Known | None:
    try:
        numbers = [float(x) for x in text.split(",")]
    except ValueError:
        return None
    known = Known()
    known.say(json.dumps({"position": numbers[:3], **({"quaternion": numbers[3:]} if len(numbers) > 3 else {})}), 0.0)
    if known.refused:
        raise UserError(f"an object's place takes x,y,z [m], optionally with an orientation w,x,y,z, got {text[:80]!r}")
    return known


Sender = Callable[[str, np.ndarray, np.ndarray], None]


def sender(host: str, port: int) -> Sender:
    """Returns a function ``(name, position, quaternion)`` that sends a pose as a datagram for ``FromSocket``."""
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    out.setblocking(False)

    def send(name: str, position: np.ndarray, quaternion: np.ndarray) -> None:
        message = {"object": name, "position": position.tolist(), "quaternion": quaternion.tolist()}
        with contextlib.suppress(OSError):  # nobody listens
            out.sendto(json.dumps(message).encode(), (host, port))

    return send
