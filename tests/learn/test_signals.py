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


SLOW = """
import os, signal, threading, time
import jax, numpy as np
from mjx_nero.learn import waiting
from mjx_nero.runs import signals

def minutes(x):
    time.sleep(60)
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
    """The first one is told of while the program goes on; the second one ends it long before its minute is over."""
    done = subprocess.run([sys.executable, "-c", SLOW], capture_output=True, text=True, timeout=45)
    assert done.returncode == 130, done.stderr
    assert "stopping after this update" in done.stdout
