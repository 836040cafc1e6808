"""Arms that LeRobot drives, by a robot with its interface."""

import dataclasses
import json
import sys
import types

import arms
import numpy as np
import pytest

from mjx_nero.deploy import setup
from mjx_nero.deploy.drivers import lerobot
from mjx_nero.deploy.guard import Guard
from mjx_nero.errors import UserError


@dataclasses.dataclass
class Config:
    port: str = ""
    disable_torque_on_disconnect: bool = True


class Robot:
    """As ``lerobot.robots.Robot`` has it; torque is cut where it disconnects."""

    def __init__(self, config, motors):
        self.config, self.at = config, dict.fromkeys((f"{motor}.pos" for motor in motors), 0.0)
        self.torque, self.is_connected, self.broken = True, False, False
        self.observation_features = self.action_features = dict.fromkeys(self.at, float)

    def __del__(self):
        if self.is_connected:
            self.disconnect()

    def connect(self, calibrate=True):
        assert not calibrate
        self.is_connected = True

    def get_observation(self):
        if self.broken:
            raise ConnectionError("no status packet")
        return {**self.at, "front": np.zeros((4, 4, 3))}

    def send_action(self, action):
        self.at.update({key: float(np.clip(value, -180, 180)) for key, value in action.items()})
        return dict(action)

    def disconnect(self):
        self.torque = False


@pytest.fixture(scope="module")
def told():
    return arms.metadata("so_arm101")


@pytest.fixture
def made(told):
    robot, clock = Robot(Config(), told["joints"]["names"]), arms.Clock()
    arm = lerobot.LeRobotArm(told, robot, lerobot.motors_of(told, None), clock)
    home = np.array(told["joints"]["home"])
    robot.at = dict(zip(robot.at, ((home - arm._offset) / arm._scale).tolist(), strict=True))
    guard = Guard(arm, setup.safety_of(told), clock)
    arm.connect()
    arm.engage()
    guard.start()
    return robot, arm, guard, clock, home


def test_degrees_and_shares_of_the_gripper(made, told):
    robot, arm, guard, clock, home = made
    low, high = told["joints"]["lower"][5], told["joints"]["upper"][5]
    robot.at["shoulder_pan.pos"], robot.at["gripper.pos"] = 90.0, 25.0
    at = arm.read().position
    assert at[0] == pytest.approx(np.pi / 2) and at[5] == pytest.approx(low + (high - low) / 4)


def test_the_arm_goes_where_it_is_told_and_keeps_its_torque(made):
    robot, arm, guard, clock, home = made
    way = np.array([0.2, 0.0, -0.1, -0.1, 0.2, 0.1])
    for k in range(60):
        clock.time += 0.02
        seen = guard.read()
        guard.command(home + way * min(1, k / 30))
    assert guard.fault is None
    np.testing.assert_allclose(guard.read().position, home + way, atol=1e-9)
    assert seen.velocity.shape == (6,)
    guard.close()
    robot.__del__()
    assert robot.torque and not robot.config.disable_torque_on_disconnect


def test_what_fails_ends_in_hold(made):
    robot, arm, guard, clock, home = made
    robot.broken = True
    clock.time += 0.02
    guard.read()
    assert guard.fault.kind == "bus" and "LeRobot cannot read the arm: no status packet" in guard.fault.text


def test_joints_by_a_file(told, tmp_path):
    names = told["joints"]["names"]
    path = tmp_path / "map.json"
    path.write_text(json.dumps({name: {"motor": f"m{i}", "scale": -0.01, "offset": 0.1} for i, name in enumerate(names)}))
    assert lerobot.motors_of(told, path)[1] == lerobot.Motor("m1", -0.01, 0.1)
    for text in ("[]", "{}", json.dumps({name: {"motor": "m", "scale": 0, "offset": 0} for name in names})):
        path.write_text(text)
        with pytest.raises(UserError, match="needs motor, scale and offset|a finite number other than 0"):
            lerobot.motors_of(told, path)


def test_a_robot_by_its_type(told, monkeypatch):
    """``--port`` names a class that LeRobot's registry has."""

    class RobotConfig:
        @staticmethod
        def get_choice_class(kind):
            return {"fake": Config}[kind]

    parts = {
        "lerobot": {},
        "lerobot.robots": {"make_robot_from_config": lambda config: Robot(config, ["other"])},
        "lerobot.robots.config": {"RobotConfig": RobotConfig},
        "lerobot.utils": {},
        "lerobot.utils.import_utils": {"register_third_party_plugins": lambda: None},
    }
    for name, content in parts.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    arm = lerobot.of(told, arms.Clock(), "fake:port=/dev/ttyACM0", None)
    assert arm._robot.config.port == "/dev/ttyACM0"
    with pytest.raises(UserError, match=r"the robot has no shoulder_pan\.pos, .* it has other\.pos: pass --calibration"):
        arm.connect()
    with pytest.raises(UserError, match="LeRobot has no robot 'none'"):
        lerobot.of(told, arms.Clock(), "none", None)
