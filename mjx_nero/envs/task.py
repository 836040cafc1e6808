"""An ``EnvCfg`` is a task: it and its parts are plain data, which ``env`` runs."""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

from mjx_nero import config
from mjx_nero.config import bounds
from mjx_nero.config.bounds import Count, Density, NonNegative, Positive, Share
from mjx_nero.envs import old_names
from mjx_nero.mdp import actions, success
from mjx_nero.mdp.terms import ROBOT, CommandTerm, DoneTerm, MetricTerm, ObservationGroup, RewardTerm, Term
from mjx_nero.sim.robot import RobotCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.types import TARGET, UserError


def joint_actions(scale: float = 0.5, gripper: bool = True) -> dict[str, Term]:
    """Lists action terms: ``home + scale * entry`` [rad] per arm joint, and one entry for a gripper (negative closes).

    Without ``gripper``, the gripper stays at home.
    """
    return {
        "arm": Term(actions.JointPosition, params={"scale": scale}),
        **({"gripper": Term(actions.BinaryGripper)} if gripper else {}),
        "speed_limit": Term(actions.SpeedLimit),
    }


def drive_targets() -> dict[str, Term]:
    """Lists the one action term of controllers: a position target per drive [rad or m]. The controller limits their speed."""
    return {"drives": Term(actions.DriveTargets)}


@dataclasses.dataclass(frozen=True)
class SuccessCfg:
    """Success: ``condition`` holds at the end of the episode. ``distance`` is the length that it judges [m].

    Attributes:
        hold_s: how long the condition must have held at the end of the episode [s].
        follows: True: the task is to keep the distance small, as when tracking. False: it is to cover the distance once.
    """

    condition: Term = Term(success.object_at_goal, params={"threshold": 0.02})
    distance: Term = Term(success.object_distance)
    hold_s: NonNegative = 0.5
    follows: bool = False


@dataclasses.dataclass(frozen=True)
class Budget:
    """Default length of a training run, and when the task counts as learnt.

    Attributes:
        steps: env steps with a GPU's thousands of environments.
        steps_on_cpu: env steps with a CPU's hundreds of environments, which need fewer.
        success: success rate at which the task counts as learnt.
    """

    steps: Count = 100_000_000
    steps_on_cpu: Count = 10_000_000
    success: Share = 0.95


@dataclasses.dataclass(frozen=True)
class CurriculumCfg:
    """Everything that makes the task harder during training.

    Attributes:
        weights: terms that change the weight of the reward of the same name (``mdp.curriculum``).
        levels: scales randomization, sensors, delays, target noise, pushes and ``curriculum.level_weight`` by each environment's
            own success rate. None: always full, as outside of training.
        expert_starts: initial share of episodes that start from states visited by the task's first controller; 0: none. The share
            falls to zero as the usual starts succeed (``curriculum.chances``).
    """

    weights: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    levels: Term | None = None
    expert_starts: Share = 0.0

    def __post_init__(self):
        config.freeze(self)


@dataclasses.dataclass(frozen=True)
class ThingCfg:
    """A mesh that replaces a task's object (``envs.things``).

    Attributes:
        file: an OBJ, STL or GLB file, a folder with an ``object.yaml``, or one of the package's objects by name. Empty: none.
        scale: factor of the mesh's lengths.
        density: density [kg/m3]; 0: that of its ``object.yaml``, or else 500.
    """

    file: str = ""
    scale: Positive = 1.0
    density: Density = 0.0


