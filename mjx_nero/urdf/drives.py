"""Drives of an imported robot: gains from a file, or computed from the inertia that each joint moves."""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from mjx_nero import files
from mjx_nero.config.values import hint, read, short
from mjx_nero.sim import grasp
from mjx_nero.sim.gains import critical_damping
from mjx_nero.sim.robot_file import COLUMNS, MAX_NUMBER
from mjx_nero.types import UserError
from mjx_nero.urdf.fingers import Hand
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Body, Joint

FREQUENCY = 20.0  # [rad/s] natural frequency of the arm's drives: a tenth of what 100 physics steps a second can follow
STRETCH = 0.05  # [rad, m] least position error at which a drive gives its full effort
STUCK = 0.01  # [rad, m] greatest position error that dry friction may leave
DT = 1 / 60  # [s] longest physics step of the tasks
USUAL = 1.5  # [rad/s, m/s] speed of a joint whose file gives none
SPEED = 2.0  # [rad/s, m/s] greatest speed of position targets, the usual limit near people
SQUEEZE = 0.0125  # [m] position error at which a finger gives its full effort
FORCE = 60.0  # [N] greatest force of a finger
PRESS = 250.0  # [N/kg] greatest force per mass of the liftable cube; pads then sink in by a millimetre
HOLD = 20.0  # [N/kg] least force per mass: two pads then hold twice the weight at a friction of 0.5
PLACEHOLDER = 1.0  # [N m, N] what exporters write for an unknown effort
FINGER = 0.3  # [kg] rotor inertia of a sliding finger, or at the end of a turning one (why: assets/nero/nero.xml)
Rows = dict[str, dict[str, float]]


def load_gains(path: pathlib.Path, joints: Mapping[str, Any]) -> Rows:
    """Reads ``joint -> {stiffness, damping, effort, speed}`` from a YAML file; the last two are optional.

    Raises:
        UserError: the file is missing or not YAML, a joint or column is unknown, or a value is not positive (damping: negative)
            or beyond ``robot_file.MAX_NUMBER``.
    """
    raw = files.read_yaml(path)
    if not isinstance(raw, Mapping) or not raw:
        raise UserError(f"{path} takes joint: {{stiffness: .., damping: ..}} for each joint, got {type(raw).__name__}")
    out: Rows = {}
    for name, row in raw.items():
        if name not in joints:
            raise UserError(f"{path} names joint {short(name)}{hint(str(name), joints)}: choose from {', '.join(joints)}")
        if not isinstance(row, Mapping) or not {"stiffness", "damping"} <= set(row) or not set(row) <= set(COLUMNS):
            raise UserError(f"{path}: {name} takes stiffness and damping, and optionally effort and speed; got {short(row)}")
        out[str(name)] = {
            column: read(kind, row[column], f"{path}: {name}.{column}") for column, kind in COLUMNS.items() if column in row
        }
    return out


def carried(model: mujoco.MjModel) -> tuple[dict[str, float], dict[str, float]]:
    """Greatest inertia [kg m2, kg] and weight [N m, N] that each joint moves over 64 random poses, without rotors."""
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    model.dof_armature[:] = 0.0
    full, most, weight = np.zeros((model.nv, model.nv)), np.zeros(model.nv), np.zeros(model.nv)
    for _ in range(64):
        data.qpos[:] = rng.uniform(model.jnt_range[:, 0], model.jnt_range[:, 1])
        mujoco.mj_forward(model, data)
        mujoco.mj_fullM(model, data, full)
        most = np.maximum(most, np.diag(full))
        weight = np.maximum(weight, np.abs(data.qfrc_bias))
    places = {model.joint(i).name: model.jnt_dofadr[i] for i in range(model.njnt)}
    return {n: float(most[k]) for n, k in places.items()}, {n: float(weight[k]) for n, k in places.items()}


