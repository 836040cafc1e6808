"""Whole episodes through runtime, driver and emulated servos, and what is found in a log of them."""

from mjx_nero.deploy.emulators.plant import Faults
from mjx_nero.identify import log as logs
from mjx_nero.tasks import registry
from mjx_nero.tools.deploy import trial


def test_episodes_succeed(lift, lift_cfg):
    share, ended = trial.lifts(lift / "policy.onnx", lift_cfg, "so101", 2, Faults(late=0.04), delay=0.04)
    assert share == 1.0 and not ended


def test_a_movement_is_recorded(tmp_path):
    robot = registry.robot("so_arm101")
    assert trial.recorded(tmp_path / "log.csv", robot, "so101", Faults(late=0.04), 10.2) == {}
    log = logs.read(tmp_path / "log.csv", robot.arm.joints)
    assert len(log.times) > 900 and abs(log.positions).max() > 0.3
