"""The Piper and the Nero over an emulated bus: frames byte for byte, faults, and that nothing ever drops the arm."""

import pathlib
import select
import threading

import arms
import numpy as np
import pytest

from mjx_nero.deploy import setup
from mjx_nero.deploy.drivers import agilex
from mjx_nero.deploy.drivers.slcan import Slcan
from mjx_nero.deploy.emulators import agilex as emulated
from mjx_nero.deploy.emulators.line import Line
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.guard import Guard, WallClock
from mjx_nero.errors import UserError
from mjx_nero.sim import scene
from mjx_nero.tasks import registry


@pytest.fixture(scope="module", params=["piper", "nero"])
def kind(request):
    return request.param


@pytest.fixture(scope="module")
def told(kind):
    return arms.metadata(kind)


@pytest.fixture(scope="module")
def model(kind):
    return scene.build(registry.robot(kind), scene.SceneCfg(), scene.SimCfg(), visuals=False)


class Bench(arms.Bench):
    """An emulated arm and its driver on a virtual bus, where frames are taken and sent at every tick of the clock."""

    def __init__(self, kind, told, model):
        self.clock, self.home = arms.Clock(), np.array(told["joints"]["home"])
        self.plant = Plant(model, told["joints"]["names"], self.home, self.clock)
        self.emulated = emulated.Arm(self.plant, agilex.MODELS[kind])
        self.plant.gears = 1e4  # it lies on something
        self.port = emulated.CanPort(self.emulated, f"virtual:{id(self)}")
        self.clock.ticks = [self.port.take, self.port.say]
        self.arm = agilex.of(kind, told, self.clock, self.port.name)
        self.guard = Guard(self.arm, setup.safety_of(told), self.clock)

    def towards(self, step):
        """Home, and a first joint that is so far from it."""
        out = self.home.copy()
        out[0] += step
        return out

    def close(self):
        if hasattr(self.arm, "_bus"):
            self.arm.close()
        self.port.close()


@pytest.fixture
def bench(kind, told, model):
    made = Bench(kind, told, model)
    yield made
    assert made.emulated.torque_cuts == 0
    made.close()


def test_frames_are_the_makers():
    """Thousandths of a degree and of a millimetre, the high byte first."""
    frames = agilex.target_frames(agilex.PIPER, np.radians([90, -45, 0.001, 0, 1, -180]), 0.05)
    assert [(hex(frame), data.hex()) for frame, data in frames] == [
        ("0x151", "0101640000000000"),
        ("0x155", "00015f90ffff5038"),
        ("0x156", "0000000100000000"),
        ("0x157", "000003e8fffd40e0"),
        ("0x159", "0000c35003e80100"),
    ]


def test_a_seventh_joint_has_a_frame_of_its_own():
    frames = agilex.target_frames(agilex.NERO, np.radians([0, 0, 0, 114.592, 0, 0, -90]), 0.1)
    assert [(hex(frame), data.hex()) for frame, data in frames[2:]] == [
        ("0x156", "000000000001bfa0"),
        ("0x157", "0000000000000000"),
        ("0x170", "fffea07000000000"),
        ("0x159", "000186a003e80100"),
    ]


def test_the_arm_goes_where_it_is_told(bench):
    feedback = bench.start()
    np.testing.assert_allclose(feedback.position, bench.home, atol=0.02)
    assert bench.plant.powered.all()
    way = np.full(len(bench.home), 0.1)
    way[-2:] = -0.02, 0.02
    way[3] = -0.1
    bench.play([bench.home + way * min(1, k / 40) for k in range(100)])
    feedback = bench.guard.read()
    assert bench.guard.fault is None, bench.guard.fault
    np.testing.assert_allclose(feedback.position, bench.plant.position(), atol=2e-3)
    np.testing.assert_allclose(feedback.position, bench.home + way, atol=5e-2)
    assert feedback.temperature.max() == 35


