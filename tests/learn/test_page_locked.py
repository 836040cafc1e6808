"""Memory of results: the right rows for each reader, never changed while they are read, and used again after that."""

import jax.numpy as jnp
import numpy as np

from mjx_nero.imitation.recording.page_locked import PageLocked


def rows(first, count):
    return np.arange(6 * first, 6 * (first + count), dtype=np.uint8).reshape(count, 2, 1, 3)


def test_each_reader_gets_its_rows_and_memory_is_used_again_once_nothing_reads_it():
    fetch = PageLocked(4)
    one, two = fetch(jnp.asarray(rows(0, 8)), [3, 4])
    np.testing.assert_array_equal(one, rows(0, 3))
    np.testing.assert_array_equal(two, rows(3, 4))
    frame, where = one[2], {x.ctypes.data for x in (one, two)}
    del one, two
    again, another = fetch(jnp.asarray(rows(20, 8)), [4, 4])  # a frame is still read: only one memory is free
    assert again.ctypes.data in where and another.ctypes.data not in where
    np.testing.assert_array_equal(frame, rows(2, 1)[0])
    np.testing.assert_array_equal(again, rows(20, 4))
    np.testing.assert_array_equal(another, rows(24, 4))


def test_results_of_another_shape_have_memory_of_their_own():
    fetch = PageLocked(2)
    (small,) = fetch(jnp.zeros((2, 1, 1, 3), jnp.uint8), [2])
    del small
    (large,) = fetch(jnp.asarray(rows(0, 2)), [2])
    np.testing.assert_array_equal(large, rows(0, 2))
