"""Lets only one program at a time use an arm, whatever its bus allows: targets from two programs would tear it to and fro."""

import os
import socket

from mjx_nero.errors import UserError

_LONGEST = 90  # maximum bytes of a name


def alone(name: str) -> socket.socket:
    """Reserves a port or a file of this computer, until the returned socket is closed or the program ends in any way.

    Args:
        name: name of the port or file; all paths to the same file count as one name.

    Raises:
        UserError: another program has reserved it.
    """
    path = os.path.realpath(name) if name.startswith("/") else name
    taken = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
    try:
        taken.bind(b"\0mjx_nero " + path.encode()[-_LONGEST:])  # an abstract name leaves no file behind
    except OSError:
        taken.close()
        raise UserError(f"{name} is in use by another program on this computer: end that program first") from None
    return taken
