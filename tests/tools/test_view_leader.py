"""A leader arm, emulated servo for servo, steers the robots of a view."""

import json
import threading
import time

import mujoco
import numpy as np
import pytest
from waiting import wait

import mjx_nero
from mjx_nero.deploy.arm import ArmError
from mjx_nero.deploy.drivers import so_leader
from mjx_nero.deploy.emulators import feetech as emulated
from mjx_nero.deploy.emulators.line import Line
from mjx_nero.deploy.emulators.plant import Plant
from mjx_nero.deploy.emulators.timeless import Clock
from mjx_nero.errors import UserError
from mjx_nero.interop import description
from mjx_nero.sim import scene
from mjx_nero.tasks import registry
from mjx_nero.tools.view import agents, leader
from mjx_nero.tools.view.hand import NAME as HAND
from mjx_nero.tools.view.hand import Hand
from mjx_nero.tools.view.session import Session


class Panel:
    """Knows who acts."""

    def __init__(self):
        self.agent, self.parameters = type("Choice", (), {"value": "zero"})(), {}


@pytest.fixture
def arm(tmp_path):
    """An emulated leader at its port, and its plant, which a test puts where a person would."""
    cfg = registry.env_cfg("so101_reach")
    robot = cfg.robot
    told = json.loads(json.dumps(description.robot(robot)))
    entries = emulated.calibration(told, "so101")
    (tmp_path / "leader.json").write_text(json.dumps(entries))
    plant = Plant(scene.build(robot, cfg.scene, cfg.sim, visuals=False), robot.joints, np.array(robot.home), Clock())
    servos = emulated.servos_of(told, "so101", entries, plant)
    servos.faults.turnaround = 0.0
    port, over = emulated.Port(servos, Line(terminal=True)), threading.Event()
    thread = threading.Thread(target=port.serve, args=(over.is_set,), daemon=True)
    thread.start()
    made = so_leader.of(told, port.name, tmp_path / "leader.json", Clock())
    made.connect()
    yield made, plant, servos
    made.close()  # or the next terminal of the same name is taken
    over.set()
    thread.join()
    port.close()


def bent(plant, robot, by):
    """Puts the leader's joints where a person would [rad]; returns where they are."""
    wanted = np.array(robot.home) + by
    with plant._lock:
        for joint, at in zip(robot.joints, wanted, strict=True):
            plant.data.joint(joint).qpos[0] = at
        mujoco.mj_forward(plant.model, plant.data)
    return wanted


def test_the_leader_is_limp_and_only_read(arm):
    made, plant, servos = arm
    robot = registry.robot("so_arm101")
    assert not plant.powered.any() and servos.eeprom_writes == 0
    wanted = bent(plant, robot, np.array([0.3, 0.2, -0.2, 0.1, -0.3, 0.5]))
    np.testing.assert_allclose(made.read().position, wanted, atol=0.01)
    for refused in (made.engage, lambda: made.command(wanted, wanted)):
        with pytest.raises(ArmError, match="only be moved by hand"):
            refused()
    with pytest.raises(UserError, match="--leader needs --calibration"):
        leader.at("/dev/null", None)


def test_an_so_arm_does_with_its_joints_what_the_leader_does(arm):
    made, plant, _ = arm
    env = mjx_nero.make(
        "so101_reach", impl="native", corruption=False, episode_length_s=20.0, **{"robot.gravity_compensation": True}
    )
    session, panel = Session(env, 1, agents.known(env, "so101_reach", [])["zero"]()), Panel()
    read, follow = leader.attached(
        made, session, panel, Hand(session, lambda: False), lambda name: setattr(panel.agent, "value", name)
    )
    wanted = bent(plant, env.cfg.robot, np.array([0.3, 0.2, -0.2, 0.1, -0.3, 0.5]))
    wait(lambda: np.abs(read.position - wanted).max() < 0.01)
    assert session.params is None  # nobody lets it
    follow()
    assert panel.agent.value == leader.NAME
    session.play(leader.agent(env), panel.parameters[leader.NAME]())
    for _ in range(80):
        session.step()
    np.testing.assert_allclose(session.frame.qpos[0, :5], wanted[:5], atol=0.03)  # a reach leaves the gripper
    read.close()


def test_another_robots_hand_goes_the_leaders_way(arm):
    """The leader's first joint turns by 0.4 rad, and so does the direction of the hand; where it begins does not count."""
    made, plant, _ = arm
    env = mjx_nero.make("nero_lift", impl="native", corruption=False, episode_length_s=20.0)
    session, panel = Session(env, 1, agents.known(env, "nero_lift", [])["zero"]()), Panel()
    hand = Hand(session, lambda: False)
    read, follow = leader.attached(made, session, panel, hand, lambda name: setattr(panel.agent, "value", name))
    robot = registry.robot("so_arm101")
    bent(plant, robot, np.zeros(6))
    wait(lambda: np.abs(read.position - robot.home).max() < 0.01)
    begin, quat = hand.pos.copy(), hand.quat.copy()
    follow()
    assert panel.agent.value == HAND
    time.sleep(0.1)
    np.testing.assert_allclose(hand.pos, begin, atol=0.005)
    wanted = bent(plant, robot, np.array([0.4, 0, 0, 0, 0, 0]))
    way = leader.Way(hand)._poses
    (pos0, _), (pos1, _) = (way(np.array(q, np.float32)) for q in (robot.home, wanted))
    wait(lambda: np.abs(read.position - wanted).max() < 0.01)
    wait(lambda: np.abs(hand.pos - begin - np.asarray(pos1 - pos0)).max() < 0.01)
    assert 2 * np.arccos(min(1, abs(hand.quat @ quat))) == pytest.approx(0.4, abs=0.03)
    panel.agent.value = "zero"  # given back
    bent(plant, robot, np.zeros(6))
    wait(lambda: np.abs(read.position - robot.home).max() < 0.01)
    time.sleep(0.1)
    np.testing.assert_allclose(hand.pos - begin, np.asarray(pos1 - pos0), atol=0.01)
    read.close()