@dataclasses.dataclass(frozen=True)
class EnvCfg:
    """A whole task. Read ``tasks/lift.py`` for an example. Every field can be overridden by its dotted name.

    Attributes:
        actions: terms from the policy's output to the drives' targets, in this order.
        action_clip: bound of every action entry; 0: none.
        randomization: random model fields, drawn anew in every episode (``mdp.randomization``).
        sensors: errors between the true state and the ``sensed`` observation groups, in this order (``mdp.sensors``). Unlike
            observation noise, they are always on.
        look: random appearance in the cameras' pictures, drawn anew in every episode (``mdp.looks``). Physics is not affected.
        obstacles: places the scene's obstacles once each episode's start and goal are drawn (``mdp.obstacles``).
        pushes: sudden velocities added to objects (``mdp.pushes``).
        identified: a file of ``python -m mjx_nero identify`` whose drives and delay replace the robot's own.
        object: a mesh that replaces the task's object, as set by ``--object FILE``.
        controllers: controllers of ``mjx_nero.control`` that can do the task, the usual one first, each with fields of its config
            by dotted name.
        learner: the learner that trains the task by default.
        training: fields of the learner's config that suit the task, by dotted name.
        budget: default length of a training run.

    Raises:
        UserError: a field is out of bounds, or a term names an object that does not exist.
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
    episode_length_s: Positive = 5.0  # length of an episode [s]
    randomization: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    sensors: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    look: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    obstacles: Term | None = None
    pushes: Mapping[str, Term] = dataclasses.field(default_factory=dict)
    identified: str = ""
    object: ThingCfg = ThingCfg()
    controllers: Mapping[str, Mapping[str, Any]] = dataclasses.field(default_factory=dict)
    learner: str = "ppo"
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
        if self.look and not self.scene.cameras:
            raise UserError(f"look.{next(iter(self.look))} changes what cameras see, but the scene has none (scene.cameras)")
        if targets and TARGET in self.scene.objects:
            raise UserError(f"scene.objects.{TARGET} needs another name: terms use this one for the commanded object")
        for name, term in self.terms().items():
            self._check_objects(name, term)
            self._check_robot(name, term)

    def _check_objects(self, name: str, term: Term) -> None:
        """Checks that the objects of the term called ``name`` exist."""
        targets, seen = self.command.targets, tuple(f"{group}." for group in ("sensors", *self.view_terms()))
        there = (*self.scene.objects, *((TARGET,) if targets and name.startswith(seen) else ()))
        listed = ", ".join(there) or "none"
        wanted = term.params.get("object")
        if wanted is not None and wanted not in there:
            raise UserError(f"{name}.params.object is {wanted!r}, but the scene's objects are: {listed}")
        if unknown := [each for each in term.params.get("objects", ()) if each not in there]:
            raise UserError(f"{name}.params.objects names {', '.join(unknown)}, but the scene's objects are: {listed}")
        heights = term.params.get("minimal_height")
        if isinstance(heights, tuple) and len(heights) != len(targets):
            raise UserError(f"{name}.params.minimal_height is one height, or one for each of {len(targets)} targets")

    def _check_robot(self, name: str, term: Term) -> None:
        """Checks that the robot in the parameters of the term called ``name`` exists, and that the term reads a view."""
        if (robot := term.params.get(ROBOT)) is None:
            return
        if robot and robot not in self.scene.robots:
            there = ", ".join(self.scene.robots) or "none but the first"
            raise UserError(f"{name}.params.robot is {robot!r}, but the scene's further robots are: {there}")
        if not name.startswith(tuple(f"{group}." for group in self.view_terms())):
            raise UserError(f"{name}.params.robot has no effect: only terms that read a view see a robot")

    def current(self, fields: Mapping[str, Any]) -> dict[str, Any]:
        """Translates fields of version 0.5.0 to their present names: see ``envs.old_names``."""
        return old_names.current(fields, self.observations, self.curriculum.weights)

    def uncorrupted(self) -> "EnvCfg":
        """Returns the task without observation noise, for measuring policies."""
        groups = {name: dataclasses.replace(group, corruption=False) for name, group in self.observations.items()}
        return dataclasses.replace(self, observations=groups)

    def changed(self, change: Callable[[Any], Any]) -> "EnvCfg":
        """Returns the task with ``change(term)`` in place of every term that reads a view."""

        def each(terms: Mapping[str, Term]) -> dict[str, Any]:
            return {name: change(term) for name, term in terms.items()}

        ends = {"condition": change(self.success.condition), "distance": change(self.success.distance)}
        return dataclasses.replace(
            self,
            observations={n: dataclasses.replace(group, terms=each(group.terms)) for n, group in self.observations.items()},
            success=dataclasses.replace(self.success, **ends),
            rewards=each(self.rewards),
            terminations=each(self.terminations),
            metrics=each(self.metrics),
        )

    def view_terms(self) -> dict[str, Mapping[str, Term]]:
        """Collects the terms that read a view, by the dotted names of their groups in the episode's memory."""
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
        """Collects all terms that may name an object, by their dotted names."""
        groups = {
            **self.view_terms(),
            "events": self.events,
            "randomization": self.randomization,
            "sensors": self.sensors,
            "pushes": self.pushes,
        }
        return {f"{group}.{name}": term for group, terms in groups.items() for name, term in terms.items()}


def takes_targets(cfg: EnvCfg) -> bool:
    """Returns whether the task's actions are drive targets: a controller's, not a policy's."""
    return any(bounds.unwrapped(term.func) is actions.DriveTargets for term in cfg.actions.values())


def for_controllers(cfg: EnvCfg) -> EnvCfg:
    """Returns the task for controllers.

    Drive targets replace the actions that policies learn, and the arm carries its own weight, as real arms' controllers do.
    """
    if takes_targets(cfg):
        return cfg
    return compensated(dataclasses.replace(cfg, actions=drive_targets()))


def compensated(cfg: EnvCfg) -> EnvCfg:
    """Returns the task with gravity compensation in all robots."""
    robot, *others = (dataclasses.replace(each, gravity_compensation=True) for each in (cfg.robot, *cfg.scene.robots.values()))
    scene = dataclasses.replace(cfg.scene, robots=dict(zip(cfg.scene.robots, others, strict=True)))
    return dataclasses.replace(cfg, robot=robot, scene=scene)


Presets = Mapping[str, Callable[[RobotCfg], EnvCfg]]  # by name, default first
Envs = dict[str, tuple[RobotCfg | None, Presets]]  # by name, with each one's robot
