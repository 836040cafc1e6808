"""One program at a time has an arm: a second one is refused in one line, and the arm of the first hears nothing of it."""

import shutil
import socket
import subprocess
import sys
import time

import arms
import pytest

from mjx_nero.deploy import children, drivers, emulators
from mjx_nero.deploy.alone import alone
from mjx_nero.deploy.emulators import feetech
from mjx_nero.deploy.emulators.line import Line
from mjx_nero.deploy.server import Server, Spec
from mjx_nero.errors import UserError

IN_USE = "is in use by another program on this computer: end that program first"


def test_a_port_is_taken_once_until_it_is_let_go():
    first = alone("can0")
    with pytest.raises(UserError, match=f"^can0 {IN_USE}$"):
        alone("can0")
    alone("can1").close()
    first.close()
    alone("can0").close()


def test_all_names_of_a_file_are_one_port(tmp_path):
    (tmp_path / "ttyACM0").touch()
    (tmp_path / "by-id").symlink_to(tmp_path / "ttyACM0")
    first = alone(str(tmp_path / "ttyACM0"))
    with pytest.raises(UserError, match="by-id is in use"):
        alone(str(tmp_path / "by-id"))
    first.close()


def test_a_killed_program_lets_its_port_go():
    code = "from mjx_nero.deploy.alone import alone\ntaken = alone('can7')\nprint('has it', flush=True)\ninput()"
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": children.environment()}
    process = subprocess.Popen([sys.executable, "-c", code], **pipes)
    assert process.stdout.readline() == "has it\n"
    with pytest.raises(UserError, match=IN_USE):
        alone("can7")
    process.kill()
    process.wait()
    alone("can7").close()


@pytest.mark.parametrize(
    ("kind", "options", "taken"),
    [
        ("sim", {"model": "scene.mjb"}, []),
        ("so101", {"port": "/dev/ttyACM0", "calibration": "arm.json"}, ["/dev/ttyACM0"]),
        ("so100", {"port": "socket://10.0.0.2:5000"}, ["socket://10.0.0.2:5000"]),
        ("piper", {"port": "socketcan:can0"}, ["socketcan:can0"]),
        ("nero", {"port": "slcan:/dev/ttyACM0"}, ["/dev/ttyACM0"]),
        ("cobotta", {"port": "10.0.0.2", "gripper": "10.0.0.3"}, ["10.0.0.2", "10.0.0.3"]),
        ("cobotta", {"port": "udp:10.0.0.2:5007", "gripper": None}, ["10.0.0.2"]),
        ("lerobot", {"port": "so101_follower:port=/dev/ttyACM0,id=mine"}, ["/dev/ttyACM0"]),
        ("lerobot", {"port": "koch_follower:id=mine"}, ["koch_follower:id=mine"]),
    ],
)
def test_what_each_arm_is_reached_by(kind, options, taken):
    assert drivers.ports(kind, options) == taken


@pytest.fixture
def door():
    """A port of this machine that an arm might be at."""
    made = socket.create_server(("127.0.0.1", 0))
    made.setblocking(False)
    yield made
    made.close()


@pytest.mark.parametrize(("kind", "address"), [("so101", "socket://{}"), ("piper", "slcan:socket://{}"), ("cobotta", "{}")])
def test_an_arm_that_is_in_use_hears_nothing_of_a_second_program(kind, address, door, tmp_path):
    told = arms.metadata({"so101": "so_arm101", "cobotta": "cobotta_pro_900"}.get(kind, kind))
    options = {"port": address.format(f"127.0.0.1:{door.getsockname()[1]}"), "calibration": None}
    if kind == "so101":
        options["calibration"] = str(tmp_path / "arm.json")
        (tmp_path / "arm.json").write_text(feetech.json.dumps(feetech.calibration(told, kind)))
    (port,) = drivers.ports(kind, options)
    first = alone(port)
    with pytest.raises(UserError, match=IN_USE):
        Server(Spec(kind, options, told))
    with pytest.raises(BlockingIOError):  # nobody came
        door.accept()
    first.close()


def test_a_port_that_a_program_of_another_kind_has_is_refused(tmp_path):
    """As LeRobot's does, which knows nothing of ours: the system's lock of the terminal."""
    import serial

    line, told = Line(terminal=True), arms.metadata("so_arm101")
    (tmp_path / "arm.json").write_text(feetech.json.dumps(feetech.calibration(told, "so101")))
    with serial.Serial(line.name, exclusive=True):
        with pytest.raises(UserError, match=f"cannot open {line.name}: .*lock"):
            Server(Spec("so101", {"port": line.name, "calibration": str(tmp_path / "arm.json")}, told))
    assert line.read() == b""
    line.close()


def test_a_log_that_another_run_writes_is_left_alone(lift, told, tmp_path):
    log = tmp_path / "log.csv"
    log.write_text("mine")
    first = alone(str(log))
    with pytest.raises(UserError, match=f"log.csv {IN_USE}"):
        Server(Spec("sim", {"model": str(lift / "scene.mjb")}, told, log=str(log)))
    assert log.read_text() == "mine"
    first.close()


@pytest.fixture
def command(lift, told, tmp_path):
    """``deploy`` to an emulated arm, the port it is at, and its log."""
    policy, log = shutil.copy(lift / "policy.onnx", tmp_path / "policy.onnx"), tmp_path / "log.csv"
    with emulators.started("so101", {"model": str(lift / "scene.mjb")}, told) as arm:
        flags = ["--port", arm["port"], "--calibration", arm["calibration"], "--object", "0.2,0,0.015", "--seconds", "10"]
        yield ["mjx_nero", "deploy", policy, "--arm", "so101", *flags, "--log", log], arm["port"], log


def test_deploy_to_an_arm_that_is_in_use_ends_in_one_line(call, command):
    words, port, log = command
    first = alone(port)
    status, _, err = call(*words)
    assert status == 2 and err == f"error: {port} {IN_USE}\n" and not log.exists()
    first.close()


def test_a_deploy_keeps_its_arm_and_goes_on_when_another_program_wants_it(command):
    words, port, log = command
    first = subprocess.Popen([sys.executable, "-m", *words], stdout=subprocess.PIPE, text=True, env=children.environment())
    while not log.exists():  # the arm is taken before
        assert first.poll() is None
        time.sleep(0.02)
    with pytest.raises(UserError, match=IN_USE):
        alone(port)
    said = first.communicate(timeout=300)[0]
    assert "servo" not in said and "bus" not in said  # what else this machine does may cost it deadlines
    assert first.returncode == 0 or "late" in said or "ms old" in said, said
