"""The Piper over an emulated bus: frames byte for byte, faults, and that nothing ever drops the arm."""

import pathlib

import arms
import numpy as np
import pytest

from mjx_nero.deploy import setup
from mjx_nero.deploy.drivers import piper
from mjx_nero.deploy.emulators import piper as emulated
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.guard import Guard, WallClock
from mjx_nero.envs import registry
from mjx_nero.errors import UserError
from mjx_nero.sim import scene


@pytest.fixture(scope="module")
def told():
    return arms.metadata("piper")


@pytest.fixture(scope="module")
def model():
    return scene.build(registry.robot("piper"), scene.SceneCfg(), scene.SimCfg(), visuals=False)


class Bench(arms.Bench):
    """An emulated arm, its driver, and who serves the port meanwhile."""

    def __init__(self, told, model):
        self.clock = WallClock()
        self.home = np.array(told["joints"]["home"])
        self.plant = Plant(model, told["joints"]["names"], self.home, self.clock)
        self.emulated = emulated.Arm(self.plant)
        self.plant.gears = 100.0  # it lies on something
        self.port = emulated.Port(self.emulated)
        self.arm = piper.of(told, self.clock, self.port.name)
        self.guard = Guard(self.arm, setup.safety_of(told), self.clock)
        self.serve()

    def close(self):
        if hasattr(self.arm, "_bus"):
            self.arm.close()
        self.stop()
        self.port.close()


@pytest.fixture
def bench(told, model):
    made = Bench(told, model)
    yield made
    assert made.emulated.torque_cuts == 0
    made.close()


def test_frames_are_the_makers():
    """Thousandths of a degree and of a millimetre, the high byte first."""
    frames = piper.target_frames(np.radians([90, -45, 0.001, 0, 1, -180]), 0.05)
    assert [(hex(frame), data.hex()) for frame, data in frames] == [
        ("0x151", "0101640000000000"),
        ("0x155", "00015f90ffff5038"),
        ("0x156", "0000000100000000"),
        ("0x157", "000003e8fffd40e0"),
        ("0x159", "0000c35003e80100"),
    ]


def test_the_arm_goes_where_it_is_told(bench):
    feedback = bench.start()
    np.testing.assert_allclose(feedback.position, bench.home, atol=0.02)
    assert bench.plant.powered.all()
    way = np.array([0.3, 0.2, -0.2, 0.2, -0.2, 0.3, 0.02, -0.02])
    bench.play([bench.home + way * min(1, k / 40) for k in range(80)])
    for _ in range(150):  # a busy machine is late: both are compared at rest
        if np.abs(bench.plant.velocity()).max() < 0.01:
            break
        bench.play([bench.home + way] * 2)
    assert bench.guard.fault is None, bench.guard.fault
    feedback = bench.guard.read()
    np.testing.assert_allclose(feedback.position, bench.plant.position(), atol=2e-2)
    np.testing.assert_allclose(feedback.position, bench.home + way, atol=5e-2)
    assert feedback.temperature.max() == 35


@pytest.mark.parametrize(
    ("fault", "kind", "says"),
    [
        ({"cut": True}, "stale", "ms old"),
        ({"mute": frozenset([0x2A6])}, "stale", "ms old"),
        ({"status": 1}, "bus", "an emergency stop"),
        ({"bits": {2: 128}}, "bus", "joint 2 reports a stall"),
        ({"bits": {5: 2 + 4}}, "bus", "joint 5 reports a hot motor and overcurrent"),
        ({"heat": 70}, "temperature", "70 degrees"),
    ],
)
def test_faults_end_in_hold(bench, fault, kind, says):
    bench.start()
    bench.play([bench.home + np.array([0.01 * k, 0, 0, 0, 0, 0, 0, 0]) for k in range(10)])
    assert bench.guard.fault is None
    bench.emulated.faults = emulated.BusFaults(**fault)
    bench.play([bench.home + 0.3] * 10)  # feedback is stale after a tenth of a second
    assert bench.guard.fault.kind == kind and says in bench.guard.fault.text
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


def test_a_silent_bus_is_refused(bench, monkeypatch):
    monkeypatch.setattr(piper, "_WAIT", 0.3)
    bench.emulated.faults.cut = True
    with pytest.raises(UserError, match="no Piper is heard at slcan:"):
        bench.start()


@pytest.mark.parametrize("port", ["can0", "nonsense:can0", "slcan:/dev/nothing"])
def test_wrong_ports_are_one_line(told, port):
    with pytest.raises(UserError, match="--port of a Piper is|cannot open"):
        piper.of(told, arms.Clock(), port).connect()


def test_rubbish_on_the_line_is_survived(bench):
    rng = np.random.default_rng(0)
    bench.port._open = True
    for _ in range(300):
        bench.port._take(rng.integers(0, 256, rng.integers(0, 40)).astype(np.uint8).tobytes())
        bench.port._take(b"t155" + bytes(rng.integers(48, 58, 9).astype(np.uint8)) + b"\r")
    bench.port._open = False


def test_no_frame_that_drops_the_arm_is_in_the_driver():
    text = pathlib.Path(piper.__file__).read_text()
    assert "0x150" not in text.split('"""', 2)[2] and "0x474" not in text