def armature(joint: Joint, inertia: float, lever: float | None) -> float:
    """Chooses a rotor inertia, which URDFs lack [kg m2, kg].

    An arm joint gets 5% of the inertia that it moves, within 0.01 to 1 kg m2, so that stiff drives stay well conditioned on light
    wrists. A gripper joint gets ``FINGER`` at the end of the fingers.

    Args:
        inertia: greatest inertia that it moves, of ``carried``.
        lever: distance from a gripper joint's axis to the finger's end [m]; None for other joints.
    """
    if joint.type == "prismatic":
        return FINGER if lever is not None else float(np.clip(0.05 * inertia, FINGER, 10.0))
    if lever is not None:
        return float(np.clip(FINGER * lever**2, 1e-4, 0.1))
    return float(np.clip(0.05 * inertia, 0.01, 1.0))


def rows(
    parts: Mapping[str, Body],
    hand: Hand,
    moved: tuple[Mapping[str, float], Mapping[str, float]],
    rotors: Mapping[str, float],
    levers: Mapping[str, float],
    given: Rows,
    notes: Notes,
) -> Rows:
    """Returns stiffness, damping, effort and speed of every driven joint: as given, or else by these rules.

    Effort and speed are the URDF's limits, and speed is at most ``SPEED``. An effort that cannot hold the arm's own weight counts
    as missing; so does one of 1 that all joints share, or that hardly moves its joint or cannot hold the cube.

    An arm drive has the natural frequency ``FREQUENCY`` at the greatest inertia that the joint moves. It is stiffer if the
    joint's damping would make it creep, or its friction would stop it more than ``STUCK`` away, and softer if it would reach full
    effort within ``STRETCH``.

    A finger's drive gives full effort at ``SQUEEZE``, or at the cube if friction would leave too little there. On top of the
    joints' friction it gives at most ``FORCE`` at its end, and at most ``PRESS`` per kilogram of the cube it can lift; less than
    ``HOLD`` per kilogram gets a warning.

    Damping adds what the joints lack to critical, also at the package's longest physics step.
    """
    out: Rows = {}
    driven = [b.joint for b in parts.values() if b.joint and not b.joint.mimic]
    edge = grasp.edge(hand.gap, hand.pad, hand.closed)
    cube = grasp.DENSITY * edge**3
    force = min(FORCE, PRESS * cube) if cube else FORCE
    unsaid = len(driven) > 1 and all(joint.effort == PLACEHOLDER for joint in driven)
    for joint in driven:
        load = _load(joint, parts, moved, rotors)
        finger = joint.name in hand.joints
        lever = 1.0 if joint.type == "prismatic" else levers.get(joint.name, 0.1)
        weak = joint.effort == PLACEHOLDER and PLACEHOLDER - load.friction < HOLD * cube * lever
        row = _finger(joint, load, lever, force, unsaid or weak, notes) if finger else _arm(joint, load, unsaid, notes)
        at_cube = edge / 2 / lever  # [rad, m] a finger's way from the cube to closed
        if finger and cube and row["stiffness"] * at_cube - load.friction < HOLD * cube * lever < row["effort"] - load.friction:
            row["stiffness"] = max(row["stiffness"], row["effort"] / at_cube)
        row["damping"] = max(critical_damping(row["stiffness"], load.inertia, DT) - load.damping, 0.0)
        if joint.name in given:
            row |= given[joint.name]
        else:
            text = f"stiffness {row['stiffness']:.4g} and damping {row['damping']:.4g}, by its inertia"
            notes.add("guessed", "joint", joint.name, text)
        if finger and row["effort"] - load.friction < HOLD * cube * lever:
            notes.add("warning", "joint", joint.name, _weak(row["effort"], load.friction, lever, cube))
        out[joint.name] = {column: float(f"{row[column]:.6g}") for column in COLUMNS}
    return out


@dataclasses.dataclass(frozen=True)
class _Load:
    """Inertia [kg m2, kg], weight [N m, N], damping [N m s/rad, N s/m] and dry friction [N m, N] of a joint and its followers."""

    inertia: float
    weight: float
    damping: float
    friction: float


