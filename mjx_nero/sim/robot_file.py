"""Robots' files: the model, and an imported robot's config ``robot.yaml``, which import-urdf writes and users edit."""

import dataclasses
import math
import pathlib
from collections.abc import Mapping
from typing import Annotated, Any

import mujoco
import yaml

from mjx_nero import files
from mjx_nero.config.bounds import Bounds
from mjx_nero.config.values import hint, hints, short
from mjx_nero.config.values import read as read_value
from mjx_nero.sim import model_file
from mjx_nero.sim.robot import ASSETS, DriveCfg, GripperCfg, RobotCfg
from mjx_nero.types import UserError

NAME = "robot.yaml"
MAX_NUMBER = 1e6
_Gain, _Number = Annotated[float, Bounds(0.0, MAX_NUMBER, above=True)], Annotated[float, Bounds(-MAX_NUMBER, MAX_NUMBER)]
COLUMNS: dict[str, Any] = {  # of a drive
    "stiffness": _Gain,
    "damping": Annotated[float, Bounds(0.0, MAX_NUMBER)],
    "effort": _Gain,
    "speed": _Gain,
}
_ARM = (*COLUMNS, "home")
_GRIPPER = (*_ARM, "open", "close")
_PLAIN = tuple(
    "name base_link base_pos base_quat ee_site down gravity_compensation workspace floor opening closed pad grip pick lean turns "
    "hold".split()
)
_HEAD = """\
# A robot for mjx_nero: edit it freely. Units: m, rad, kg, N, s; quaternions wxyz.
# arm, gripper: one line per joint: stiffness [N m/rad or N/m] and damping of its drive, limits of effort and speed, home.
# workspace: box from which reach tasks draw their commands, in the base frame before base_quat rotates it.
# down: orientation of ee_site when the gripper points straight down. floor: height of the floor under a robot beside the table.
# opening, closed: distance between the pads of the open and of the closed gripper. pad: size of a pad along the approach, across
# it and along the opening. A zero means unknown. grip: centre of a held object in the frame of ee_site.
# pick, hold: boxes of lift tasks, in the frame of workspace. The gripper can point down everywhere in pick, which begins at the
# height for grasping; lean is the largest angle from straight down that it needs there, turns whether its fingers can open along
# y there. hold: box of goals.
"""


def write(folder: pathlib.Path, robot: RobotCfg) -> None:
    """Writes ``robot.yaml``. Callables (the gripper's gap) are not kept."""
    content = {name: _plain(getattr(robot, name)) for name in _PLAIN}
    content |= {"arm": _rows(robot.arm, _ARM), "gripper": _rows(robot.gripper, _GRIPPER)}
    (folder / NAME).write_text(_HEAD + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=130))


def read(folder: pathlib.Path) -> RobotCfg:
    """Reads the robot from a folder that ``import-urdf`` made.

    Raises:
        UserError: a file is missing or damaged, or names what the model does not have.
    """
    path = folder / NAME
    if not path.exists():
        raise UserError(f"{folder} holds no {NAME}: make one with python -m mjx_nero import-urdf")
    raw = files.read_yaml(path)
    if not isinstance(raw, Mapping):
        raise UserError(f"{path} takes fields like arm, gripper, ee_site; it holds {type(raw).__name__}")
    default = RobotCfg(name=folder.name, arm=DriveCfg())
    valid = (*_PLAIN, "arm", "gripper")
    for name in raw:
        if name not in valid:
            raise UserError(f"{path}: no field {short(name)}{hint(str(name), valid)}: choose from {', '.join(valid)}")
    kinds = hints(RobotCfg)
    fields = {name: read_value(kinds[name], raw[name], f"{path}: {name}") for name in _PLAIN if name in raw}
    arm = DriveCfg(**_columns(raw.get("arm"), _ARM, f"{path}: arm"))
    gripper = GripperCfg(**_columns(raw.get("gripper"), _GRIPPER, f"{path}: gripper"))
    if not arm.joints:
        raise UserError(f"{path}: arm names no joint")
    robot = dataclasses.replace(default, **fields, arm=arm, gripper=gripper, folder=str(folder))
    spec = model(robot)
    try:
        compiled = spec.compile()
    except ValueError as error:
        raise UserError(f"{robot.xml} is not a valid model: {error}") from None
    for name in robot.joints:
        lower, upper = compiled.joint(name).range
        if not lower < upper:
            raise UserError(f"{robot.xml}: joint {name!r} has no range: give it one, drives need it")
    slides = [spec.joint(j).type for j in gripper.joints] == [mujoco.mjtJoint.mjJNT_SLIDE] * 2
    # The default gap holds for two opposed slides that meet at zero, not for slides that open alike or about another middle.
    if not slides or not math.isclose(gripper.open[0] - gripper.open[1], robot.opening, abs_tol=1e-3):
        gripper = dataclasses.replace(gripper, gap=None, positions=None)
    return dataclasses.replace(robot, gripper=gripper)


