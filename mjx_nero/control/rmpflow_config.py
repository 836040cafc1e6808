"""The two YAML files of RMPflow: robot descriptor and parameters, read and checked.

Keys and structure are Lula's, so files of Isaac Sim's tutorials ("Adding a new manipulator", 5.x) can be used as they are. The
symbols of ``mjx_nero.control.rmpflow``'s formulas are these keys. Lengths in m, angles in rad, times in s.
"""

import dataclasses
import pathlib
import re
import typing
from collections.abc import Iterable, Mapping
from typing import Annotated, Any, TypeVar

import yaml

from mjx_nero import config
from mjx_nero.types import UserError

Cfg = TypeVar("Cfg")
Gain = Annotated[float, "a number of at least 0", lambda x: x >= 0]
Positive = Annotated[float, "a number above 0", lambda x: x > 0]  # stands in a denominator
Fraction = Annotated[float, "a number from 0 to 1", lambda x: 0 <= x <= 1]
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


@dataclasses.dataclass(frozen=True)
class TargetCfg:
    """Pull of the frame's origin to its target. The last two keys have no documented effect and none here."""

    accel_p_gain: Gain
    accel_d_gain: Gain
    accel_norm_eps: Positive
    metric_alpha_length_scale: Positive
    min_metric_alpha: Fraction
    max_metric_scalar: Gain
    min_metric_scalar: Gain
    proximity_metric_boost_scalar: Gain
    proximity_metric_boost_length_scale: Positive
    xi_estimator_gate_std_dev: Gain = 20000.0
    accept_user_weights: bool = False


@dataclasses.dataclass(frozen=True)
class AxisTargetCfg:
    """Pull of the frame's axes to the target's. The last two keys have no documented effect and none here."""

    accel_p_gain: Gain
    accel_d_gain: Gain
    metric_scalar: Gain
    proximity_metric_boost_scalar: Gain
    proximity_metric_boost_length_scale: Positive
    xi_estimator_gate_std_dev: Gain = 20000.0
    accept_user_weights: bool = False


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
    """One group a kind of leaf."""

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
    """The parameter file. ``joint_limit_buffers`` [rad] run along the descriptor's ``cspace``."""

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
        cspace_to_urdf_rules: joints that are held elsewhere than at their zero; must be empty here.
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
    """Reads a YAML file as a ``cls``.

    Raises:
        UserError: no such file, no YAML, or an entry that is missing, unknown or of another type.
    """
    try:
        node = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as e:
        raise UserError(f"{path}: cannot be read ({e.strerror})") from None
    except (yaml.YAMLError, UnicodeDecodeError) as e:
        mark = getattr(e, "problem_mark", None)
        line = f" in line {mark.line + 1}" if mark else ""
        raise UserError(f"{path}: not valid YAML{line}: {getattr(e, 'problem', None) or ' '.join(str(e).split())}") from None
    try:
        return _read(cls, node, "")
    except UserError as e:
        raise UserError(f"{path}: {e}") from None


def load_pair(descriptor: pathlib.Path, config: pathlib.Path, arm: Iterable[str]) -> tuple[DescriptorCfg, RmpFlowCfg]:
    """Both files, in agreement with each other and with the arm, their values a joint in the order of ``arm``.

    Args:
        arm: names of the joints to control.

    Raises:
        UserError: see ``load``; or joints that are not those of the arm, or lists of another length.
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


def unknown(kind: str, name: object, valid: Iterable[str]) -> str:
    """Message: there is no such ``kind``, with a close match and all valid names."""
    valid = list(valid)
    return f"no {kind} {str(name)!r}{config.hint(str(name), valid)}; valid: {', '.join(valid)}"


# YAML 1.1 wants a dot and a signed exponent in a float, so that ``1e-3``, as people and the tutorial write it, is a string.
_EXPONENT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")


def _read(kind: Any, node: Any, key: str) -> Any:
    """``node`` as a value of the annotation ``kind``; ``key`` is its dotted name."""
    origin, args = typing.get_origin(kind), typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return _read_group(kind, node, key)
    if origin is Annotated:
        value = _read(args[0], node, key)
        if not args[2](value):
            raise UserError(f"{key} takes {args[1]}, got {node!r}")
        return value
    if origin is tuple:
        size = None if args[-1] is ... else len(args)
        if not isinstance(node, list) or size not in (None, len(node)):
            raise UserError(f"{key} takes a list{f' of {size} numbers' if size else ''}, got {node!r}")
        return tuple(_read(args[0], value, f"{key}[{i}]") for i, value in enumerate(node))
    if origin is dict:
        if not isinstance(node, Mapping) or not all(isinstance(name, str) for name in node):
            raise UserError(f"{key} takes an entry 'name: value', got {node!r}")
        return {name: _read(args[1], value, f"{key}.{name}") for name, value in node.items()}
    if kind is float:
        return _number(node, key)
    if kind is not Any and not isinstance(node, kind):
        raise UserError(f"{key} takes {'true or false' if kind is bool else 'a name'}, got {node!r}")
    return node


def _number(node: Any, key: str) -> float:
    if isinstance(node, str) and _EXPONENT.fullmatch(node):
        node = float(node)
    if isinstance(node, bool) or not isinstance(node, int | float) or not abs(node) < 1e30:  # nan and inf fail it too
        raise UserError(f"{key} takes a finite number, got {node!r}")
    return float(node)


def _read_group(cls: Any, node: Any, key: str) -> Any:
    if not isinstance(node, Mapping):
        raise UserError(f"{key or 'the file'} takes entries 'key: value', got {type(node).__name__} {str(node)[:40]!r}")
    kinds = typing.get_type_hints(cls, include_extras=True)
    prefix = f"{key}." if key else ""
    for name in node:
        if name not in kinds:
            raise UserError(f"{prefix}{name}: {unknown('key', name, kinds)}")
    for field in dataclasses.fields(cls):
        if field.default is dataclasses.MISSING and field.name not in node:
            raise UserError(f"{prefix}{field.name} is missing; {key or 'the file'} takes: {', '.join(kinds)}")
    return cls(**{name: _read(kinds[name], value, prefix + name) for name, value in node.items()})
