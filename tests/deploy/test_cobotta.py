"""The Cobotta over b-CAP and its gripper over Modbus: packets byte for byte, faults, and that nothing ever drops the arm."""

import pathlib
import struct
import time

import arms
import jax.numpy as jnp
import numpy as np
import pytest
from waiting import wait

from mjx_nero.deploy import setup
from mjx_nero.deploy.arm import ArmError
from mjx_nero.deploy.drivers import bcap, cobotta, rg6
from mjx_nero.deploy.emulators import bcap as emulated
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.guard import Guard, WallClock, urgent
from mjx_nero.errors import UserError
from mjx_nero.sim import scene
from mjx_nero.tasks import registry
from mjx_nero.tasks.arms import cobotta_pro_900


def test_a_packet_is_the_makers():
    """SERVICE_START with an empty text: 16 bytes of frame, 4 of the argument's length, 10 of a VARIANT."""
    data = bcap.packet(1, bcap.SERVICE_START, [""])
    assert (
        data.hex()
        == "01" + "1e000000" + "0100" + "0000" + "01000000" + "0100" + "0a000000" + "0800" + "01000000" + "00000000" + "04"
    )
    move = bcap.packet(7, bcap.EXECUTE, [5, "slvMove", [90.0]])
    assert move[13:15] == b"\x03\x00" and move[-15:].hex() == "0520" + "01000000" + "0000000000805640" + "04"
    assert bcap.parse(move) == (7, bcap.EXECUTE, [5, "slvMove", [90.0]])


@pytest.mark.parametrize("value", [None, 3, -2.5, "Arm é", [1, 2], [1.0, -2.0], ["a", "bc"]])
def test_values_come_back(value):
    assert bcap.decode(bcap.encode(value)) == value


def test_a_list_of_values_of_all_kinds_is_read():
    parts = [bcap.encode([1.5, 2.5]), bcap.encode(7), struct.pack("<HIi", 0x13, 1, 9)]
    assert bcap.decode(struct.pack("<HI", bcap.VARIANT | bcap.ARRAY, 3) + b"".join(parts)) == [[1.5, 2.5], 7, 9]


def test_rubbish_is_damaged():
    """Whatever comes, it is a packet or ``Damaged``, and the controller answers."""
    rng, good = np.random.default_rng(0), bcap.packet(3, bcap.EXECUTE, [5, "slvMove", [1.0] * 8])
    for _ in range(3000):
        data = bytearray(good)
        for _ in range(rng.integers(1, 4)):
            data[rng.integers(len(data))] = rng.integers(256)
        try:
            bcap.parse(bytes(data[: rng.integers(1, len(data) + 1)]))
        except bcap.Damaged:
            continue


def test_widths_are_the_models():
    for angle in (-0.6, 0.0, 0.3, 0.62):
        assert rg6.width(angle) == pytest.approx(float(cobotta_pro_900.rg6_gap(jnp.array([angle, -angle]))), abs=1e-6)
        assert rg6.angle(rg6.width(angle)) == pytest.approx(angle)


@pytest.fixture(scope="module")
def told():
    return arms.metadata("cobotta_pro_900")


@pytest.fixture(scope="module")
def model():
    return scene.build(registry.robot("cobotta_pro_900"), scene.SceneCfg(), scene.SimCfg(), visuals=False)


class Stepped(cobotta.Cobotta):
    """Its cycles, and the gripper's, run at the ticks of a clock."""

    def __init__(self, *args):
        super().__init__(*args)
        self.turning.start = lambda: self._clock.ticks.extend([self.turning.turn, self._gripper.turning.turn])


class Bench(arms.Bench):
    def __init__(self, told, model, clock, kind, by=""):
        self.clock, self.home = clock, np.array(told["joints"]["home"])
        self.plant = Plant(model, told["joints"]["names"], self.home, clock)
        self.emulated = emulated.Controller(self.plant, np.array(told["joints"]["speed"])[:6], kind is cobotta.Cobotta)
        self.port = emulated.Port(self.emulated)
        self.gripper = rg6.Rg6(self.port.gripper)
        if kind is Stepped:
            self.gripper.engage = lambda: None
        self.arm = kind(told, by + self.port.name, self.gripper, clock)
        self.guard = Guard(self.arm, setup.safety_of(told), clock)
        self.serve()

    def towards(self, step):
        return self.home + np.array([step, 0, 0, 0, 0, 0, 0, 0])

    def close(self):
        self.clock.ticks = []
        self.stop()
        self.port.close()


@pytest.fixture
def bench(told, model):
    made = Bench(told, model, arms.Clock(cobotta.CYCLE), Stepped)
    yield made
    assert made.emulated.torque_cuts == 0
    made.close()


def test_the_arm_goes_where_it_is_told(bench):
    feedback = bench.start()
    np.testing.assert_allclose(feedback.position, bench.home, atol=2e-3)
    assert bench.plant.powered.all() and bench.emulated.slave
    way = np.array([0.2, 0.1, -0.1, 0.2, -0.1, 0.2, 0.3, -0.3])
    bench.play([bench.home + way * min(1, k / 40) for k in range(100)])
    feedback = bench.guard.read()
    assert bench.guard.fault is None, bench.guard.fault
    np.testing.assert_allclose(feedback.position, bench.plant.position(), atol=2e-2)
    np.testing.assert_allclose(feedback.position, bench.home + way, atol=3e-2)


def test_speeds_are_differences(bench):
    bench.start()
    seen = []
    for k in range(40):
        bench.play([bench.towards(0.01 * k)])
        seen.append(bench.guard.read().velocity[0])
    assert np.mean(seen[20:]) == pytest.approx(0.5, rel=0.1)


