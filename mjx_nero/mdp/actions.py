"""Action terms turn the policy's output into the drives' position targets, one after another in the task's order.

A term is a class, made as ``Term(drives, **params)``. ``home`` holds the values of the action entries that the term reads, with
the robot at home. The term has ``init(key, act) -> memory`` and ``step(memory, own, act) -> (memory, act)``, where ``own`` are
its entries. It describes itself as JSON, which ``deploy.executor`` runs in numpy; it gives the bounds of its entries; and it
inverts itself, from targets back to entries.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from flax import struct
from jaxtyping import Array, Float

from mjx_nero.config.bounds import NonNegative, Positive, Share, Steps
from mjx_nero.mdp import memory as memories
from mjx_nero.mdp.curriculum import toward
from mjx_nero.types import LEVEL, Key, UserError

Memory = Any
_STAYS = 0.01  # finger targets that change by less than this in a step, as a ``ContinuousGripper`` entry, count as unchanged


@dataclasses.dataclass(frozen=True)
class Drives:
    """A group of drives, as arrays along its joints [rad or m].

    Attributes:
        speed: speed limit of the targets [rad/s or m/s].
        lag: how long a joint lags behind a moving target [s].
        dt: duration of a control step [s].
        joints: the joints' names.
    """

    home: np.ndarray
    low: np.ndarray
    high: np.ndarray
    speed: np.ndarray
    open: np.ndarray
    close: np.ndarray
    lag: np.ndarray
    dt: float
    joints: tuple[str, ...] = ()

    @property
    def step(self) -> np.ndarray:
        """Greatest change of the targets in one control step [rad or m]."""
        return self.speed * np.float32(self.dt)


Groups = Mapping[str, Drives]  # ``arm`` and ``gripper``, then those of further robots: ``taker/arm`` and ``taker/gripper``


@struct.dataclass
class Act:
    """An action on its way to the drives. Positions and targets are split by group of drives [rad or m]."""

    action: Float[Array, "... na"]  # the whole action, bounded
    joint_pos: dict[str, Float[Array, "... n"]]
    ctrl: dict[str, Float[Array, "... n"]]  # the current targets
    targets: dict[str, Float[Array, "... n"]]  # the new targets; at first, home
    level: Float[Array, ""] | None = None  # see ``types.LEVEL``

    def to(self, group: str, targets: Float[Array, " n"]) -> "Act":
        """Returns a copy with new targets for one group."""
        return dataclasses.replace(self, targets={**self.targets, group: targets})


Description = dict[str, Any]  # ``type``, and the fields that ``deploy.executor`` reads for that type
Bounds = tuple[np.ndarray, np.ndarray]  # least and greatest entries


@dataclasses.dataclass(frozen=True)
class Plain:
    """Base of terms that read no entry and have no memory."""

    groups: Groups

    @property
    def home(self) -> np.ndarray:
        """An empty vector: the term reads no entry."""
        return np.zeros(0, np.float32)

    def init(self, key: Key, act: Act) -> Memory:
        """Returns an empty memory."""
        return ()

    def describe(self) -> Description | None:
        """Returns None: only this package knows what the term does."""
        return None

    def bounds(self) -> Bounds:
        """Returns the bounds of the entries, +-1; larger entries have no further effect."""
        return -np.ones(len(self.home), np.float32), np.ones(len(self.home), np.float32)

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """Computes the entries whose targets come nearest to ``act.targets`` if actions act up to ``late`` control steps late."""
        return jnp.zeros((*next(iter(act.targets.values())).shape[:-1], 0))


@dataclasses.dataclass(frozen=True)
class Joints(Plain):
    """Base of terms that read one entry per joint of a group, zero at home."""

    group: str = dataclasses.field(default="arm", kw_only=True)

    @property
    def home(self) -> np.ndarray:
        """Zero for every joint."""
        return np.zeros_like(self.groups[self.group].home)


@dataclasses.dataclass(frozen=True)
class Gripper(Plain):
    """Base of terms that read one entry for all gripper joints, if the robot has a gripper."""

    group: str = dataclasses.field(default="gripper", kw_only=True)

    @property
    def drives(self) -> Drives:
        """The gripper's drives."""
        return self.groups[self.group]

    def _described(self, kind: str) -> Description:
        own = self.drives
        return {"type": kind, "joints": list(own.joints), "open": decimals(own.open), "close": decimals(own.close)}


