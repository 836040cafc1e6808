"""What a task is: an ``EnvCfg`` and its parts, all data. ``env`` runs it."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from mjx_nero import config
from mjx_nero.config import bounds
from mjx_nero.config.bounds import Count, NonNegative, Positive, Share, Steps
from mjx_nero.envs import old_names
from mjx_nero.mdp import actions, success
from mjx_nero.mdp.terms import CommandTerm, DoneTerm, MetricTerm, ObservationGroup, RewardTerm, Term
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.types import TARGET, UserError


def joint_actions(scale: float = 0.5, gripper: bool = True) -> dict[str, Term]:
    """One action an arm joint (``home + scale * action`` [rad]), then one for the gripper (negative closes), if it has one.

    Without it the gripper stays at home.
    """
    return {
        "arm": Term(actions.JointPosition, params={"scale": scale}),
        **({"gripper": Term(actions.BinaryGripper)} if gripper else {}),
        "speed_limit": Term(actions.SpeedLimit),
    }


def velocity_actions(gripper: bool = True, late: Steps = (0, 1), hysteresis: NonNegative = 0.0) -> dict[str, Term]:
    """One action an arm joint (its velocity, at +-1 the drive's), then one for the gripper, if it has one.

    An episode's actions come late by as many control steps as it draws from ``late``, as those of a real arm do. ``hysteresis``
    is the gripper's (``mdp.actions.BinaryGripper``).
    """
    grip = Term(actions.BinaryGripper, params={"hysteresis": hysteresis})
    hand = {"gripper": grip, "speed_limit": Term(actions.SpeedLimit, params={"group": "gripper"})}
    return {
        "delay": Term(actions.Delay, params={"steps": late}),
        "arm": Term(actions.JointVelocity),
        **(hand if gripper else {}),
    }


# Of the learner: noise of half of an action at most; for velocities, a policy that changes its mind for a reason, too.
QUIET = {"network.init_std": 0.5, "max_std": 0.5}
CALM = {**QUIET, "change_cost": 0.03}


def drive_targets() -> dict[str, Term]:
    """The drives' position targets themselves [rad or m], one a drive; their speed is left to whoever gives them: controllers."""
    return {"drives": Term(actions.DriveTargets)}


@dataclasses.dataclass(frozen=True)
class SuccessCfg:
    """``condition`` has held for the end of the episode; ``distance`` [m] is what it is about.

    Attributes:
        hold_s: for how long it has held [s].
        follows: the distance is an error, which is to stay small once the robot is there; else it is a way to go.
    """

    condition: Term = Term(success.object_at_goal, params={"threshold": 0.02})
    distance: Term = Term(success.object_distance)
    hold_s: NonNegative = 0.5
    follows: bool = False


@dataclasses.dataclass(frozen=True)
class Budget:
    """What a training of the task takes, where nobody asks for another number of env steps.

    Attributes:
        steps: env steps, with the thousands of environments of a GPU.
        steps_on_cpu: env steps with the hundreds of environments of a CPU, which learn from fewer.
        success: the success rate from which on the task counts as learnt.
    """

    steps: Count = 100_000_000
    steps_on_cpu: Count = 10_000_000
    success: Share = 0.95


@dataclasses.dataclass(frozen=True)
class CurriculumCfg:
    """What grows harder in training.

    Attributes:
        weights: changes the weight of the reward of the same name (``mdp.curriculum``).
        levels: scales randomization, sensors, late observations and actions, the targets' noise, and pushes by each training
            environment's own successes, and rewards by ``curriculum.level_weight``. None: always full, as outside of training.
        expert_starts: share of the episodes that begin, at first, where the first of the task's controllers has been in episodes
            of its own; 0: none. It falls to nothing as the usual starts succeed (``curriculum.chances``).
    """

    weights: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    levels: Term | None = None
    expert_starts: Share = 0.0

    def __post_init__(self):
        config.freeze(self)


@dataclasses.dataclass(frozen=True)
class EnvCfg:
    """All of a task. Read ``tasks/lift.py`` for an example; every field can be overridden by its dotted name.

    Attributes:
        actions: from the policy's output to the drives' targets, in this order.
        action_clip: bounds every action to +-this before use; 0 leaves them alone.
        randomization: model fields that every episode draws anew (``mdp.randomization``).
        sensors: stand between the world and the observation groups that are ``sensed``, in this order (``mdp.sensors``). They are
            always on, unlike the noise of observations.
        obstacles: where the scene's obstacles stand, drawn for every episode once its start and goal are (``mdp.obstacles``).
        pushes: sudden changes of objects' velocities (``mdp.pushes``).
        identified: a file of ``python -m mjx_nero identify``, whose drives and delay take the place of the robot's own.
        controllers: those of ``mjx_nero.control`` that can do the task, the usual one first, each with fields of its config by
            dotted name.
        training: fields of the learner's config that suit the task, likewise.
        budget: how long a training takes.

    Raises:
        UserError: a field is out of its bounds, or terms name what is not there.
    """

    robot: RobotCfg
    command: CommandTerm
    observations: Mapping[str, ObservationGroup]
    rewards: Mapping[str, RewardTerm]
    terminations: Mapping[str, DoneTerm]
    events: Mapping[str, Term]
    curriculum: CurriculumCfg = CurriculumCfg()
    scene: SceneCfg = SceneCfg()
    sim: SimCfg = SimCfg()
    actions: Mapping[str, Term] = dataclasses.field(default_factory=joint_actions)
    action_clip: NonNegative = 0.0
    success: SuccessCfg = SuccessCfg()
    metrics: Mapping[str, MetricTerm] = dataclasses.field(default_factory=dict)
    episode_length_s: Positive = 5.0  # [s]
    randomization: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    sensors: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    obstacles: Term | None = None
    pushes: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    identified: str = ""
    controllers: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    training: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    budget: Budget = Budget()

    def __post_init__(self):
        config.freeze(self)
        bounds.check(self)
        targets = self.command.targets
        for what, names, valid in (
            ("curriculum.weights", self.curriculum.weights, self.rewards),
            ("command.targets", targets, self.scene.objects),
        ):
            if unknown := [name for name in names if name not in valid]:
                raise UserError(f"{what} names {', '.join(unknown)}: not one of {', '.join(valid)}")
        if targets and TARGET in self.scene.objects:
            raise UserError(f"scene.objects.{TARGET} needs another name: terms call the commanded one of targets so")
        for name, term in self.terms().items():
            self._check_objects(name, term)

    def _check_objects(self, name: str, term: Term) -> None:
        """A term names objects that are there; ``name`` is its own."""
        targets, seen = self.command.targets, tuple(f"{group}." for group in ("sensors", *self.view_terms()))
        there = (*self.scene.objects, *((TARGET,) if targets and name.startswith(seen) else ()))
        listed = ", ".join(there) or "none"
        wanted = term.params.get("object")
        if wanted is not None and wanted not in there:
            raise UserError(f"{name}.params.object is {wanted!r}, and the scene's objects are: {listed}")
        if unknown := [each for each in term.params.get("objects", ()) if each not in there]:
            raise UserError(f"{name}.params.objects names {', '.join(unknown)}, and the scene's objects are: {listed}")
        heights = term.params.get("minimal_height")
        if isinstance(heights, tuple) and len(heights) != len(targets):
            raise UserError(f"{name}.params.minimal_height is one height, or one for each of {len(targets)} targets")

    def current(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Fields by dotted name with the names that they have now: see ``envs.old_names``."""
        return old_names.current(fields, self.observations, self.curriculum.weights)

    def uncorrupted(self) -> "EnvCfg":
        """The task without observation noise, as policies are measured."""
        groups = {name: dataclasses.replace(group, corruption=False) for name, group in self.observations.items()}
        return dataclasses.replace(self, observations=groups)

    def view_terms(self) -> dict[str, Mapping[str, Term]]:
        """The terms of a view by the dotted names of their groups; of observations as the episode's memory has them."""
        observed = {f"observations.{name}": group.terms for name, group in self.observations.items()}
        ends = {"condition": self.success.condition, "distance": self.success.distance}
        return {
            **observed,
            "rewards": self.rewards,
            "terminations": self.terminations,
            "success": ends,
            "metrics": self.metrics,
        }

    def terms(self) -> dict[str, Term]:
        """All terms that may name an object, by their dotted names."""
        groups = {
            **self.view_terms(),
            "events": self.events,
            "randomization": self.randomization,
            "sensors": self.sensors,
            "pushes": self.pushes,
        }
        return {f"{group}.{name}": term for group, terms in groups.items() for name, term in terms.items()}


def for_controllers(cfg: EnvCfg) -> EnvCfg:
    """The task as controllers act in it: by drive targets, in place of the actions that policies learn, with an arm that carries
    its own weight, as real arms' controllers have it do."""
    if any(bounds.unwrapped(term.func) is actions.DriveTargets for term in cfg.actions.values()):
        return cfg
    return dataclasses.replace(cfg, actions=drive_targets(), robot=dataclasses.replace(cfg.robot, gravity_compensation=True))


Presets = Mapping[str, Callable[[RobotCfg], EnvCfg]]  # by name, the default first
Envs = dict[str, tuple[RobotCfg | None, Presets]]  # by name, with the robot each is meant for