def test_the_way_between_targets_is_straight_and_smooth(bench):
    """Targets of 50 Hz become targets every 8 ms, none of them a leap."""
    bench.start()
    sent, do = [], bench.arm._do
    bench.arm._do = lambda name, value=None: sent.append(value[0]) or do(name, value) if name == "slvMove" else do(name, value)
    commands, command = [], bench.arm.command
    bench.arm.command = lambda position, velocity: commands.append(velocity[0]) or command(position, velocity)
    bench.play([bench.towards(0.02 * min(k, 10)) for k in range(30)])
    speed = np.diff(np.radians(sent)) / cobotta.CYCLE
    assert max(commands) / 2 < speed.max() <= max(commands) + 1e-6 and abs(speed[-1]) < 1e-9
    assert np.abs(np.diff(speed)).max() < np.abs(np.diff([0, *commands])).max() / 3 + 1e-6


def test_lost_datagrams_are_asked_for_again(told, model):
    """By UDP every fifth answer is lost; no target is moved to twice, and the arm goes on. Where all are lost, it holds."""
    bench = Bench(told, model, arms.Clock(cobotta.CYCLE), Stepped, "udp:")
    bench.start()
    bench.arm._call.patience, moves, move = 0.2, [], bench.emulated._move
    bench.emulated._move = lambda target: moves.append(target) or move(target)
    bench.emulated.faults = emulated.BusFaults(lost=5)
    cycles, cycle = [], bench.arm.turning._work
    bench.arm.turning._work = lambda: cycles.append(1) or cycle()
    bench.play([bench.towards(0.01 * k) for k in range(10)])
    assert bench.guard.fault is None and len(moves) == len(cycles) > 20 and bench.port._count > len(moves)
    bench.arm._call.patience = 0.02
    bench.emulated.faults = emulated.BusFaults(cut=True)
    bench.play([bench.home + 0.3] * 3)
    assert bench.guard.fault.kind == "bus" and "does not answer" in bench.guard.fault.text
    bench.close()


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        ({"cut": True}, "does not answer"),
        ({"closed": True}, "has closed the connection"),
        ({"corrupt": True}, "damaged"),
        ({"error": 0x84201482}, "a target came too late (0x84201482)"),
        ({"tripped": True}, "safety switch"),
    ],
)
def test_faults_end_in_hold(bench, fault, says):
    bench.start()
    bench.play([bench.towards(0.01 * k) for k in range(10)])
    assert bench.guard.fault is None
    if "cut" in fault:
        bench.arm._call.patience = 0.05
    bench.emulated.faults = emulated.BusFaults(**fault)
    bench.play([bench.home + 0.3] * 3)
    assert bench.guard.fault.kind == "bus" and says in bench.guard.fault.text
    bench.emulated.faults = emulated.BusFaults()
    bench.play([bench.home + 0.5] * 20)  # nothing resumes
    assert np.abs(bench.guard.safety.position - bench.home).max() < 0.35


def test_a_controller_that_hears_nothing_stands(bench):
    bench.start()
    bench.play([bench.towards(0.01 * k) for k in range(10)])
    bench.clock.ticks = []  # the arm's process was killed
    bench.clock.time += 0.5
    with pytest.raises(ArmError, match="a target came too late"):
        bench.arm.cycle()
    assert not bench.emulated.slave
    assert bench.plant.powered.all() and np.abs(bench.plant.velocity()[:6]).max() < 1e-2


def test_closing_leaves_slave_mode_and_the_motors_on(bench):
    bench.start()
    bench.play([bench.towards(0.01 * k) for k in range(10)])
    bench.guard.settle()
    bench.clock.ticks = []
    bench.guard.close()
    assert bench.plant.powered.all() and not bench.emulated.slave and bench.emulated.torque_cuts == 0


def test_threads_keep_the_controllers_pace(told, model, late):
    """In real time: 125 targets a second, by the controller's waiting."""
    with urgent():  # as the arm's process does: a target may be 32 ms late
        bench = Bench(told, model, WallClock(), cobotta.Cobotta)
        bench.clock.ticks = []
        bench.start()
        begun, moves, do = time.monotonic(), [], bench.arm._do
        bench.arm._do = lambda name, value=None: moves.append(name) or do(name, value)
        wait(lambda: len(moves) >= 50 or bench.arm.turning._error)
        rate, error = len(moves) / (time.monotonic() - begun), bench.arm.turning._error
        assert rate < 140 and (rate > 80 and not error or late() > cobotta.CYCLE), (rate, error, late())
        bench.arm.close()
        assert bench.plant.powered.all() and bench.emulated.torque_cuts == 0
        bench.close()


def test_nobody_at_the_address_is_one_line(told, bench):
    with pytest.raises(UserError, match="no controller answers at 127.0.0.1:1: "):
        cobotta.of(told, arms.Clock(), "127.0.0.1:1").connect()
    for port in (":5", "host:port", "host:99999"):
        with pytest.raises(UserError, match="--port of a Cobotta takes HOST or HOST:PORT"):
            cobotta.of(told, arms.Clock(), port)
    with pytest.raises(UserError, match="no RG6 answers at 127.0.0.1:1"):
        cobotta.of(told, arms.Clock(), bench.port.name, "127.0.0.1:1").connect()


def test_no_command_that_cuts_torque_is_in_the_driver():
    text = pathlib.Path(cobotta.__file__).read_text().split('"""', 2)[2]
    assert "GiveArm" not in text and "ClearError" not in text and text.count('"Motor", [1, 0]') == text.count('"Motor"') == 1
