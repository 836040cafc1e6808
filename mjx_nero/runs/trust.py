"""Trust: someone else's run may name any file in its config, so reading such a file needs the user's consent once.

A run that this user started here, or has trusted once, is marked in the user's cache folder by the fingerprint of its config.
"""

import contextlib
import hashlib
import pathlib
from collections.abc import Iterable

from mjx_nero import files
from mjx_nero.errors import UserError
from mjx_nero.files import cache
from mjx_nero.runs.folder import CONFIG


def mark(folder: pathlib.Path) -> None:
    """Marks the folder's run as the user's, with its present config. Without a cache folder nothing is kept."""
    place = _place(folder)
    if place is not None:
        with contextlib.suppress(UserError):
            files.write(place, b"")


def ask(folder: pathlib.Path, named: Iterable[str], trust: bool) -> None:
    """Checks that the files named by a run's config may be read.

    Args:
        named: paths of the files.
        trust: the user consents.

    Raises:
        UserError: the run is neither the user's own nor trusted.
    """
    named = list(named)
    if not named:
        return
    if trust:
        mark(folder)
        return
    place = _place(folder)
    if place is None or not place.is_file():
        raise UserError(
            f"{folder / CONFIG} names {named[0]!r}, outside the run's folder, and you did not start this run here: "
            "pass --trust if you trust whoever made it"
        )


def _place(folder: pathlib.Path) -> pathlib.Path | None:
    cached = cache.folder()
    content = files.read_bytes(files.inside(folder, CONFIG), files.MAX_JSON)
    return cached / "runs" / hashlib.sha256(content).hexdigest() if cached else None
