"""Signals in training: the first lets it save, the second ends the process wherever it is, within compiled code, too."""

import subprocess
import sys

PROGRAM = """
import ctypes, os, signal, time
from mjx_nero.runs import signals

def within():
    for _ in range({times}):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
    return 0

with signals.after_this(print) as stop:
    ctypes.CFUNCTYPE(ctypes.c_int)(within)()
    print("went on", stop.code, flush=True)
"""


def ended(times):
    return subprocess.run([sys.executable, "-c", PROGRAM.format(times=times)], capture_output=True, text=True, timeout=60)


def test_after_one_signal_it_goes_on():
    done = ended(1)
    assert (done.returncode, done.stderr) == (0, "") and "went on 143" in done.stdout


def test_a_second_within_a_callback_ends_it():
    done = ended(2)
    assert (done.returncode, done.stderr) == (143, "") and "went on" not in done.stdout
