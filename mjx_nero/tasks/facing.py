"""Two robots face to face that hand over a bar: where they stand, and how far each one reaches."""

import dataclasses
import math
from typing import Any

import numpy as np

from mjx_nero.envs import regions
from mjx_nero.mdp.handover import Hands
from mjx_nero.sim import grasp, quats
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import ObjectCfg, SceneCfg
from mjx_nero.tasks.building import working
from mjx_nero.types import UserError

BAR, TAKER = "bar", "taker"
ALONG, HALF = 0.09, 0.13  # [m] from the bar's middle to a hand, and to its end
SIDE = math.pi / 2  # [rad] how far each arm turns between its own side and the meeting point
YAW = 0.25  # [rad] greatest turn of the bar at the start; unturned, it points straight away from the first arm
WIDER = 2.0  # opening of the hands, in widths of the bar
AWAY = 0.05  # [m] distance from the bar's axis beyond which a hand has left it
JOINTS = 6  # fewest joints of an arm that can point its hand down all around itself


@dataclasses.dataclass(frozen=True)
class Side:
    """One robot, as the task sees it.

    Attributes:
        robot: the mounted robot, with its home turned to its own side.
        near, far: least and greatest distance of the grasp point from the base, along the table [m].
        low, high: heights at which its hand points down, from the root [m].
        turn: angle of the first joint from home to the meeting point [rad].
    """

    robot: RobotCfg
    near: float
    far: float
    low: float
    high: float
    turn: float

    @property
    def middle(self) -> float:
        """Distance from the base of the meeting point [m]."""
        return (self.near + self.far) / 2

    @property
    def across(self) -> float:
        """Half the width of its region, across the direction away from its base [m]."""
        return round(min(self.near * math.tan(YAW), self.far / 4), 4)


def _side(robot: RobotCfg, edge: float, faces: float, aside: float) -> Side:
    """Mounts a robot so that it faces ``faces`` [rad], and turns its home by ``aside`` from there [rad].

    Raises:
        UserError: the robot has too few joints, or its first joint cannot turn it that far about the vertical.
    """
    if len(robot.arm.joints) < JOINTS:
        few = f"{robot.name} has {len(robot.arm.joints)} joints"
        raise UserError(f"{few}: to hand a bar over, an arm needs {JOINTS}, so that its hand points down all around")
    pick = np.array(regions.box(robot, "pick", "where on the table it can grasp"))
    regions.box(robot, "hold", "where it can hold what it has grasped")
    quarter = round(float(np.arctan2(*pick.mean(1)[1::-1])) / SIDE)  # direction of its front, in quarter turns
    front = np.sort(np.abs(pick[quarter % 2]))
    half = (faces - quarter * SIDE) / 2
    quat = quats.product([math.cos(half), 0.0, 0.0, math.sin(half)], robot.base_quat)
    w, x, y, z = (round(float(v), 6) for v in quat)
    robot = dataclasses.replace(working(grasp.opened(robot, WIDER * edge)), base_quat=(w, x, y, z))
    ahead = regions.turn_to(robot, math.cos(faces), math.sin(faces))
    home = ahead + _turned(robot, ahead, faces, aside)
    arm = dataclasses.replace(robot.arm, home=(round(robot.arm.home[0] + home, 4), *robot.arm.home[1:]))
    margin = 0.2 * float(np.ptp(front))
    return Side(
        robot=dataclasses.replace(robot, arm=arm),
        near=round(float(front[0]) + margin, 4),
        far=round(float(front[1]) - margin, 4),
        low=float(pick[2, 0]),
        high=float(pick[2, 1]),
        turn=round(ahead - home, 4),
    )


def _turned(robot: RobotCfg, ahead: float, faces: float, aside: float) -> float:
    """Turn of the first joint from straight ahead to its own side [rad]."""
    to = regions.turn_to(robot, math.cos(faces + aside), math.sin(faces + aside)) - ahead
    if abs(abs(to) - SIDE) > 0.01:
        raise UserError(f"{robot.name}: its first joint does not turn it by 90 degrees about the vertical: a handover needs that")
    return to


