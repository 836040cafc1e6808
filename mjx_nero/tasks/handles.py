"""The parts that ``open_drawer``, ``open_door`` and ``turn_knob`` share: where the fixture stands, rewards and the controller."""

import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from mjx_nero.config.bounds import PositiveRange, Range
from mjx_nero.envs import regions
from mjx_nero.envs.task import Budget, CurriculumCfg, EnvCfg, SuccessCfg
from mjx_nero.mdp import commands, fixtures, observations, randomization, rewards, terminations
from mjx_nero.mdp.fixtures import Handle
from mjx_nero.mdp.terms import ONCE, CommandTerm, DoneTerm, Groups, MetricTerm, ObservationTerm, RewardTerm, Term, groups
from mjx_nero.sim import contacts, grasp, quats
from mjx_nero.sim import fixtures as models
from mjx_nero.sim import scene as scenes
from mjx_nero.sim.fixtures import FixtureCfg
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.tasks.usual import CALM, arm_state, velocity_actions

OPEN = 0.06  # [m] greatest opening of the hand: handles are less than 2 cm wide
NEAR = 0.04  # [m] distance from the grasp point within which the handle counts as in the hand
TILT = math.radians(15)  # [rad] tilt of the hand from level, fingertips down
SPEED = 0.02  # [m/s] speed above which the handle counts as moved
OFF: Mapping[str, Range] = {"x": (-0.03, 0.03), "y": (-0.03, 0.03), "yaw": (-0.15, 0.15)}  # [m, rad] offsets of the fixture
HALF: PositiveRange = (0.5, 2.0)  # factors of damping and dry friction
LIMIT: PositiveRange = (0.9, 1.1)  # factor of the upper limit