def _check(robot: RobotCfg) -> None:
    """Checks what the fields' types do not say."""
    path = pathlib.Path(robot.folder, NAME) if robot.folder else f"robot {short(robot.name)}"
    for name, drive in (("arm", robot.arm), ("gripper", robot.gripper)):
        for field, value in vars(drive).items():
            if isinstance(value, tuple) and len(value) != len(drive.joints):
                raise UserError(f"{path}: {name}.{field} takes a value for each of {len(drive.joints)} joints, got {len(value)}")
    boxes = {name: getattr(robot, name) or () for name in ("workspace", "pick", "hold")}
    for number in (*robot.base_pos, *(end for box in boxes.values() for axis in box for end in axis)):
        if not abs(number) <= MAX_NUMBER:
            raise UserError(f"{path}: base_pos and {', '.join(boxes)} take numbers up to {MAX_NUMBER:g}, got {number:g}")
    for name, quat in (("base_quat", robot.base_quat), ("down", robot.down)):
        if not 0.99 < math.hypot(*quat) < 1.01:
            raise UserError(f"{path}: {name} takes a quaternion of length 1 (wxyz), got {short(list(quat))}")
    for name, box in boxes.items():
        for axis, (lower, upper) in zip("xyz", box, strict=False):
            if lower > upper:
                raise UserError(f"{path}: {name}: its {axis} runs from {lower:g} to {upper:g}: give the smaller number first")
    for joint in robot.arm.joints:
        if joint in robot.gripper.joints:
            raise UserError(f"{path}: joint {joint!r} is in arm and in gripper: take it out of one")
    if len(set(robot.joints)) < len(robot.joints):
        raise UserError(f"{path}: arm and gripper take each joint once, got {', '.join(robot.joints)}")
    for name in (robot.name, robot.base_link, robot.ee_site, *robot.joints):
        if not 0 < len(name) <= model_file.MAX_WORD or not name.isprintable():
            raise UserError(f"{path}: {short(name)} is not a name: it is empty, long, or has control characters")


def model(robot: RobotCfg) -> mujoco.MjSpec:
    """Reads the robot's model.

    Raises:
        UserError: the file is missing or damaged, or lacks a joint, site or body that the robot's config names, or the config
            contradicts itself.
    """
    _check(robot)
    if robot.mjcf:
        where, spec = f"the mjcf of {robot.name}", _parsed(robot)
    else:
        where = str(robot.xml)
        if not robot.folder and not (pathlib.PurePath(robot.name).name == robot.name and robot.xml.is_file()):
            raise UserError(
                f"robot.name takes the name of a folder in {ASSETS}, got {short(robot.name)}: choose a robot by --robot"
            )
        spec = model_file.read(robot.xml) if robot.folder else mujoco.MjSpec.from_file(where)
    for what, wanted, found in (
        ("joint", robot.joints, spec.joints),
        ("site or body", [robot.ee_site], [*spec.sites, *spec.bodies[1:]]),
        ("body", [robot.base_link], spec.bodies[1:]),
    ):
        names = [x.name for x in found]
        for name in wanted:
            if name not in names:
                raise UserError(f"{where} has no {what} {name!r}{hint(name, names)}: it has {', '.join(names)}")
    return spec


def _parsed(robot: RobotCfg) -> mujoco.MjSpec:
    try:
        return mujoco.MjSpec.from_string(robot.mjcf)
    except ValueError as error:
        raise UserError(f"the mjcf of {robot.name} is not a valid model: {error}") from None


def _rows(drive: DriveCfg, columns: tuple[str, ...]) -> dict[str, dict[str, float]]:
    return {joint: {c: float(getattr(drive, c)[i]) for c in columns} for i, joint in enumerate(drive.joints)}


def _columns(rows: Any, columns: tuple[str, ...], where: str) -> dict[str, Any]:
    """Turns ``joint -> {column: value}`` into the fields of a drive."""
    rows = {} if rows is None else rows
    if not isinstance(rows, Mapping):
        raise UserError(f"{where} takes one line per joint, got {short(rows)}")
    out: dict[str, Any] = {"joints": tuple(map(str, rows))}
    for joint, row in rows.items():
        if not isinstance(row, Mapping) or set(row) != set(columns):
            raise UserError(f"{where}.{joint} takes {', '.join(columns)}; got {short(row)}")
        for column in columns:
            value = read_value(COLUMNS.get(column, _Number), row[column], f"{where}.{joint}.{column}")
            out[column] = (*out.get(column, ()), value)
    return out


def _plain(value: Any) -> Any:
    return [_plain(v) for v in value] if isinstance(value, tuple) else value