@dataclasses.dataclass(frozen=True)
class JointPosition(Joints):
    """One entry per joint: ``target = home + scale * entry`` [rad], clipped to the joint range.

    Isaac Lab's ``JointPositionAction``.
    """

    scale: float = dataclasses.field(kw_only=True)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Sets the group's targets."""
        drives = self.groups[self.group]
        return memory, act.to(self.group, jnp.clip(drives.home + self.scale * own, drives.low, drives.high))

    def describe(self) -> Description:
        """Describes ``target = offset + scale * entry``, one entry per joint."""
        drives = self.groups[self.group]
        of = {"joints": list(drives.joints), "scale": self.scale, "offset": decimals(drives.home)}
        return {"type": "joint_position", **of}

    def bounds(self) -> Bounds:
        """Returns the entries that take each joint to its limits."""
        drives = self.groups[self.group]
        low, high = np.sort([(end - drives.home) / np.float32(self.scale) for end in (drives.low, drives.high)], axis=0)
        return low, high

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """Inverts exactly."""
        return (act.targets[self.group] - self.groups[self.group].home) / self.scale


@dataclasses.dataclass(frozen=True)
class JointVelocity(Joints):
    """One entry per joint: the speed of its set-point. +-1 is the drive's full speed; targets lead by the drive's lag.

    If absolute targets get noise wider than the speed limit, the policy learns that only their signs matter. Without the noise
    such a policy throws its targets from limit to limit, and one step of delay ruins it. Here noise is a share of the limit, and
    smooth.

    Attributes:
        time: time constant with which velocities follow the action [s].
        ahead: a set-point leads its joint by at most the distance covered in this time at full speed [s]. Without this limit, a
            hand that leans on a table winds up the set-point until no action has an effect.
    """

    time: Positive = dataclasses.field(default=0.15, kw_only=True)
    ahead: Positive = dataclasses.field(default=0.1, kw_only=True)

    def init(self, key: Key, act: Act) -> Memory:
        """Returns the set-point [rad or m], at the joints, and its rate [share of full speed], zero."""
        return act.joint_pos[self.group], jnp.zeros_like(act.joint_pos[self.group])

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Moves the set-points, and sets the group's targets ahead of them."""
        (point, rate), drives, joint_pos = memory, self.groups[self.group], act.joint_pos[self.group]
        rate = rate + (1.0 - np.exp(-drives.dt / self.time)) * (jnp.clip(own, -1.0, 1.0) - rate)
        most = drives.speed * self.ahead
        point = jnp.clip(point + drives.step * rate, joint_pos - most, joint_pos + most)
        point = jnp.clip(point, drives.low, drives.high)
        targets = jnp.clip(point + drives.lag * drives.speed * rate, drives.low, drives.high)
        return (point, rate), act.to(self.group, targets)

    def describe(self) -> Description:
        """Describes entries that move set-points, which the targets lead by ``lag`` [s]."""
        drives = self.groups[self.group]
        of = {"joints": list(drives.joints), "time": self.time, "ahead": self.ahead, "lag": decimals(drives.lag)}
        return {"type": "joint_velocity", **of}

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """Moves towards the targets no faster than velocities follow the action; anything faster oscillates."""
        drives, slow = self.groups[self.group], 2 * (self.time + late * self.groups[self.group].dt)
        way = act.targets[self.group] - act.joint_pos[self.group]
        return jnp.clip(way / (slow * drives.speed), -1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class DriveTargets(Plain):
    """One entry per drive: its position target [rad or m], clipped to the joint range. Used by controllers."""

    @property
    def home(self) -> np.ndarray:
        """The home position of all drives."""
        return np.concatenate([drives.home for drives in self.groups.values()])

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Sets the targets of all groups."""
        for group, drives in self.groups.items():
            targets, own = own[: len(drives.home)], own[len(drives.home) :]
            act = act.to(group, jnp.clip(targets, drives.low, drives.high))
        return memory, act

    def describe(self) -> Description:
        """Describes joint positions with scale 1."""
        joints = [name for drives in self.groups.values() for name in drives.joints]
        return {"type": "joint_position", "joints": joints, "scale": 1.0, "offset": [0.0] * len(joints)}

    def bounds(self) -> Bounds:
        """Returns the joint ranges."""
        every = self.groups.values()
        return np.concatenate([drives.low for drives in every]), np.concatenate([drives.high for drives in every])

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """Returns the targets themselves."""
        return jnp.concatenate([act.targets[group] for group in self.groups], axis=-1)


@dataclasses.dataclass(frozen=True)
class BinaryGripper(Gripper):
    """One entry, if there is a gripper: negative closes it, anything else opens it. Isaac Lab's ``BinaryJointPositionAction``.

    Attributes:
        hysteresis: the gripper closes below -hysteresis, opens at +hysteresis and above, and keeps its state between. It starts
            open. Without hysteresis, noise opens and closes the hand many times a second, so it never grasps by chance.
    """

    hysteresis: NonNegative = dataclasses.field(default=0.0, kw_only=True)

    @property
    def home(self) -> np.ndarray:
        """Zero, which reads as open; empty without a gripper."""
        return np.zeros(int(len(self.drives.home) > 0), np.float32)

    def init(self, key: Key, act: Act) -> Memory:
        """Remembers whether the gripper is closed, if hysteresis needs it."""
        return jnp.zeros((), bool) if self.hysteresis and len(self.home) else ()

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Sets the gripper's targets."""
        drives = self.drives
        if not len(own):
            return memory, act
        closed = own[0] < (jnp.where(memory, self.hysteresis, -self.hysteresis) if self.hysteresis else 0.0)
        targets = jnp.clip(jnp.where(closed, drives.close, drives.open), drives.low, drives.high)
        return (closed if self.hysteresis else memory), act.to(self.group, targets)

    def describe(self) -> Description:
        """Describes ``close`` below -hysteresis, ``open`` at +hysteresis and above, and the last state in between."""
        return {**self._described("binary"), "hysteresis": self.hysteresis}

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """Picks the end that the targets move towards; if they stay, the nearer one."""
        if not len(self.home):
            return super().invert(act, late)
        to, at = (opening(x[self.group], self.drives.open, self.drives.close) for x in (act.targets, act.ctrl))
        return jnp.where(jnp.where(jnp.abs(to - at) > _STAYS, to - at, to) < 0, -1.0, 1.0)[..., None]


@dataclasses.dataclass(frozen=True)
class ContinuousGripper(Gripper):
    """One entry, if there is a gripper: -1 is closed, 1 is open, in proportion between.

    A binary gripper that must not drop its load learns to close so firmly that noise hardly ever opens it, and the policy never
    finds the reward for letting go. A continuous gripper lets every step open it a little further.
    """

    @property
    def home(self) -> np.ndarray:
        """The entry for the gripper's opening at home."""
        drives = self.drives
        if not len(drives.home):
            return np.zeros(0, np.float32)
        return np.array([opening(drives.home, drives.open, drives.close)], np.float32)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Sets the gripper's targets."""
        drives = self.drives
        if not len(own):
            return memory, act
        share = jnp.clip(0.5 + 0.5 * own[0], 0.0, 1.0)
        return memory, act.to(self.group, jnp.clip(drives.close + share * (drives.open - drives.close), drives.low, drives.high))

    def describe(self) -> Description:
        """Describes ``close`` at -1 to ``open`` at 1."""
        return self._described("continuous")

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """Finds the opening that comes nearest."""
        if not len(self.home):
            return super().invert(act, late)
        return opening(act.targets[self.group], self.drives.open, self.drives.close)[..., None]


@dataclasses.dataclass(frozen=True)
class AntiWindup(Plain):
    """Limits how far a target that reverses can be from its joint: ``ahead`` [s] of full speed. Place it before a speed limit.

    Fingers press with a target far behind the surface of what they hold. To let go, the target would first have to travel back at
    the drives' speed, so nothing would happen for half a second. With ``ahead`` zero, however, noise opens the hand.
    """

    group: str = dataclasses.field(default="gripper", kw_only=True)
    ahead: NonNegative = dataclasses.field(default=0.1, kw_only=True)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Moves the current targets towards the joints, if the new targets lie in that direction."""
        to, now, joints = act.targets[self.group], act.ctrl[self.group], act.joint_pos[self.group]
        most = jnp.asarray(self.groups[self.group].speed * np.float32(self.ahead))
        start = jnp.clip(now, joints - most, joints + most)
        start = jnp.clip(start, jnp.minimum(now, to), jnp.maximum(now, to))
        return memory, dataclasses.replace(act, ctrl={**act.ctrl, self.group: start})

    def describe(self) -> Description:
        """Lists the joints of the group as ``of``."""
        return {"type": "anti_windup", "of": list(self.groups[self.group].joints), "ahead": self.ahead}


@dataclasses.dataclass(frozen=True)
class SpeedLimit(Plain):
    """Limits targets to the drives' speed, in one group or, if ``group`` is empty, in all."""

    group: str = dataclasses.field(default="", kw_only=True)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Moves the current targets towards the new ones."""
        for group in (self.group,) if self.group else self.groups:
            step = jnp.asarray(self.groups[group].step)
            act = act.to(group, rate_limit(act.targets[group], act.ctrl[group], step=step))
        return memory, act

    def describe(self) -> Description:
        """Lists the joints whose targets are limited as ``of``."""
        limited = (self.group,) if self.group else self.groups
        return {"type": "speed_limit", "of": [name for group in limited for name in self.groups[group].joints]}


@dataclasses.dataclass(frozen=True)
class Delay(Plain):
    """Gives the terms after this one an earlier action (see ``memory.Delay``)."""

    steps: Steps = dataclasses.field(kw_only=True)
    hold: Share = dataclasses.field(default=1.0, kw_only=True)

    def init(self, key: Key, act: Act) -> Memory:
        """Fills the memory with the home action."""
        return memories.Delay(self.steps, self.hold).init(key, act.action)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Swaps the action for a delayed one."""
        memory, action = memories.Delay(self.steps, self.hold).step(memory, act.action)
        return memory, dataclasses.replace(act, action=toward(act.level, act.action, action))

    def describe(self) -> Description:
        """Gives the least and greatest delay of training [control steps]."""
        return {"type": "delay", "steps": list(self.steps)}


@dataclasses.dataclass(frozen=True)
class Noise(Plain):
    """Shifts the arm's targets by up to ``amount`` at every step [rad or m], uniformly, within the joint ranges."""

    amount: NonNegative = dataclasses.field(kw_only=True)

    def init(self, key: Key, act: Act) -> Memory:
        """Keeps a random key of its own."""
        return key

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Shifts the arm's targets."""
        memory, k_noise = jax.random.split(memory)
        drives, targets = self.groups["arm"], act.targets["arm"]
        off = jax.random.uniform(k_noise, targets.shape, minval=-self.amount, maxval=self.amount)
        return memory, act.to("arm", jnp.clip(toward(act.level, targets, targets + off), drives.low, drives.high))

    def describe(self) -> Description:
        """Gives the noise of training."""
        return {"type": "noise", "amount": self.amount}


@dataclasses.dataclass(frozen=True)
class LowPass(Plain):
    """Smooths the action for later terms: a first-order filter of time constant ``time`` [s] at steps of ``dt`` [s]."""

    time: Positive = dataclasses.field(kw_only=True)
    dt: Positive = dataclasses.field(kw_only=True)

    def init(self, key: Key, act: Act) -> Memory:
        """Starts from the home action."""
        return act.action

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Moves the action towards the latest one."""
        memory = memory + (1.0 - np.exp(-self.dt / self.time)) * (act.action - memory)
        return memory, dataclasses.replace(act, action=memory)

    def describe(self) -> Description:
        """Gives the time constant and the step [s]."""
        return {"type": "low_pass", "time": self.time, "dt": self.dt}


def decimals(values: np.ndarray) -> list[float]:
    """Writes single-precision numbers as their shortest decimals: 0.05, not 0.05000000074505806."""
    return [float(str(np.float32(value))) for value in values]


def opening(at: Any, open: np.ndarray, close: np.ndarray) -> Any:
    """Finds the ``ContinuousGripper`` entry that brings the fingers nearest to ``at`` [..., joints] [rad or m]."""
    way = open - close
    return 2.0 * ((at - close) @ way) / (way @ way or 1.0) - 1.0


class Chain:
    """All action terms of a task, in order.

    Args:
        terms: the terms by name.
        groups: the robot's drives, in the order of ``ctrl``.

    Attributes:
        home: the action that keeps the robot at home [na].
        kinds: class names of the terms that read the action.

    Raises:
        UserError: no term reads the action, or a term names a group of drives that does not exist.
    """

    def __init__(self, terms: Mapping[str, Any], groups: Groups):
        for name, term in terms.items():
            if (group := term.params.get("group")) and group not in groups:
                raise UserError(f"actions.{name}.params.group is {group!r}, and the drives' groups are: {', '.join(groups)}")
        self.terms: dict[str, Any] = {name: term.func(groups, **term.params) for name, term in terms.items()}
        self._groups, sizes = groups, [len(term.home) for term in self.terms.values()]
        self._splits = np.cumsum(sizes)[:-1]
        if not sum(sizes):
            raise UserError(f"none of the actions {', '.join(terms) or '(there are none)'} reads the policy's output")
        self.home = np.concatenate([np.asarray(term.home, np.float32) for term in self.terms.values()])
        self.kinds = [type(term).__name__ for term in self.terms.values() if len(term.home)]

    def init(self, key: Key, joint_pos: Float[Array, " nj"], action: Float[Array, " na"] | None = None) -> dict[str, Memory]:
        """Builds the terms' initial memory, by dotted name in the task. Terms without memory are left out.

        Args:
            action: the previous action. None: the home action.
        """
        act = self._act(jnp.asarray(self.home) if action is None else action, joint_pos, joint_pos)
        memory = {f"actions.{n}": term.init(jax.random.fold_in(key, i), act) for i, (n, term) in enumerate(self.terms.items())}
        return {name: value for name, value in memory.items() if jax.tree.leaves(value)}

    def step(
        self, memory: Mapping[str, Memory], action: Float[Array, " na"], joint_pos: Float[Array, " nj"], ctrl: Float[Array, " nu"]
    ) -> tuple[dict[str, Memory], Float[Array, " nu"]]:
        """Turns an action into the drives' targets, and updates the terms' part of the episode's memory."""
        act, after = dataclasses.replace(self._act(action, joint_pos, ctrl), level=memory.get(LEVEL)), dict(memory)
        for i, (name, term) in enumerate(self.terms.items()):
            own = jnp.split(act.action, self._splits)[i]
            remembered, act = term.step(memory.get(f"actions.{name}", ()), own, act)
            if f"actions.{name}" in memory:
                after[f"actions.{name}"] = remembered
        return after, jnp.concatenate(list(act.targets.values()))

    def describe(self) -> list[Description]:
        """Describes as JSON how an action becomes position targets: see ``docs/guides/deploy_onnx.md``.

        Raises:
            UserError: a term does not describe itself.
        """
        out = []
        for name, term in self.terms.items():
            what = getattr(term, "describe", lambda: None)()  # a guest's term may not have it
            if what is None:
                kind = type(term).__name__
                raise UserError(f"the action term {name} ({kind}) does not describe itself, so only this package can run it")
            if what.get("joints", True):  # a gripper term does nothing on a robot without a gripper
                out.append({"name": name, **what})
        return out

    def bounds(self) -> Bounds:
        """Returns the bounds of the action, which take each joint to its limits. Larger entries have no further effect."""
        low, high = zip(*(term.bounds() for term in self.terms.values()), strict=True)
        return np.concatenate(low).astype(np.float32), np.concatenate(high).astype(np.float32)

    def invert(
        self, targets: Float[Array, "... nu"], joint_pos: Float[Array, "... nu"], ctrl: Float[Array, "... nu"] | None = None
    ) -> Float[Array, "... na"]:
        """Finds the action whose targets come nearest to those given, so that a controller can act in a policy's place.

        Args:
            targets: position targets of the drives [rad or m].
            joint_pos: current joint positions [rad or m].
            ctrl: targets in force now [rad or m]; None: the joint positions.
        """
        delays: list[Any] = [term for term in self.terms.values() if isinstance(term, Delay)]
        late = sum(term.steps[1] for term in delays)
        wanted, joints, now = map(self._by_group, (targets, joint_pos, joint_pos if ctrl is None else ctrl))
        act = Act(jnp.zeros((*jnp.shape(targets)[:-1], len(self.home))), joints, now, wanted)
        return jnp.concatenate([term.invert(act, late) for term in self.terms.values()], axis=-1)

    def _by_group(self, values: Float[Array, "... nu"]) -> dict[str, Float[Array, "... n"]]:
        ends = np.cumsum([len(drives.home) for drives in self._groups.values()])[:-1]
        return dict(zip(self._groups, jnp.split(values, ends, axis=-1), strict=True))

    def _act(self, action, joint_pos, ctrl) -> Act:
        joints, now = self._by_group(joint_pos), self._by_group(ctrl)
        targets = {g: jnp.asarray(np.clip(drives.home, drives.low, drives.high)) for g, drives in self._groups.items()}
        return Act(action, joints, now, targets)


def rate_limit(target: Float[Array, " n"], ctrl: Float[Array, " n"], *, step: Float[Array, " n"]) -> Float[Array, " n"]:
    """Moves ``ctrl`` towards ``target`` by at most ``step`` [rad or m]: the drive's speed limit."""
    return ctrl + jnp.clip(target - ctrl, -step, step)
