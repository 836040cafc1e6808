"""The arm's own process: what becomes of the arm when the policy's process is killed or frozen, and when its own is."""

import csv
import dataclasses
import importlib
import json
import os
import pathlib
import signal
import socket
import subprocess
import sys

import arms
import numpy as np
import pytest
from waiting import wait

from mjx_nero.deploy import server
from mjx_nero.deploy.arm import ArmError
from mjx_nero.deploy.remote import Remote
from mjx_nero.deploy.safety import Fault
from mjx_nero.deploy.server import Spec
from mjx_nero.errors import UserError

BUSY = 0.05  # a policy's process that wakes so late may be silent for too long by itself [s]
# A policy's process that swings a joint until it is killed.
SWING = """
import json, sys, time
import numpy as np
from mjx_nero.deploy.guard import urgent
from mjx_nero.deploy.remote import Remote
from mjx_nero.deploy.server import Spec
stay = urgent()
stay.__enter__()  # as the command does
remote = Remote(Spec(**json.loads(sys.argv[1])))
remote.ready()
at = remote.start(actions=0).position
begun = time.monotonic()
print(remote.pid, flush=True)
while remote.fault is None:
    at[0] = 0.5 * np.sin(3 * (time.monotonic() - begun))
    remote.read()
    remote.command(at)
    time.sleep(0.02)
print("fault", remote.fault.kind, flush=True)
remote.close()
"""


@pytest.fixture
def spec(lift, told, tmp_path):
    kept = {name: told[name] for name in ("joints", "gripper", "body", "base", "regions", "command", "control_dt", "robot")}
    return Spec("sim", {"model": str(lift / "scene.mjb")}, kept, log=str(tmp_path / "log.csv"))


def test_a_missing_package_is_one_line_with_its_extra(spec, monkeypatch):
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    monkeypatch.setitem(sys.modules, "serial", None)  # Python finds no such module then
    monkeypatch.setattr(server.drivers, "make", lambda *_: importlib.import_module("serial"))
    with here, there:
        here.send(json.dumps(vars(spec)).encode())
        server.serve(there)
        assert "this needs serial, of the extra 'deploy'" in json.loads(here.recv(server.PACKET))["error"]


def rows(spec):
    with open(spec.log) as file:
        return list(csv.DictReader(line for line in file if not line.startswith("#")))


def gone(pid):
    try:
        return pathlib.Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] == "Z"
    except OSError:
        return True


@pytest.fixture
def swinging(spec):
    process = subprocess.Popen([sys.executable, "-c", SWING, json.dumps(vars(spec))], stdout=subprocess.PIPE, text=True)
    arm = int(process.stdout.readline())
    yield process, arm
    process.kill()
    process.wait()
    wait(lambda: gone(arm))


def targets(table):
    return [float(row["target.shoulder_pan"]) for row in table if row["target.shoulder_pan"]]


def at_rest(table):
    """True once the arm holds and was told the same target twice."""
    held = [row for row in table if row["held"]]
    return held and np.ptp(targets(table)[-2:]) < 1e-4


def test_a_killed_policy_leaves_an_arm_that_brakes_and_holds(swinging, spec, late):
    process, arm = swinging
    wait(lambda: len(targets(rows(spec))) > 30 or gone(arm))
    process.kill()
    wait(lambda: gone(arm))  # it left by itself
    table = rows(spec)
    held = [row for row in table if row["held"]]
    last = max(float(row["time"]) for row in table if not row["held"] and row["target.shoulder_pan"])
    assert held[0]["held"] == "silence" and float(held[0]["time"]) - last < 0.1 + late()
    steps = np.abs(np.diff(targets(table)))
    # What the drives are told leads by their lag, some milliradians.
    assert steps.max() <= 1.5 * 0.02 + 1e-4 and steps[-1] < 1e-4 and len(held) <= 5


