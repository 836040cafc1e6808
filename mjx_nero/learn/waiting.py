"""Waits for a program on the CPU so that signals are answered meanwhile.

Python handles a signal between two instructions of its main thread, and there are none while JAX computes there: minutes, if a
program draws pictures.
"""

import concurrent.futures
import threading
from collections.abc import Callable
from typing import Any

import jax


def result_of(function: Callable[..., Any], *args: Any) -> Any:
    """Returns what a compiled function returns. On a CPU another thread calls it and waits, so the caller can be interrupted.

    An accelerator's programs take a second, and stay in the thread that they were made in.
    """
    if jax.default_backend() != "cpu" or threading.current_thread() is not threading.main_thread():
        return function(*args)
    found = concurrent.futures.Future[Any]()

    def work() -> None:
        try:
            found.set_result(jax.block_until_ready(function(*args)))
        except BaseException as error:
            found.set_exception(error)

    threading.Thread(target=work, daemon=True).start()  # a program that is interrupted ends without it
    return found.result()
