"""The command ``deploy`` from end to end, and what it says of mistakes."""

import json
import shutil
import subprocess
import sys

import pytest

FAST = ("--seconds", "1.5")


@pytest.fixture
def policy(lift, tmp_path):
    return shutil.copy(lift / "policy.onnx", tmp_path / "policy.onnx")


@pytest.mark.parametrize("arm", [("sim",), ("so101", "--emulate")])
def test_a_policy_runs(call, policy, tmp_path, arm):
    for _ in range(3):  # what else a machine does may cost deadlines, and five in a row end a run
        status, out, err = call("mjx_nero", "deploy", policy, "--arm", *arm, *FAST, "--log", "log.csv")
        if status == 0:
            break
    assert (status, err) == (0, "") and "the arm holds: its time is over" in out
    timing = json.loads(next(line for line in out.splitlines() if line.startswith("timing: "))[8:])
    assert timing["cycles"] >= 30 and timing["cycles"] <= 75
    assert len((tmp_path / "log.csv").read_text().splitlines()) > 100


def test_a_dry_run_shows_targets(call, policy):
    status, out, _ = call("mjx_nero", "deploy", policy, "--arm", "sim", *FAST, "--dry-run")
    assert status == 0 and out.count("shoulder_pan ") > 50


def test_home_first(call, policy):
    status, out, _ = call("mjx_nero", "deploy", policy, "--arm", "sim", "--seconds", "0", "--go-home")
    assert status == 0 and out.startswith("the arm is at home")


def test_a_check_is_a_go_and_its_file_is_taken(call, policy, tmp_path):
    status, out, err = call("mjx_nero", "deploy", policy, "--arm", "sim", "--check", "found.yaml")
    assert (status, err) == (0, "") and "go: next --dry-run" in out and out.count("go    ") == 6
    taken = ("--identified", "found.yaml", "--seconds", "0.5")
    assert call("mjx_nero", "deploy", policy, "--arm", "sim", *taken)[0] == 0


def test_an_object_that_nobody_sees_is_a_fault(call, policy):
    status, out, err = call("mjx_nero", "deploy", policy, "--arm", "sim", *FAST, "--object", "udp://127.0.0.1:0")
    assert (status, err) == (3, "") and "the arm holds: nobody has said where the cube is" in out


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--arm", "so101"), "--arm so101 needs --port, or --emulate"),
        (("--arm", "toaster"), "--arm"),
        (("--arm", "sim", "--emulate"), "--arm sim is simulated already"),
        (("--arm", "lerobot", "--emulate"), "--arm lerobot is LeRobot's"),
        (("--arm", "sim", "--check", "found.yaml", "--dry-run"), "--check moves the arm"),
        (("--arm", "sim", "--identified", "none.yaml"), "none.yaml"),
        (("--arm", "sim", "--goal", "1,2"), "--goal takes 3 or 7 numbers"),
        (("--arm", "sim", "--goal", "1,2,nan"), "--goal takes 3 or 7 numbers"),
        (("--arm", "sim", "--workspace", "0,1,0,1,1,0"), "--workspace takes ranges from low to high"),
        (("--arm", "sim", "--speed", "2"), "--speed"),
        (("--arm", "sim", "--log", "nowhere/log.csv"), "the folder nowhere does not exist"),
        (("--arm", "piper", "--emulate"), "the policy is for so_arm101, and --arm piper is a piper"),
        (("--arm", "so101", "--port", "/dev/nothing", "--object", "0.2,0,0.015"), "needs --calibration"),
        (("--arm", "sim", "--object", "udp://x"), "an address is udp://HOST:PORT"),
    ],
)
def test_mistakes_are_one_line(call, policy, flags, message):
    status, _, err = call("mjx_nero", "deploy", policy, *flags)
    assert status == 2 and err.startswith("error: ") and message in err and len(err.splitlines()) == 1


def test_files_that_are_no_policy(call, tmp_path):
    (tmp_path / "empty.onnx").write_bytes(b"")
    (tmp_path / "rubbish.onnx").write_bytes(bytes(range(256)) * 40)
    for name in ("none.onnx", "empty.onnx", "rubbish.onnx"):
        status, _, err = call("mjx_nero", "deploy", name, "--arm", "sim")
        assert status == 2 and len(err.splitlines()) == 1, (name, err)


PROBE = """
import sys
from mjx_nero.tools import deploy
from mjx_nero.tools import cli
sys.argv[0] = "mjx_nero"
try:
    flags = ["--port", "/dev/nothing", "--calibration", sys.argv[2], "--object", "0.2,0,0.015"]
    deploy.main([sys.argv[1], "--arm", "so101", *flags])
except Exception as error:
    print(error)
print([name for name in ("jax", "mujoco", "torch", "brax", "scipy", "rich") if name in sys.modules])
print(next(line.split()[1] for line in open("/proc/self/status") if line.startswith("VmHWM")))
"""


def test_a_robots_computer_needs_little(policy, told, tmp_path):
    """Neither JAX nor MuJoCo is imported for a real arm, and the policy's process stays small."""
    from mjx_nero.deploy.emulators import feetech

    (tmp_path / "c.json").write_text(json.dumps(feetech.calibration(told, "so101")))
    argv = [sys.executable, "-c", PROBE, str(policy), str(tmp_path / "c.json")]
    lines = subprocess.run(argv, capture_output=True, text=True, timeout=60).stdout.splitlines()
    assert "cannot open /dev/nothing" in "\n".join(lines)
    assert lines[-2] == "[]" and int(lines[-1]) < 200_000  # kB