def test_a_frozen_policy_leaves_an_arm_that_holds_within_a_tenth_of_a_second(swinging, spec, late):
    process, arm = swinging
    wait(lambda: len(targets(rows(spec))) > 30 or gone(arm))
    process.send_signal(signal.SIGSTOP)
    wait(lambda: at_rest(rows(spec)))
    table = rows(spec)
    last = max(float(row["time"]) for row in table if not row["held"] and row["target.shoulder_pan"])
    first = next(float(row["time"]) for row in table if row["held"])
    assert first - last < 0.1 + late()
    assert not gone(arm) or late() > BUSY
    assert targets(table)[-1] == pytest.approx(targets(table)[-2], abs=1e-4)
    process.send_signal(signal.SIGCONT)  # nothing resumes
    assert process.stdout.readline() == "fault silence\n"
    process.wait(60)
    assert targets(rows(spec))[-1] == targets(table)[-1]


def test_ctrl_c_does_not_reach_the_arms_process(swinging, spec, late):
    process, arm = swinging
    os.kill(arm, signal.SIGINT)
    told = len(rows(spec))
    wait(lambda: len(rows(spec)) > told + 20 or gone(arm))
    assert not gone(arm) or late() > BUSY


def test_an_arm_whose_process_is_killed_is_said(spec):
    remote = Remote(spec)
    remote.ready()
    remote.start()
    os.kill(remote.pid, signal.SIGKILL)
    with pytest.raises(ArmError, match="the drives hold their last target"):
        wait(lambda: remote.read() is None)
    remote.close()


def test_an_arms_process_that_does_not_end_is_said(spec, monkeypatch):
    remote = Remote(spec)
    remote.ready()
    os.kill(remote.pid, signal.SIGSTOP)
    monkeypatch.setattr("mjx_nero.deploy.remote._PATIENCE", 0.2)
    with pytest.raises(ArmError, match=f"the arm's process {remote.pid} does not end: cut the arm's power"):
        remote.close()
    os.kill(remote.pid, signal.SIGCONT)
    monkeypatch.undo()
    remote.close()  # it was told to end meanwhile


@pytest.mark.parametrize("kind", ["sim", "toaster"])
def test_an_arm_that_answers_too_late_is_let_go(spec, monkeypatch, kind):
    """On a busy machine the policy's process may give up before the arm is ready. Nothing is said to nobody."""
    clock, closed = arms.Clock(), []
    arm = arms.Ideal(tuple(spec.metadata["joints"]["names"]), np.array(spec.metadata["joints"]["home"]), clock)
    arm.close = lambda: closed.append(True)
    if kind == "sim":
        monkeypatch.setattr(server.drivers, "make", lambda *_: arm)
    ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    theirs.send(json.dumps({**vars(spec), "kind": kind}).encode())
    theirs.close()
    with ours:
        server.serve(ours)
    assert closed == [True] * (kind == "sim")


def test_a_fault_is_told_and_stays(spec):
    remote = Remote(dataclasses.replace(spec, safety={"silence": 60.0}))
    remote.ready()
    at = remote.start().position
    remote.hold(Fault("stop", "enough"))
    remote.command(at + 0.2)
    assert remote.fault == Fault("stop", "enough")
    np.testing.assert_allclose(remote.command(at + 0.2).position, at, atol=1e-2)
    remote.close()


def test_an_arm_that_may_not_start_gets_no_torque(spec, monkeypatch):
    clock, home = arms.Clock(), np.array(spec.metadata["joints"]["home"])
    arm, engaged = arms.Ideal(tuple(spec.metadata["joints"]["names"]), home, clock), []
    arm.engage = lambda: engaged.append(True)
    monkeypatch.setattr(server.drivers, "make", lambda *_: arm)
    monkeypatch.setattr(server, "WallClock", lambda: clock)
    made = server.Server(spec)
    arm.at = home + np.array([0.4, 0, 0, 0, 0, 0])
    refused = made.answer({"do": "start", "anywhere": False, "actions": 0})
    assert "far from home" in refused["error"] and not engaged and not made.running
    arm.at = home
    assert "error" not in made.answer({"do": "start", "anywhere": False, "actions": 0}) and engaged == [True]
    made.guard.close()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "toaster"}, "no arm 'toaster': choose one of sim, so101"),
        ({"kind": "so101", "options": {"port": "/dev/nothing", "calibration": None}}, "needs --calibration"),
        ({"log": "/nowhere/log.csv"}, "cannot write /nowhere/log.csv"),
    ],
)
def test_mistakes_are_one_line(spec, change, message):
    remote = Remote(Spec(**{**vars(spec), **change}))
    with pytest.raises(UserError, match=message):
        remote.ready()
        remote.start()
    remote.close()
