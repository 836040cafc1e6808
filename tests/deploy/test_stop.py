"""Whoever wants the arm to hold is heard: signals, keys, and a dead man's file."""

import csv
import os
import select
import shutil
import signal
import subprocess
import sys
import termios
import time

import arms
import numpy as np
import pytest

from mjx_nero.deploy import children, stop


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_is_told_once_it_came(name):
    number = getattr(signal, name)
    before = signal.getsignal(number)
    with stop.operator() as asked:
        assert asked() is None
        os.kill(os.getpid(), number)
        assert asked().kind == "stop" and asked().text == f"{name} arrived"
    assert signal.getsignal(number) is before


@pytest.fixture
def keyboard(monkeypatch):
    """Types at this program's terminal."""
    ours, theirs = os.openpty()
    monkeypatch.setattr(sys, "stdin", os.fdopen(theirs, "r", closefd=False))
    yield lambda keys: (os.write(ours, keys), select.select([theirs], [], [], 60.0))
    for end in (ours, theirs):
        os.close(end)


@pytest.mark.parametrize(("key", "name"), [(b" ", "space"), (b"q", "q"), (b"\x1b", "escape")])
def test_a_key_stops_without_enter(keyboard, key, name):
    before = termios.tcgetattr(sys.stdin)
    with stop.operator() as asked:
        assert asked() is None
        keyboard(key)
        assert asked().text == f"the key {name!r} was pressed"
        assert asked() is None  # it is the loop that remembers
    assert termios.tcgetattr(sys.stdin) == before


def test_other_keys_wait_for_who_asks(keyboard):
    stop.typed.clear()
    with stop.operator() as asked:
        keyboard(b"yn")
        assert asked() is None and list(stop.typed) == ["y", "n"]


@pytest.mark.parametrize(("age", "holds"), [(0.1, False), (0.7, True), (-60.0, True), (None, True)])
def test_a_file_that_nobody_touches_stops(tmp_path, age, holds):
    """Neither does one count that is not there, nor one from the future, which would be fresh for a minute."""
    path = tmp_path / "alive"
    if age is not None:
        path.touch()
        os.utime(path, (time.time() - age,) * 2)
    with stop.operator(path) as asked:
        assert (asked() is not None) == holds
        assert not holds or asked().text == f"{path} was not touched for 0.5 s"


def test_a_signal_ends_a_run_in_hold(lift, tmp_path):
    policy, log = shutil.copy(lift / "policy.onnx", tmp_path / "policy.onnx"), tmp_path / "log.csv"
    code = arms.PATIENT + "from mjx_nero.__main__ import program; program()"
    command = [sys.executable, "-c", code, "deploy", policy, "--arm", "sim", "--seconds", "600", "--log", log]
    process = subprocess.Popen(list(map(str, command)), stdout=subprocess.PIPE, text=True, env=children.environment())
    while not (log.exists() and log.read_text().count("\n") > 40):
        assert process.poll() is None
        time.sleep(0.02)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=300)[0]  # long before its minutes are over
    assert process.returncode == 0 and "the arm holds: SIGTERM arrived" in said
    with open(log) as file:
        rows = [row for row in csv.DictReader(line for line in file if line[0] != "#") if row["target.shoulder_pan"]]
    assert rows[-1]["held"] == "stop" and not rows[0]["held"]
    last = np.array([[float(row[f"target.{joint}"]) for joint in ("shoulder_pan", "elbow_flex")] for row in rows[-2:]])
    assert np.abs(np.diff(last, axis=0)).max() < 0.02  # it came to rest, and was not let go
