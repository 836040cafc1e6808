"""Callers that wait are served together, each with its own rows; an error reaches all that it concerns."""

import threading
from concurrent.futures import ThreadPoolExecutor

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero.imitation.recording.batches import Batches


def test_callers_that_wait_are_served_together():
    """While the first call works, four more come: two batches follow, as no batch has room for all of their ten rows."""
    calls, first, go = [], threading.Event(), threading.Event()

    def double(given):
        calls.append(given["x"][:, 0].tolist())
        if len(calls) == 1:
            first.set()
            assert go.wait(30)
        return jnp.asarray(2 * given["x"])

    work, rows = Batches(double, (1, 4, 8)), [np.arange(3)[:, None] + 10.0 * i for i in range(5)]
    rows[4] = rows[4][:1]
    with ThreadPoolExecutor(5) as pool:
        asked = [pool.submit(work, {"x": rows[0]})]
        assert first.wait(30)
        for given in rows[1:]:
            asked.append(pool.submit(work, {"x": given}))
            while len(work._waiting) < len(asked) - 1:
                pass
        go.set()
        for given, found in zip(rows, asked, strict=True):
            np.testing.assert_array_equal(found.result(30), 2 * given)
    assert calls == [
        [0, 1, 2, 2],  # filled up with the last row, to a size that there is a program of
        [10, 11, 12, 20, 21, 22, 22, 22],
        [30, 31, 32, 40],
    ]


def test_an_error_is_every_waiting_callers():
    def fails(given):
        raise ValueError("no picture")

    work = Batches(fails, (4,))
    with ThreadPoolExecutor(4) as pool:
        for asked in [pool.submit(work, np.zeros((2, 1))) for _ in range(4)]:
            with pytest.raises(ValueError, match="no picture"):
                asked.result(30)
