"""Arrays that take long to make, kept in the user's cache."""

import contextlib
from collections.abc import Callable

import numpy as np
from safetensors import SafetensorError
from safetensors import numpy as tensors

from mjx_nero import files
from mjx_nero.files import cache
from mjx_nero.types import UserError

_MAX_BYTES = 100_000_000  # of one file


def arrays(name: str, make: Callable[[], dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Returns what the cache holds under ``name``, or what ``make`` returns, which is then kept if possible."""
    folder = cache.folder()
    path = folder / "objects" / name if folder else None
    if path and path.is_file():
        with contextlib.suppress(UserError, SafetensorError):
            return tensors.load(files.read_bytes(path, _MAX_BYTES))
    made = {key: np.array(value, order="C") for key, value in make().items()}
    if path:
        with contextlib.suppress(UserError):
            files.write(path, tensors.save(made))
    return made