def _load(
    joint: Joint, parts: Mapping[str, Body], moved: tuple[Mapping[str, float], Mapping[str, float]], rotors: Mapping[str, float]
) -> _Load:
    inertia, weight = moved
    followers = [b.joint for b in parts.values() if b.joint and b.joint.mimic and b.joint.mimic[0] == joint.name]
    ratios = [(joint, 1.0), *((j, j.mimic[1]) for j in followers if j.mimic)]
    return _Load(
        inertia=float(sum(ratio**2 * (inertia[j.name] + rotors[j.name]) for j, ratio in ratios)),
        weight=weight[joint.name],
        damping=float(sum(ratio**2 * j.damping for j, ratio in ratios)),
        friction=float(sum(abs(ratio) * j.friction for j, ratio in ratios)),
    )


def _finger(joint: Joint, load: _Load, lever: float, force: float, unsaid: bool, notes: Notes) -> dict[str, float]:
    """Computes stiffness, effort and speed of a finger's drive that grips with at most ``force`` [N] at its ``lever`` [m]."""
    wanted = FORCE / 3 * lever + load.friction if unsaid or not joint.effort else joint.effort
    effort = min(wanted, force * lever + load.friction)
    if unsaid and joint.effort:
        notes.add("repaired", "joint", joint.name, f"effort {joint.effort:g} is a placeholder: now {effort:.3g}")
    elif joint.effort and joint.effort > effort:
        notes.add("repaired", "joint", joint.name, f"effort {joint.effort:g} is more than fingers take: now {effort:.3g}")
    speed = min(joint.velocity or USUAL, SPEED)
    if (spare := effort - load.friction) > 0 and load.damping * speed > spare:
        speed = spare / load.damping
        notes.add("repaired", "joint", joint.name, f"its own damping lets it move at {speed:.3g} rad/s or m/s and no faster")
    return {"stiffness": effort * (1.0 if joint.type == "prismatic" else lever) / SQUEEZE, "effort": effort, "speed": speed}


def _arm(joint: Joint, load: _Load, unsaid: bool, notes: Notes) -> dict[str, float]:
    """Computes stiffness, effort and speed of an arm's drive."""
    stiffness = max(FREQUENCY**2 * load.inertia, FREQUENCY / 2 * load.damping, load.friction / STUCK)
    stiffness = min(stiffness, MAX_NUMBER)  # the bound of robot.yaml
    effort = joint.effort and min(joint.effort, MAX_NUMBER)
    heavy = effort is not None and effort < load.weight
    if effort is None or heavy or (effort == PLACEHOLDER and (unsaid or effort / load.inertia < 2.0)):
        what = "is a placeholder" if effort == PLACEHOLDER else f"cannot hold its own links, up to {load.weight:.3g}"
        kind, why = ("guessed", "") if effort is None else ("repaired", f"effort {effort:g} {what}: now ")
        effort = stiffness * 0.5
        notes.add(kind, "joint", joint.name, f"{why}effort {effort:.3g}, the drive's at half a radian or metre")
    elif effort / load.inertia < 2.0:
        text = f"effort {effort:g} moves its load at no more than {effort / load.inertia:.2g} rad/s2 or m/s2: check it"
        notes.add("warning", "joint", joint.name, text)
    return {"stiffness": min(stiffness, effort / STRETCH), "effort": effort, "speed": min(joint.velocity or USUAL, SPEED)}


def _weak(effort: float, friction: float, lever: float, cube: float) -> str:
    """Writes the warning about a finger whose effort cannot hold ``cube`` [kg] at ``lever`` [m] (1 for a slide)."""
    grip = max(effort - friction, 0.0) / lever
    return (
        f"effort {effort:.3g} grips with {grip:.2g} N, too little for a cube of {1000 * cube:.3g} g: "
        f"give its motor's, at least {1.01 * HOLD * cube * lever + friction:.3g}, with --gains"
    )