@dataclasses.dataclass(frozen=True)
class Pair:
    """Two robots that face each other, with the bar between them."""

    giver: Side
    taker: Side
    edge: float

    @property
    def height(self) -> float:
        """Height of the bar where it changes hands, from the table [m]."""
        return round(min(side.low + 0.75 * (side.high - side.low) for side in (self.giver, self.taker)), 4)

    @property
    def meet(self) -> tuple[float, float, float]:
        """The bar's middle where it changes hands, relative to the giver's root [m]."""
        return round(self.giver.middle + ALONG, 4), 0.0, round(self.height - self.giver.robot.base_pos[2], 4)

    @property
    def between(self) -> float:
        """Distance between the bases [m]."""
        return round(self.giver.middle + 2 * ALONG + self.taker.middle, 4)

    @property
    def mate(self) -> RobotCfg:
        """The taker in its place."""
        x, y, _ = self.giver.robot.base_pos
        place = (round(x + self.between, 4), y, self.taker.robot.base_pos[2])
        return dataclasses.replace(self.taker.robot, base_pos=place)

    @property
    def bar(self) -> ObjectCfg:
        """The bar: as heavy as the cube that the weaker hand lifts."""
        mass = min(grasp.cube_for(side.robot).mass for side in (self.giver, self.taker))
        return ObjectCfg(size=(2 * HALF, self.edge, self.edge), mass=mass, rgba=(0.85, 0.55, 0.2, 1.0))

    @property
    def scene(self) -> SceneCfg:
        """Table, bar and both robots."""
        (x, y, _), wide = self.giver.robot.base_pos, max(self.giver.far, self.taker.far) + 2 * HALF + 0.1
        return SceneCfg(
            objects={BAR: self.bar},
            robots={TAKER: self.mate},
            goal=BAR,
            table_center=(round(x + self.between / 2, 4), y),
            table_size=(round(self.between + 2 * max(self.giver.near, 0.2), 4), round(2 * wide, 4)),
            look_at=(round(x + self.between / 2, 4), y, 0.12),
            view_distance=round(1.1 * self.between + 0.8, 2),
            view_from=(0.35, -0.85, 0.55),
        )

    @property
    def hands(self) -> Hands:
        """The two hands and the bar."""
        giving, taking = ((side.robot.gripper.open, side.robot.gripper.close) for side in (self.giver, self.taker))
        return Hands(
            object=BAR,
            taker=TAKER,
            along=ALONG,
            half=HALF,
            radius=0.04,
            minimal_height=round(self.edge / 2 + 0.03, 4),
            clearance=AWAY,
            giving=giving,
            taking=taking,
        )

    def ways(self, side: Side) -> tuple[tuple[float, float], tuple[float, float]]:
        """Region of the bar's middle beside a robot, relative to its root: across, and out from its base [m]."""
        return (-side.across, side.across), (round(side.near + ALONG, 4), round(side.far + ALONG, 4))

    def script(self) -> dict[str, Any]:
        """Builds the settings of the script."""
        sides, edge = (self.giver, self.taker), self.edge
        ik = regions.ik(self.giver.robot, "ik.") | regions.ik(self.taker.robot, "ik.")
        return {
            "object": BAR,
            "taker": TAKER,
            "along": ALONG,
            "meet": self.meet,
            "turns": tuple(side.turn for side in sides),
            "lowest": tuple(round(grasp.lowest(side.robot.pad), 4) for side in sides),
            "beyond": tuple(grasp.beyond(side.robot, edge) for side in sides),
            "closing": tuple(grasp.closing(side.robot, edge) for side in sides),
            **ik,
        }


def pair(giver: RobotCfg, taker: RobotCfg) -> Pair:
    """Places two robots face to face. Raises the errors of ``_side`` and of ``grasp.cube_for``."""
    edge = min(grasp.cube_for(robot).size[0] for robot in (giver, taker))
    giver, taker = (grasp.shut(robot, edge) for robot in (giver, taker))
    return Pair(_side(giver, edge, 0.0, -SIDE), _side(taker, edge, math.pi, -SIDE), edge)
