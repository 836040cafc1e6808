"""Host memory that a GPU copies into directly, used again and again.

Fresh memory takes longer than the copy: the system clears it page by page, and the driver copies through buffers of its own.
"""

import collections
import weakref
from collections.abc import Sequence
from typing import Any

import jax
import numpy as np


class PageLocked:
    """Copies a GPU's results to the host, for several readers. A reader's memory is used again once nothing reads it any more.

    Args:
        rows: the most rows of one reader.
    """

    def __init__(self, rows: int):
        import warp as wp

        wp.init()
        self._rows = rows
        self._stream: Any = None  # our own, made at the first copy
        self._free: dict[tuple, collections.deque[Any]] = collections.defaultdict(collections.deque)  # by shape and type

    def __call__(self, found: jax.Array, counts: Sequence[int]) -> list[np.ndarray]:
        """Returns the first rows of ``found`` [rows, ...] for the first reader, the following for the next one, and so on.

        Args:
            counts: numbers of rows of the readers.
        """
        import warp as wp

        source: Any = wp.from_jax(found)
        on_gpu, row, begin, out = source.device.is_cuda, source.size // len(found), 0, []
        if on_gpu and not self._stream:
            self._stream = wp.Stream(source.device)
        for count in counts:
            free = self._free[source.shape[1:], source.dtype]
            memory = free.pop() if free else self._new(source, on_gpu)
            wp.copy(memory, source, src_offset=begin * row, count=count * row, stream=self._stream)
            shown = memory.numpy()
            weakref.finalize(shown, free.append, memory)  # every view of it keeps ``shown``
            out.append(shown[:count])
            begin += count
        if on_gpu:
            wp.synchronize_stream(self._stream)
        return out

    def _new(self, source: Any, on_gpu: bool) -> Any:
        import warp as wp

        return wp.empty((self._rows, *source.shape[1:]), dtype=source.dtype, device="cpu", pinned=on_gpu)
