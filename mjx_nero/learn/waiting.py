"""Waits for a program on the CPU in a way that lets signals be handled meanwhile.

Python handles a signal between two instructions of its main thread. While JAX computes there, no instruction ends, which takes
minutes if a program draws pictures.
"""

import concurrent.futures
import functools
import threading
from collections.abc import Callable
from typing import Any

import jax


def result_of(function: Callable[..., Any], *args: Any) -> Any:
    """Calls a compiled function and returns its result. On a CPU another thread calls it, so that the caller can be interrupted.

    An accelerator's programs take about a second, and stay in the calling thread.
    """
    return begun(function, *args, daemon=True)()  # an interrupted program does not wait for it


def ahead(function: Callable[..., Any], *args: Any) -> Callable[[], Any]:
    """Begins a call of a compiled function, goes on beside it, and returns the function that waits for its result."""
    if jax.default_backend() == "cpu":
        return begun(function, *args)
    found = function(*args)  # a device still computes it
    return lambda: found


def begun(function: Callable[..., Any], *args: Any, daemon: bool = False) -> Callable[[], Any]:
    """Begins a call as ``result_of`` does, and returns the function that waits for its result.

    Nothing begins before that function is called if the call stays in the calling thread.

    Args:
        daemon: the program may end while the call goes on. JAX may crash then.
    """
    if jax.default_backend() != "cpu" or threading.current_thread() is not threading.main_thread():
        return functools.partial(function, *args)
    found = concurrent.futures.Future[Any]()

    def work() -> None:
        try:
            found.set_result(jax.block_until_ready(function(*args)))
        except BaseException as error:
            found.set_exception(error)

    threading.Thread(target=work, daemon=daemon).start()
    return found.result