@dataclasses.dataclass(frozen=True)
class Task:
    """A handle of a fixture, and the robot that moves it.

    Attributes:
        file: name of the fixture, both of its file and in the scene.
        handle: what to take hold of, without ``grip``, which ``held`` adds.
        middle: offset of the handle along y from ``place`` at the start, so that its path lies in front of the robot [m].
        follow, beyond: see ``FollowJointCfg``.
        level: the hand stays level. Otherwise it is tilted by ``TILT``.
    """

    robot: RobotCfg
    file: str
    handle: Handle
    middle: float = 0.0
    follow: float = 1.0
    beyond: float = 0.0
    level: bool = False

    @property
    def place(self) -> tuple[float, float, float]:
        """Place where the robot can grasp a handle and pull it by 16 cm: beyond its workspace's middle, in its upper half."""
        box = np.array(regions.box(self.robot, "workspace", "where it can work"))
        (x, y, z), (deep, _, high) = box.mean(1), np.ptp(box, axis=1)
        return round(float(x + deep / 2 + 0.02), 4), round(float(y), 4), round(float(z + 0.3 * high), 4)

    @functools.cached_property
    def builder(self) -> RobotCfg:
        """The robot as its own controller runs it: drives that carry its weight, and a hand that opens as far as needed."""
        return dataclasses.replace(grasp.opened(self.robot, OPEN), gravity_compensation=True)

    @functools.cached_property
    def held(self) -> Handle:
        """The handle with the grip of the robot's hand."""
        tilt = 0.0 if self.level else TILT
        # From pointing down with the fingers opening along y: forward, then down by the tilt.
        forward = quats.about((0.0, 1.0, 0.0), tilt - math.pi / 2)
        _, site = models.at_rest(self.file, self.handle.site)
        # The bar lies along the site's z axis. If that is horizontal, the hand makes a quarter turn about its approach.
        lies = abs(1 - 2 * (site[1] ** 2 + site[2] ** 2)) < 0.5
        about = quats.about((0.0, 0.0, 1.0), math.pi / 2 if lies else 0.0)
        hand = quats.product(forward, quats.product(about, self.robot.down))
        grip = quats.product(site * [1, -1, -1, -1], hand)
        w, x, y, z = (round(float(part), 6) + 0.0 for part in grip)
        return dataclasses.replace(self.handle, grip=(w, x, y, z))

    @functools.cached_property
    def scene(self) -> SceneCfg:
        """The scene, with the fixture placed so that the robot can move its handle."""
        at, _ = models.at_rest(self.file, self.handle.site)
        wanted = np.array(self.robot.base_pos) + self.place + [0.0, self.middle, 0.0]
        x, y, z = (round(float(v), 4) + 0.0 for v in wanted - at)
        scene = scenes.around(
            self.robot, SceneCfg(objects={}, fixtures={self.file: FixtureCfg(self.file, (x, y, z))}, goal="none")
        )
        look = np.round(wanted, 4)
        # From behind the robot's shoulder: it stands in front of the fixture.
        return dataclasses.replace(scene, view_from=(-0.6, -0.72, 0.35), look_at=(float(look[0]), float(look[1]), float(look[2])))

    def controllers(self) -> dict[str, dict[str, Any]]:
        """Builds the settings of the script that moves the handle."""
        fields = {
            "file": self.file,
            **{f"handle.{name}": value for name, value in dataclasses.asdict(self.held).items()},
            "beyond": self.beyond,
            "follow": self.follow,
            "closing": grasp.closing(self.builder, 0.0),
        }
        return {"follow_joint": {**fields, **regions.ik(self.robot, "ik.")}}

    def rewards(self, moving: Mapping[str, RewardTerm]) -> dict[str, RewardTerm]:
        """Rewards reaching, turning and closing the hand, ``moving`` the joint, and calm motion."""
        fingers, held = self.builder.gripper, {"handle": self.held}
        closes = {"near": NEAR, "open": fingers.open, "close": fingers.close}
        return {
            "reaching_handle": RewardTerm(fixtures.handle_distance, weight=1.0, params={"std": 0.1, **held}),
            "reaching_handle_fine": RewardTerm(fixtures.handle_distance, weight=1.0, params={"std": 0.02, **held}),
            "turning_hand": RewardTerm(fixtures.handle_turn, weight=1.0, params={"std": 0.5, **held}),
            "gripping": RewardTerm(fixtures.gripping, weight=2.0, params={**closes, **held}),
            **moving,
            "action_rate": RewardTerm(rewards.action_rate_l2, weight=-5e-3),
            "joint_vel": RewardTerm(rewards.joint_vel_l2, weight=-1e-4),
        }

    def observations(self) -> Groups:
        """Observes the arm, the handle and the joint. The critic also sees the joint's speed."""
        held = {"handle": self.held}
        state = {
            **arm_state(),
            "ee_to_handle": ObservationTerm(fixtures.ee_to_handle, params=held, noise=0.002),
            "turn_to_handle": ObservationTerm(fixtures.turn_to_handle, params=held, noise=0.02),
            "joint": ObservationTerm(fixtures.joint, params=held, noise=0.002),
            "actions": ObservationTerm(observations.last_action),
        }
        return groups(state, {"joint_velocity": ObservationTerm(fixtures.joint_velocity, params=held)})

    def opening(self) -> EnvCfg:
        """Builds a task that is done once the joint is at its target or beyond."""
        held = {"handle": self.held}
        return self.cfg(
            SuccessCfg(condition=Term(fixtures.opened, params=held), distance=Term(fixtures.opening_way, params=held)),
            {
                "opening": RewardTerm(fixtures.opening, weight=10.0, params=held),
                "opened": RewardTerm(fixtures.is_opened, weight=10.0, params=held),
            },
        )

    def cfg(
        self,
        success: SuccessCfg,
        moving: Mapping[str, RewardTerm],
        command: Term | None = None,
        limit: bool = True,
        steps: int = 60_000_000,
    ) -> EnvCfg:
        """Builds the task from its success and from the rewards ``moving``, which lead there.

        Args:
            command: draws the command; None: there is none.
            limit: draws the joint's upper limit anew in each episode.
            steps: env steps of a training run.
        """
        command, joint = command or Term(commands.nothing), f"{self.file}/{self.handle.joint}"
        near = {"handle": self.held, "speed": round(SPEED / self.handle.lever, 4), "near": NEAR}
        return EnvCfg(
            robot=self.builder,
            scene=self.scene,
            sim=contacts.sized(self.builder, self.scene, SimCfg(ramp=self.robot.max_step > 0)),
            episode_length_s=8.0,
            actions=velocity_actions(hysteresis=0.5),
            command=CommandTerm(command.func, params=command.params, resample_s=ONCE),
            success=success,
            metrics={"moved": MetricTerm(fixtures.Moved, params=near, over="rate", milestone=True)},
            observations=self.observations(),
            events={"stand": Term(fixtures.stand_uniform, params={"fixture": self.file, **OFF})},
            randomization={
                "joints": Term(
                    randomization.passive_joints,
                    params={"joints": (joint,), "damping": HALF, "friction": HALF, **({"upper": LIMIT} if limit else {})},
                )
            },
            rewards=self.rewards(moving),
            terminations={"time_out": DoneTerm(terminations.time_out, time_out=True)},
            curriculum=CurriculumCfg(expert_starts=0.5),
            controllers=self.controllers(),
            training=CALM,
            budget=Budget(steps=steps, steps_on_cpu=5_000_000),
        )
