"""The Cobotta's drives, and a scripted grasp that lifts, holds, swings and drops the cube, in MuJoCo's C library."""

import dataclasses

import jax.numpy as jnp
import mujoco
import numpy as np
import pytest
from model_checks import cobotta_down

from mjx_nero import env_cfg
from mjx_nero.sim import scene

CFG = env_cfg("cobotta_lift")
ROBOT = CFG.robot
ARM, GRIPPER = ROBOT.arm, ROBOT.gripper
LEAD = np.array(ARM.lead)
EDGE = CFG.scene.objects["cube"].size[0]


FLANGE = 0.26  # from the grasp point up to the flange [m]
LOW, HIGH = cobotta_down(0.5, 0.0, 0.0258 + FLANGE), cobotta_down(0.5, 0.0, 0.3 + FLANGE)
SWING = np.array([1.06, 0, 0, 0, 0, 0])  # of joint_1 [rad]


@dataclasses.dataclass
class Frame:
    """One physics step."""

    offset: np.ndarray  # of the cube from the grasp point, in the gripper's frame [m]
    ee: np.ndarray
    cube: np.ndarray
    touching: set  # names of the geoms that touch the cube
    depth: float  # to which they overlap, the most [m]
    fingers: np.ndarray


class Cell:
    """The lift scene with the gripper open about the cube; the fingers' targets keep to the drives' speed."""

    def __init__(self):
        self.model = scene.build(ROBOT, CFG.scene, CFG.sim, visuals=False)
        self.data = mujoco.MjData(self.model)
        joints = [self.model.joint(j).qposadr[0] for j in ROBOT.joints]
        self.arm, self.fingers = joints[:6], joints[6:]
        self.cube = self.model.joint("cube").qposadr[0]
        self.data.qpos[self.arm] = LOW
        self.data.qpos[self.cube : self.cube + 3] = [0.5, 0.0, EDGE / 2]
        self.data.ctrl[:6] = LOW
        mujoco.mj_forward(self.model, self.data)

    def move(self, seconds: float, start: np.ndarray, end: np.ndarray, grip: tuple[float, ...]) -> list[Frame]:
        """A minimum-jerk path of the arm, with targets as a controller gives them, one every two physics steps."""
        frames, steps = [], round(seconds / (CFG.sim.dt * CFG.sim.decimation))
        speed = np.array(GRIPPER.speed) * CFG.sim.dt * CFG.sim.decimation
        for k in range(steps):
            t = (k + 1) / steps
            q = start + (end - start) * (10 * t**3 - 15 * t**4 + 6 * t**5)
            qd = (end - start) * (30 * t**2 - 60 * t**3 + 30 * t**4) / seconds
            self.data.ctrl[:6] = q + LEAD * qd
            self.data.ctrl[6:] += np.clip(np.array(grip) - self.data.ctrl[6:], -speed, speed)
            for _ in range(CFG.sim.decimation):
                mujoco.mj_step(self.model, self.data)
                frames.append(self.frame())
        return frames

    def frame(self) -> Frame:
        # All of the moment before the step: poses, contacts.
        site, cube = self.data.site("ee"), self.data.body("cube").xpos.copy()
        touching, depth = set(), 0.0
        for contact in self.data.contact:
            names = {self.model.geom(g).name for g in contact.geom}
            if "cube" in names:
                touching |= names - {"cube"}
                depth = max(depth, -contact.dist)
        offset = site.xmat.reshape(3, 3).T @ (cube - site.xpos)
        return Frame(offset, site.xpos.copy(), cube, touching, depth, self.data.qpos[self.fingers].copy())


@pytest.fixture(scope="module")
def script() -> dict[str, list[Frame]]:
    """The frames of each phase: close, lift, hold for four seconds, swing to and fro three times, open."""
    cell, closed, away = Cell(), GRIPPER.close, HIGH + SWING
    frames = {"close": cell.move(0.8, LOW, LOW, closed), "lift": cell.move(1.0, LOW, HIGH, closed)}
    frames["settle"] = cell.move(1.0, HIGH, HIGH, closed)
    frames["hold"] = cell.move(3.0, HIGH, HIGH, closed)
    for i in range(6):
        there, back = (HIGH, away) if i % 2 == 0 else (away, HIGH)
        frames[f"swing {i}"] = cell.move(1.0, there, back, closed)
    frames["open"] = cell.move(1.0, HIGH, HIGH, GRIPPER.open)
    return frames