@pytest.mark.parametrize(
    ("fault", "fails", "says"),
    [
        ({"cut": True}, "stale", "ms old"),
        ({"mute": frozenset([0x2A6])}, "stale", "ms old"),
        ({"status": 1}, "bus", "an emergency stop"),
        ({"bits": {2: 128}}, "bus", "joint 2 reports a stall"),
        ({"bits": {5: 2 + 4}}, "bus", "joint 5 reports a hot motor and overcurrent"),
        ({"heat": 70}, "temperature", "70 degrees"),
    ],
)
def test_faults_end_in_hold(bench, fault, fails, says):
    bench.start()
    bench.play([bench.towards(0.01 * k) for k in range(10)])
    assert bench.guard.fault is None
    bench.emulated.faults = emulated.BusFaults(**fault)
    bench.play([bench.home + 0.3] * 10)  # feedback is stale after a tenth of a second
    assert bench.guard.fault.kind == fails and says in bench.guard.fault.text
    bench.emulated.faults = emulated.BusFaults()
    bench.play([bench.home + 0.5] * 20)
    assert np.abs(bench.guard.safety.position - bench.home).max() < 0.35


def test_a_motor_that_lost_its_torque_is_said(bench):
    bench.start()
    bench.plant.powered[3] = False
    bench.play([bench.home] * 3)
    assert "joint 4 has lost its torque" in bench.guard.fault.text


def test_closing_leaves_the_motors_on(bench):
    bench.start()
    bench.guard.settle()
    assert bench.plant.powered.all()


def test_a_silent_bus_is_refused(bench):
    bench.emulated.faults.cut = True
    with pytest.raises(UserError, match="no (Piper|Nero) answers at virtual:"):
        bench.start()
    assert bench.arm._bus._is_shutdown  # or python-can complains of it in a line of its own


@pytest.mark.parametrize("port", ["can0", "nonsense:can0", "slcan:/dev/nothing"])
def test_wrong_ports_are_one_line(kind, told, port):
    with pytest.raises(UserError, match="--port of a (Piper|Nero) takes|cannot open"):
        agilex.of(kind, told, arms.Clock(), port).connect()


@pytest.fixture
def adapter(bench):
    """The same arm behind a serial adapter."""
    port = emulated.Port(bench.emulated, Line(terminal=True))
    yield port
    port.close()


def test_a_serial_adapter_is_another_bus(bench, adapter, told, kind, monkeypatch):
    """In real time, as the lines of a terminal are; whoever reads them may have to wait for a processor."""
    send = Slcan.send
    monkeypatch.setattr(Slcan, "send", lambda bus, frame, timeout: send(bus, frame))
    monkeypatch.setattr(agilex, "_WAIT", 60.0)
    over = threading.Event()
    thread = threading.Thread(target=adapter.serve, args=(over.is_set,), daemon=True)
    bench.plant._clock = clock = WallClock()
    bench.plant.reset(bench.home)
    thread.start()
    arm = agilex.of(kind, told, clock, adapter.name)
    arm.connect()
    arm.engage()
    np.testing.assert_allclose(arm.read().position, bench.home, atol=1e-2)
    arm.close()
    over.set()
    thread.join()
    assert bench.emulated.torque_cuts == 0


def test_rubbish_on_the_line_is_survived(adapter):
    rng = np.random.default_rng(0)
    adapter._open = True
    for _ in range(300):
        adapter._take(rng.integers(0, 256, rng.integers(0, 40)).astype(np.uint8).tobytes())
        adapter._take(b"t155" + bytes(rng.integers(48, 58, 9).astype(np.uint8)) + b"\r")


@pytest.mark.parametrize("line", [b"t1\r", b"T12\r", b"txyz8\r", b"t2A5F00\r", b"\xff\xfe\r"])
def test_a_damaged_line_of_an_adapter_ends_in_hold(bench, adapter, told, kind, line, monkeypatch):
    bench.start()
    slcan = Slcan(adapter.name.partition(":")[2], sleep_after_open=0, timeout=0)
    adapter._line.write(line)
    monkeypatch.setattr(bench.arm, "_bus", slcan)
    assert select.select([slcan.fileno()], [], [], 60.0)[0]  # the terminal carries it
    bench.guard.read()
    assert bench.guard.fault.kind == "bus" and "the CAN bus fails" in bench.guard.fault.text
    monkeypatch.undo()
    slcan.shutdown()


def test_no_frame_that_drops_the_arm_is_in_the_driver():
    text = pathlib.Path(agilex.__file__).read_text()
    assert "0x150" not in text.split('"""', 2)[2] and "0x474" not in text
