"""Files of robots: models, and beside an imported one its config ``robot.yaml``, which import-urdf writes and users edit."""

import dataclasses
import math
import pathlib
from collections.abc import Mapping
from typing import Any

import mujoco
import yaml

from mjx_nero import config
from mjx_nero.robots import DriveCfg, GripperCfg, RobotCfg
from mjx_nero.types import UserError

NAME = "robot.yaml"
_GAINS = ("stiffness", "damping", "effort", "speed")
_ARM = (*_GAINS, "home")
_GRIPPER = (*_ARM, "open", "close")
_PLAIN = ("name", "base_link", "base_pos", "base_quat", "ee_site", "down", "gravity_compensation", "workspace")
_HEAD = """\
# A robot for mjx_nero: edit at will. Units: m, rad, kg, N, s; quaternions wxyz.
# arm, gripper: a line a joint, position drives with stiffness [N m/rad or N/m] and damping, limits of effort and speed, and home.
# workspace: box that reach tasks command from, in the robot's own frame before base_quat turns it. down: ee_site's orientation
# when the gripper points straight down.
"""


def write(folder: pathlib.Path, robot: RobotCfg) -> None:
    """Writes ``robot.yaml``; callables (the gripper's gap) are not kept."""
    content = {name: _plain(getattr(robot, name)) for name in _PLAIN}
    content |= {"arm": _rows(robot.arm, _ARM), "gripper": _rows(robot.gripper, _GRIPPER)}
    (folder / NAME).write_text(_HEAD + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=130))


def read(folder: pathlib.Path) -> RobotCfg:
    """The robot of a folder that ``import-urdf`` made.

    Raises:
        UserError: a file is missing or damaged, or names what the model does not have.
    """
    path = folder / NAME
    try:
        raw = yaml.safe_load(path.read_text())
    except FileNotFoundError:
        raise UserError(f"{folder} holds no {NAME}: make one with python -m mjx_nero import-urdf") from None
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise UserError(f"{path} is not YAML: {' '.join(str(error).split())}") from None
    if not isinstance(raw, Mapping):
        raise UserError(f"{path} takes fields like arm, gripper, ee_site; it holds {type(raw).__name__}")
    default = RobotCfg(name=folder.name, arm=DriveCfg())
    for name in raw:
        if name not in (*_PLAIN, "arm", "gripper"):
            valid = (*_PLAIN, "arm", "gripper")
            raise UserError(f"{path}: no field {name!r}{config.hint(str(name), valid)}: choose from {', '.join(valid)}")
    fields = {name: _like(getattr(default, name), raw[name], f"{path}: {name}") for name in _PLAIN if name in raw}
    arm = DriveCfg(**_columns(raw.get("arm"), _ARM, f"{path}: arm"))
    gripper = GripperCfg(**_columns(raw.get("gripper"), _GRIPPER, f"{path}: gripper"))
    if not arm.joints:
        raise UserError(f"{path}: arm names no joint")
    robot = dataclasses.replace(default, **fields, arm=arm, gripper=gripper, folder=str(folder))
    spec = model(robot)
    if [spec.joint(j).type for j in gripper.joints] != [mujoco.mjtJoint.mjJNT_SLIDE] * 2:
        gripper = dataclasses.replace(gripper, gap=None, positions=None)  # known of two slides alone
    return dataclasses.replace(robot, gripper=gripper)


def model(robot: RobotCfg) -> mujoco.MjSpec:
    """The robot's model, of the package or imported.

    Raises:
        UserError: the file is missing or damaged, or lacks what the robot's config names.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(robot.xml))
    except ValueError as error:
        raise UserError(f"{robot.xml} is no model: {' '.join(str(error).split())}") from None
    for what, wanted, found in (
        ("joint", robot.joints, spec.joints),
        ("site or body", [robot.ee_site], [*spec.sites, *spec.bodies[1:]]),
        ("body", [robot.base_link], spec.bodies[1:]),
    ):
        names = [x.name for x in found]
        for name in wanted:
            if name not in names:
                raise UserError(f"{robot.xml} has no {what} {name!r}{config.hint(name, names)}: it has {', '.join(names)}")
    return spec


def _rows(drive: DriveCfg, columns: tuple[str, ...]) -> dict[str, dict[str, float]]:
    return {joint: {c: float(getattr(drive, c)[i]) for c in columns} for i, joint in enumerate(drive.joints)}


def _columns(rows: Any, columns: tuple[str, ...], where: str) -> dict[str, Any]:
    """``joint -> {column: value}`` as the fields of a drive."""
    rows = rows or {}
    if not isinstance(rows, Mapping):
        raise UserError(f"{where} takes a line a joint, got {rows!r}")
    out: dict[str, Any] = {"joints": tuple(map(str, rows))}
    for joint, row in rows.items():
        if not isinstance(row, Mapping) or set(row) != set(columns):
            raise UserError(f"{where}.{joint} takes {', '.join(columns)}; got {row!r}")
        for column in columns:
            value = _like(0.0, row[column], f"{where}.{joint}.{column}")
            if column in _GAINS and value <= 0 and column != "damping" or value < 0 and column == "damping":
                raise UserError(f"{where}.{joint}.{column} has to be above 0, got {value:g}")
            out[column] = (*out.get(column, ()), value)
    return out


def _plain(value: Any) -> Any:
    return [_plain(v) for v in value] if isinstance(value, tuple) else value


def _like(old: Any, value: Any, where: str) -> Any:
    """``value`` as a value like ``old``; None, a workspace's default, stands for three ranges."""
    if old is None and value is not None:
        old = ((0.0, 0.0),) * 3
    if isinstance(old, tuple) and isinstance(value, list) and len(value) == len(old):
        return tuple(_like(o, v, where) for o, v in zip(old, value, strict=True))
    if isinstance(old, float) and isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    if isinstance(old, str | bool | None) and type(value) is type(old):
        return value
    raise UserError(f"{where} takes a value like {_plain(old)!r}, got {value!r}")