PADS = {"left_pad", "right_pad"}


def test_gripper_closes_on_the_cube(script):
    frames, last = script["close"], script["close"][-1]
    assert last.touching - {"table"} == PADS
    gap = float(GRIPPER.gap(jnp.asarray(last.fingers)))
    assert gap == pytest.approx(EDGE - 2 * last.depth, abs=3e-4)
    np.testing.assert_allclose(last.fingers[0], -last.fingers[1], atol=3e-3)  # the linkage
    assert max(f.depth for f in frames) < 2e-3  # when they meet it
    assert max(f.depth for f in frames[50:]) < 1e-3
    assert np.linalg.norm(last.cube[:2] - [0.5, 0.0]) < 1e-3  # and do not push it about


def test_cube_is_lifted_by_both_pads_alone(script):
    assert script["lift"][-1].cube[2] > 0.28
    for phase in ("settle", "hold"):
        assert all(f.touching == PADS for f in script[phase])
        assert max(f.depth for f in script[phase]) < 1e-3
    np.testing.assert_allclose(script["settle"][-1].ee, [0.5, 0.0, 0.3], atol=2e-3)


def test_held_cube_does_not_creep(script):
    start, end = script["hold"][0].offset, script["hold"][-1].offset
    assert np.linalg.norm(end - start) / 3.0 < 1e-3  # m/s
    assert np.ptp([f.cube for f in script["hold"]], axis=0).max() < 3e-3


@pytest.mark.parametrize("i", range(6))
def test_cube_stays_in_the_grip_of_a_swinging_arm(script, i):
    """Half a metre in one second: the cube slides a little at each turn, and stays."""
    frames = script[f"swing {i}"]
    before = script[f"swing {i - 1}" if i else "hold"][-1]
    assert np.linalg.norm(frames[-1].ee - before.ee) >= 0.5
    offsets = np.array([f.offset for f in frames])
    assert np.linalg.norm(offsets - before.offset, axis=1).max() < 8e-3
    assert frames[-1].touching == PADS and frames[-1].cube[2] > 0.27


def test_opening_drops_it(script):
    last = script["open"][-1]
    assert last.cube[2] < EDGE and not last.touching & PADS
    np.testing.assert_allclose(last.fingers, GRIPPER.open, atol=5e-3)


# --- drives


@pytest.mark.parametrize("gripper", ["open", "close"])
@pytest.mark.parametrize("joint", range(6))
def test_step_responses_of_the_arm(joint, gripper):
    """0.1 rad from home: no overshoot worth the name, no error that stays, forces within the drives'."""
    model = scene.build(ROBOT, dataclasses.replace(CFG.scene, objects={}), CFG.sim, visuals=False)
    data = mujoco.MjData(model)
    joints = [model.joint(j).qposadr[0] for j in ROBOT.joints]
    data.qpos[joints] = ROBOT.home
    data.ctrl[:] = ROBOT.home
    data.ctrl[6:] = getattr(GRIPPER, gripper)
    for _ in range(100):  # the gripper gets to where it belongs
        mujoco.mj_step(model, data)
    data.ctrl[joint] += 0.1
    path, limit = [], np.array(ARM.effort + GRIPPER.effort)
    for _ in range(200):
        mujoco.mj_step(model, data)
        assert (np.abs(data.actuator_force) <= limit + 1e-9).all()
        path.append(data.qpos[joints[:6]] - ARM.home)
    path = np.array(path)
    assert path[:, joint].max() < 0.102
    wanted = 0.1 * (np.arange(6) == joint)
    assert np.abs(path[-1] - wanted).max() < 1e-3
    settled = np.abs(path[:, joint] - 0.1) < 0.005
    assert settled[100:].all()  # within a second
