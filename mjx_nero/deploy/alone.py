"""One program at a time has an arm, whatever its bus lets pass: two that send targets would tear it to and fro."""

import os
import socket

from mjx_nero.errors import UserError

_LONGEST = 90  # bytes of a name


def alone(name: str) -> socket.socket:
    """Takes a port or a file of this computer, until what is returned is closed, or the program ends, however it does.

    Args:
        name: of it; all paths to one file are one name.

    Raises:
        UserError: another program has it.
    """
    path = os.path.realpath(name) if name.startswith("/") else name
    taken = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        taken.bind(b"\0mjx_nero " + path.encode()[-_LONGEST:])  # an abstract name: no file is left behind
    except OSError:
        taken.close()
        raise UserError(f"{name} is in use by another program of this computer, which goes on: end that one first") from None
    return taken
