"""Signals end a program, whatever it does. In training the first lets it save; the second ends it, within compiled code, too."""

import contextlib
import os
import signal
import subprocess
import sys
import time

import pytest

from mjx_nero.runs import signals

PROGRAM = """
import ctypes, os, signal, time
from mjx_nero.runs import signals

def within():
    for _ in range({times}):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep({apart})
    return 0

with signals.after_this(print) as stop:
    ctypes.CFUNCTYPE(ctypes.c_int)(within)()
    print("went on", stop.code, flush=True)
"""


def run(program, **options):
    return subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=600, **options)


@pytest.mark.parametrize("times", [1, 2])
def test_after_one_signal_it_goes_on(times):
    """Two at once are one: ``timeout`` signals a program, and then the program's group."""
    done = run(PROGRAM.format(times=times, apart=0.0))
    assert (done.returncode, done.stderr) == (0, "") and "went on 143" in done.stdout


def test_a_second_within_a_callback_ends_it():
    done = run(PROGRAM.format(times=2, apart=2 * signals.SAME))
    assert (done.returncode, done.stderr) == (143, "") and "went on" not in done.stdout


SLOW = """
import os, signal, threading, time
import jax, numpy as np
from mjx_nero.learn import waiting
from mjx_nero.runs import signals

def minutes(x):
    time.sleep(600)
    return x

def send():
    time.sleep(0.5)
    os.kill(os.getpid(), signal.SIGINT)

def said(text):
    print(text, flush=True)
    threading.Thread(target=send).start()

with signals.after_this(said):
    threading.Thread(target=send).start()
    waiting.result_of(jax.jit(lambda x: jax.pure_callback(minutes, x, x)), np.float32(1))
"""


def test_signals_are_answered_while_a_program_computes():
    """The first one is told of while the program goes on; the second one ends it long before its minutes are over."""
    done = subprocess.run([sys.executable, "-c", SLOW], capture_output=True, text=True, timeout=300)
    assert done.returncode == 130, done.stderr
    assert "stopping after this update" in done.stdout


COMMAND = """
import gc, os, pathlib, signal, sys, time
from mjx_nero.runs import signals
from mjx_nero.tools import cli

signals.AGAIN = 0.2

def send(*_):
    gc.callbacks.clear()
    os.kill(os.getpid(), signal.SIGTERM)

class Dying:
    def __del__(self):
        send()

def main(_):
    try:
        {body}
        time.sleep(30)
        print("went on")
    finally:
        deadline = time.monotonic() + 3 * signals.AGAIN
        while time.monotonic() < deadline:
            pass
        print("cleaned up", flush=True)

cli.run(main)
"""
DROPPED = {
    "a destructor": "Dying()",
    "the garbage collector": "gc.callbacks.append(send); gc.collect()",
    "a library": "exec('try: send()\\nexcept: pass')",
    "a library, long after": "exec('try: send()\\nexcept: time.sleep(0.5)')",
    "an error of another kind": "exec('try: send()\\nexcept BaseException: raise ImportError from None')",
    "nothing": "send()",
}


@pytest.mark.parametrize("where", DROPPED)
def test_a_signal_ends_a_command_though_its_exception_is_dropped(where):
    """In one line, with the signal's status, and after a clean-up that nothing interrupts."""
    done = run(COMMAND.format(body=DROPPED[where]))
    assert (done.returncode, done.stdout, done.stderr) == (143, "cleaned up\n", "interrupted\n")


LOADING = """
class ExtensionFileLoader:  # as Python's own is called
    def exec_module(self):
        send()
        print("imported", flush=True)

ExtensionFileLoader().exec_module()
"""


def test_an_import_of_compiled_code_is_completed_first():
    """Libraries written in C++ abort, or print a traceback, when what they import raises."""
    done = run(COMMAND.format(body=f"exec({LOADING!r}, globals())"))
    assert (done.returncode, done.stdout, done.stderr) == (143, "imported\ncleaned up\n", "interrupted\n")


def test_ctrl_c_while_a_program_still_imports_says_nothing(tmp_path):
    (tmp_path / "argparse.py").write_text("import os, signal, time\nos.kill(os.getpid(), signal.SIGINT)\ntime.sleep(30)\n")
    ignored = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "  # may be so in the background
    done = run(ignored + "from mjx_nero.__main__ import program; program()", cwd=tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, "", "")


def test_a_signal_dropped_at_the_very_end_is_told_by_the_status():
    before = [signal.getsignal(number) for number in (*signals.SIGNALS, signal.SIGALRM)]
    with pytest.raises(signals.Signalled) as ended, signals.at_once(), contextlib.suppress(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGHUP)
        time.sleep(1)
    assert ended.value.code == 129 and signal.getitimer(signal.ITIMER_REAL) == (0.0, 0.0)
    assert before == [signal.getsignal(number) for number in (*signals.SIGNALS, signal.SIGALRM)]
