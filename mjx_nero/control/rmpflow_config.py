"""The two YAML files of RMPflow: robot descriptor and parameters, read and checked.

Keys and structure are Lula's, so files of Isaac Sim's tutorials ("Adding a new manipulator", 5.x) can be used as they are. The
symbols of ``mjx_nero.control.rmpflow``'s formulas are these keys. Lengths in m, angles in rad, times in s.
"""

import dataclasses
import pathlib
from collections.abc import Iterable
from typing import Any, TypeVar

from mjx_nero import files
from mjx_nero.config.bounds import NonNegative, Positive, Share
from mjx_nero.config.values import read, unknown
from mjx_nero.errors import UserError
from mjx_nero.sim.robot import ASSETS

Cfg = TypeVar("Cfg")
Gain = NonNegative
Point = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class CspaceTargetCfg:
    """Pull towards the posture ``default_q``."""

    metric_scalar: Gain
    position_gain: Gain
    damping_gain: Gain
    robust_position_term_thresh: Positive
    inertia: Gain


@dataclasses.dataclass(frozen=True)
class CspaceTrajectoryCfg:
    """Inactive: Lula publishes no formula, and Isaac Sim's RMPflow never activates it."""

    p_gain: Gain
    d_gain: Gain
    ff_gain: Gain
    weight: Gain


@dataclasses.dataclass(frozen=True)
class CspaceAffineCfg:
    """Inactive, like ``CspaceTrajectoryCfg``."""

    final_handover_time_std_dev: Gain
    weight: Gain


@dataclasses.dataclass(frozen=True)
class JointLimitCfg:
    """Push away from the joint limits; lengths are fractions of a joint's range."""

    metric_scalar: Gain
    metric_length_scale: Positive
    metric_exploder_eps: Positive
    metric_velocity_gate_length_scale: Positive
    accel_damper_gain: Gain
    accel_potential_gain: Gain
    accel_potential_exploder_length_scale: Positive
    accel_potential_exploder_eps: Positive


@dataclasses.dataclass(frozen=True)
class JointVelocityCapCfg:
    """Brake near the top speed."""

    max_velocity: Positive
    velocity_damping_region: Positive
    damping_gain: Gain
    metric_weight: Gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class PullCfg:
    """Pull to a target. The last two keys have no documented effect and none here."""

    accel_p_gain: Gain
    accel_d_gain: Gain
    proximity_metric_boost_scalar: Gain
    proximity_metric_boost_length_scale: Positive
    xi_estimator_gate_std_dev: Gain = 20000.0
    accept_user_weights: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True)
class TargetCfg(PullCfg):
    """Pull of the frame's origin to its target."""

    accel_norm_eps: Positive
    metric_alpha_length_scale: Positive
    min_metric_alpha: Share
    max_metric_scalar: Gain
    min_metric_scalar: Gain


@dataclasses.dataclass(frozen=True, kw_only=True)
class AxisTargetCfg(PullCfg):
    """Pull of the frame's axes to the target's."""

    metric_scalar: Gain


@dataclasses.dataclass(frozen=True)
class CollisionCfg:
    """Push of the robot's spheres away from obstacles."""

    damping_gain: Gain
    damping_std_dev: Positive
    damping_robustness_eps: Positive
    damping_velocity_gate_length_scale: Positive
    repulsion_gain: Gain
    repulsion_std_dev: Positive
    metric_modulation_radius: Positive
    metric_scalar: Gain
    metric_exploder_std_dev: Positive
    metric_exploder_eps: Positive


@dataclasses.dataclass(frozen=True)
class DampingCfg:
    """Damping and inertia along the line to the target."""

    accel_d_gain: Gain
    metric_scalar: Gain
    inertia: Gain


@dataclasses.dataclass(frozen=True)
class RmpParams:
    """One group per kind of leaf."""

    cspace_target_rmp: CspaceTargetCfg
    cspace_trajectory_rmp: CspaceTrajectoryCfg
    cspace_affine_rmp: CspaceAffineCfg
    joint_limit_rmp: JointLimitCfg
    joint_velocity_cap_rmp: JointVelocityCapCfg
    target_rmp: TargetCfg
    axis_target_rmp: AxisTargetCfg
    collision_rmp: CollisionCfg
    damping_rmp: DampingCfg


@dataclasses.dataclass(frozen=True)
class ResolveCfg:
    """``max_acceleration_norm`` [rad/s^2] limits the resolved acceleration. The other two keys have no effect here."""

    max_acceleration_norm: Positive
    projection_tolerance: Gain = 0.01
    verbose: bool = False


@dataclasses.dataclass(frozen=True)
class CylinderCfg:
    """A capsule fixed to the base, in the base link's frame [m]."""

    name: str
    pt1: Point
    pt2: Point
    radius: Positive


