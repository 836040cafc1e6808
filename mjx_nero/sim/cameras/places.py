"""Default places of a robot's cameras, found from the robot's shapes and its regions."""

import functools
import itertools

import mujoco
import numpy as np

from mjx_nero.sim import quats
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.cameras.cfg import CameraCfg, look_at
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.types import UserError

Size = tuple[int, int]
Cameras = dict[str, CameraCfg]

_FRONT = np.array([1.0, -0.45, 0.75])  # direction from the region to the camera, ahead of the robot, where the robot hides little
_MARGIN = 0.04  # [m] margin around the regions
_ASIDE = (0.05, 0.07, 0.09, 0.12, 0.15)  # [m] distances of a camera from the hand's axis
_BEHIND = (0.06, 0.1, 0.14)  # [m] distances behind the grasp point: nearer ones would strike the table
_NEAREST = 0.1  # [m] to the grasp point: where small cameras begin to focus
_AHEAD = 0.03  # [m] the wrist's camera looks this far ahead of the grasp point
_CLEAR = 0.012  # [m] shapes nearer to a point than this belong to it
_FREE = 0.03  # [m] free space around a camera: small ones are cubes of 3 to 4 cm
_AROUND = [np.array(way) / np.linalg.norm(way) for way in itertools.product((-1, 0, 1), repeat=3) if any(way)]  # unit directions
_EQUAL = 4  # places count as equal if their numbers of visible points differ by no more than this


def find(robot: RobotCfg, size: Size = (64, 64), kinds: tuple[str, ...] = ("rgb",)) -> Cameras:
    """Finds a camera in front and one at the wrist.

    Raises:
        UserError: the robot's config lacks its regions, or no camera fits at the wrist.
    """
    return {"front": front(robot, size, kinds), "wrist": wrist(robot, size, kinds)}


def front(robot: RobotCfg, size: Size = (64, 64), kinds: tuple[str, ...] = ("rgb",), fovy: float = 45.0) -> CameraCfg:
    """Places a camera in the world, opposite the robot, as near as it can be while it sees all of the robot's regions.

    Raises:
        UserError: the robot's config lacks them.
    """
    boxes = [np.array(box) for box in (robot.pick or robot.workspace, robot.hold or robot.workspace) if box]
    if not boxes:
        raise UserError(f"{robot.name} has none of workspace, pick and hold, which place cameras: set scene.cameras yourself")
    low, high = np.min([b[:, 0] for b in boxes], axis=0) - _MARGIN, np.max([b[:, 1] for b in boxes], axis=0) + _MARGIN
    corners = np.array(list(itertools.product(*zip(low, high, strict=True)))) + robot.base_pos
    center = corners.mean(0)
    ahead = _FRONT * np.array([np.sign(center[0] - robot.base_pos[0]) or 1.0, 1.0, 1.0])
    ahead /= np.linalg.norm(ahead)
    half = np.tan(np.deg2rad(fovy / 2))
    for far in np.arange(0.2, 5.0, 0.01):
        pos = center + far * ahead
        quat = look_at(pos, center)
        x, y, z = quats.matrix(quat).T @ (corners - pos).T
        if (z < 0).all() and (np.abs(y) <= -z * half).all() and (np.abs(x) <= -z * half * size[0] / size[1]).all():
            break
    return CameraCfg(pos=_tuple(pos), quat=_tuple(quat), fovy=fovy, size=size, kinds=kinds)


def wrist(robot: RobotCfg, size: Size = (64, 64), kinds: tuple[str, ...] = ("rgb",), fovy: float = 75.0) -> CameraCfg:
    """Places a camera on the hand that looks past the fingers.

    It takes, of many places where a small camera fits, the one that sees most points between and ahead of the fingers, open and
    closed. Among equals it takes the highest at home, which sees the table, then the nearest to the hand.

    Raises:
        UserError: none fits.
    """
    link, pos, quat = _on_hand(robot)
    return CameraCfg(link=link, pos=pos, quat=quat, fovy=fovy, size=size, kinds=kinds)


@functools.cache
def _on_hand(robot: RobotCfg) -> tuple[str, tuple, tuple]:
    """Link, position and orientation of the wrist's camera, which do not depend on its pictures."""
    model, data = scenes.at_home(robot, whole=True)
    site = model.site(robot.ee_site).id
    body = int(model.site_bodyid[site])
    grasp, turn = model.site_pos[site], quats.matrix(model.site_quat[site])
    straight = turn @ quats.matrix(robot.down).T  # from the world's axes with the hand pointing down to the link's
    side, across, back = straight.T  # rows: columns of ``straight``
    found = []
    up = data.xmat[body].reshape(3, 3)[2]  # the world's vertical, in the link's frame
    for aside, behind, angle in itertools.product(_ASIDE, _BEHIND, np.arange(8) * np.pi / 4):
        if np.hypot(aside, behind) < _NEAREST:
            continue
        out = np.cos(angle) * side + np.sin(angle) * across
        pos = grasp + behind * back + aside * out
        seen = _sees(model, robot, body, pos, grasp, straight)
        if seen >= 0:
            found.append((-(seen // _EQUAL), -round(float(out @ up), 1), aside + behind, float(angle), tuple(pos), tuple(out)))
    if not found:
        raise UserError(f"{robot.name} leaves no room for a camera at its hand: set scene.cameras yourself")
    *_, pos, out = min(found)
    quat = look_at(np.array(pos), grasp - _AHEAD * back, up=out)
    return model.body(body).name, _tuple(pos), _tuple(quat)


def _sees(model: mujoco.MjModel, robot: RobotCfg, body: int, pos: np.ndarray, grasp: np.ndarray, straight: np.ndarray) -> int:
    """Counts the points between and ahead of the fingers that a camera at ``pos`` in the link's frame sees; -1: none fits."""
    data, count, hit = mujoco.MjData(model), 0, np.zeros(1, np.int32)
    for fingers in (robot.gripper.open, robot.gripper.close):
        for joint, position in zip(robot.joints, (*robot.arm.home, *fingers), strict=True):
            data.joint(joint).qpos[0] = position
        mujoco.mj_kinematics(model, data)
        frame, origin = data.xmat[body].reshape(3, 3), data.xpos[body]
        eye = origin + frame @ pos
        if any(0 <= mujoco.mj_ray(model, data, eye, frame @ way, None, 1, -1, hit) < _FREE for way in _AROUND):
            return -1
        for local in itertools.product((-0.02, 0.0, 0.02), (-0.02, 0.0, 0.02), (0.0, -0.03, -0.06, -0.1)):
            way = origin + frame @ (grasp + straight @ np.array(local)) - eye
            far = float(np.linalg.norm(way))
            first = mujoco.mj_ray(model, data, eye, way / far, None, 1, -1, hit)
            if 0 <= first < _FREE:  # too thin for the directions around
                return -1
            count += first < 0 or first > far - _CLEAR
    return count


def _tuple(values) -> tuple:
    return tuple(round(float(x), 4) for x in values)