@dataclasses.dataclass(frozen=True)
class ControllerCfg:
    """A sphere [m] round the origin of a body or site; keeps clear of the body cylinders and of obstacles."""

    name: str
    radius: Positive


@dataclasses.dataclass(frozen=True)
class RmpFlowCfg:
    """The parameter file. ``joint_limit_buffers`` [rad] have the order of the descriptor's ``cspace``."""

    joint_limit_buffers: tuple[Gain, ...]
    rmp_params: RmpParams
    canonical_resolve: ResolveCfg
    body_cylinders: tuple[CylinderCfg, ...] = ()
    body_collision_controllers: tuple[ControllerCfg, ...] = ()


@dataclasses.dataclass(frozen=True)
class SphereCfg:
    """A sphere in its link's frame [m]."""

    center: Point
    radius: Positive


@dataclasses.dataclass(frozen=True)
class DescriptorCfg:
    """The robot descriptor.

    Attributes:
        cspace: joints that the policy moves.
        default_q: their preferred posture [rad].
        cspace_to_urdf_rules: joints that are held away from their zero; must be empty here.
        composite_task_spaces, api_version, acceleration_limits, jerk_limits: read, without effect.
        collision_spheres: (link, its spheres); they keep clear of obstacles.
    """

    cspace: tuple[str, ...]
    root_link: str
    default_q: tuple[float, ...]
    api_version: float = 1.0
    cspace_to_urdf_rules: tuple[Any, ...] = ()
    composite_task_spaces: tuple[Any, ...] = ()
    acceleration_limits: tuple[Gain, ...] = ()
    jerk_limits: tuple[Gain, ...] = ()
    collision_spheres: tuple[dict[str, tuple[SphereCfg, ...]], ...] = ()


def load(cls: type[Cfg], path: pathlib.Path) -> Cfg:
    """Reads a YAML file as a ``cls``. The key ``like`` names one of the package's robots, whose file has what this one lacks.

    Raises:
        UserError: no such file or robot, no YAML, or an entry that is missing, unknown or of another type.
    """
    node = files.read_yaml(path)
    try:
        return read(cls, _completed(node, path.name), "")
    except UserError as e:
        raise UserError(f"{path}: {e}") from None


def _completed(node: Any, name: str) -> Any:
    if not isinstance(node, dict) or "like" not in node:
        return node
    other = read(str, node["like"], "like")
    able = {file.parts[-3]: file for file in sorted(ASSETS.glob(f"*/rmpflow/{name}"))}
    if other not in able:
        raise UserError(f"like: {unknown('robot', other, able)}")
    return {**files.read_yaml(able[other]), **{key: value for key, value in node.items() if key != "like"}}


def load_pair(descriptor: pathlib.Path, config: pathlib.Path, arm: Iterable[str]) -> tuple[DescriptorCfg, RmpFlowCfg]:
    """Reads both files and checks that they fit each other and the arm. Values per joint have the order of ``arm``.

    Args:
        arm: names of the joints to control.

    Raises:
        UserError: see ``load``; or the joints are not the arm's, or a list has the wrong length.
    """
    arm = tuple(arm)
    robot, cfg = load(DescriptorCfg, descriptor), load(RmpFlowCfg, config)
    for i, name in enumerate(robot.cspace):
        if name not in arm:
            raise UserError(f"{descriptor}: cspace[{i}]: {unknown('joint', name, arm)}")
    if sorted(robot.cspace) != sorted(arm):
        raise UserError(f"{descriptor}: cspace must name each joint of the arm once: {', '.join(arm)}")
    if robot.cspace_to_urdf_rules:
        raise UserError(f"{descriptor}: cspace_to_urdf_rules must be empty: joints outside the cspace stay at the model's zero")
    order = [robot.cspace.index(name) for name in arm]

    def along(path: pathlib.Path, key: str, values: tuple[float, ...]) -> tuple[float, ...]:
        if len(values) != len(arm):
            raise UserError(f"{path}: {key} takes {len(arm)} numbers, one per joint of the cspace, got {len(values)}")
        return tuple(values[i] for i in order)

    robot = dataclasses.replace(robot, cspace=arm, default_q=along(descriptor, "default_q", robot.default_q))
    cfg = dataclasses.replace(cfg, joint_limit_buffers=along(config, "joint_limit_buffers", cfg.joint_limit_buffers))
    cap = cfg.rmp_params.joint_velocity_cap_rmp
    if cap.velocity_damping_region > cap.max_velocity:
        key = "rmp_params.joint_velocity_cap_rmp.velocity_damping_region"
        raise UserError(f"{config}: {key} takes a number up to max_velocity, {cap.max_velocity:g}")
    return robot, cfg
