"""Action terms: from the policy's output to the drives' position targets, one after another as a task lists them.

A term is a class, made as ``Term(drives, **params)``. ``home`` holds the entries of the action that it reads, as they are at
home; ``init(key, act) -> memory`` and ``step(memory, own, act) -> (memory, act)``, where ``own`` are those entries. A term also
describes itself as JSON, which ``deploy.executor`` runs in numpy, tells the bounds of its entries, and inverts itself, from
targets back to entries.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any, Protocol

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
_STAYS = 0.01  # targets of fingers that move less in a step, on the scale of a ``ContinuousGripper``, stay where they are


@dataclasses.dataclass(frozen=True)
class Drives:
    """A group of drives, arrays along its joints [rad or m].

    Attributes:
        speed: of targets, at most [rad/s or m/s].
        lag: of a joint behind a target that moves [s].
        dt: control step [s].
        joints: names.
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
        """How far targets move in a control step, at most."""
        return self.speed * np.float32(self.dt)


Groups = Mapping[str, Drives]  # ``arm`` and ``gripper``


@struct.dataclass
class Act:
    """An action on its way to the drives. Positions and targets by group of drives [rad or m]."""

    action: Float[Array, "... na"]  # all of it, bounded
    joint_pos: dict[str, Float[Array, "... n"]]
    ctrl: dict[str, Float[Array, "... n"]]  # the targets now in force
    targets: dict[str, Float[Array, "... n"]]  # what comes of the action: at first, home
    level: Float[Array, ""] | None = None  # see ``types.LEVEL``

    def to(self, group: str, targets: Float[Array, " n"]) -> "Act":
        """With other targets of a group."""
        return dataclasses.replace(self, targets={**self.targets, group: targets})


Description = dict[str, Any]  # ``type``, and what else ``deploy.executor`` reads of that type
Bounds = tuple[np.ndarray, np.ndarray]  # the least and the greatest


class ActionTerm(Protocol):
    """See above."""

    home: np.ndarray

    def init(self, key: Key, act: Act) -> Memory: ...
    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]: ...
    def describe(self) -> Description | None: ...
    def bounds(self) -> Bounds: ...
    def invert(self, act: Act, late: int) -> Float[Array, "... n"]: ...


@dataclasses.dataclass(frozen=True)
class Plain:
    """Base of terms that read no entry and remember nothing."""

    groups: Groups

    @property
    def home(self) -> np.ndarray:
        """No entry."""
        return np.zeros(0, np.float32)

    def init(self, key: Key, act: Act) -> Memory:
        """Nothing."""
        return ()

    def describe(self) -> Description | None:
        """None: only this package knows what the term does."""
        return None

    def bounds(self) -> Bounds:
        """The entries beyond which nothing more happens: +-1."""
        return -np.ones(len(self.home), np.float32), np.ones(len(self.home), np.float32)

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """The entries that give ``act.targets``, or come nearest. Actions take effect up to ``late`` control steps late."""
        return jnp.zeros((*next(iter(act.targets.values())).shape[:-1], 0))


@dataclasses.dataclass(frozen=True)
class Joints(Plain):
    """Base of terms that read an entry for each joint of a group, zero at home."""

    group: str = dataclasses.field(default="arm", kw_only=True)

    @property
    def home(self) -> np.ndarray:
        """Zero."""
        return np.zeros_like(self.groups[self.group].home)


@dataclasses.dataclass(frozen=True)
class Gripper(Plain):
    """Base of terms that read one entry for all joints of the gripper, if there is one."""

    @property
    def drives(self) -> Drives:
        """The gripper's."""
        return self.groups["gripper"]

    def _described(self, kind: str) -> Description:
        own = self.drives
        return {"type": kind, "joints": list(own.joints), "open": decimals(own.open), "close": decimals(own.close)}


@dataclasses.dataclass(frozen=True)
class JointPosition(Joints):
    """One entry a joint: ``home + scale * action`` [rad], within the joints' ranges. Isaac Lab's ``JointPositionAction``."""

    scale: float = dataclasses.field(kw_only=True)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Targets of the group."""
        drives = self.groups[self.group]
        return memory, act.to(self.group, jnp.clip(drives.home + self.scale * own, drives.low, drives.high))

    def describe(self) -> Description:
        """``offset + scale * action``, an entry a joint."""
        drives = self.groups[self.group]
        of = {"joints": list(drives.joints), "scale": self.scale, "offset": decimals(drives.home)}
        return {"type": "joint_position", **of}

    def bounds(self) -> Bounds:
        """Where each joint reaches its limits."""
        drives = self.groups[self.group]
        low, high = np.sort([(end - drives.home) / np.float32(self.scale) for end in (drives.low, drives.high)], axis=0)
        return low, high

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """Exact."""
        return (act.targets[self.group] - self.groups[self.group].home) / self.scale


@dataclasses.dataclass(frozen=True)
class JointVelocity(Joints):
    """One entry a joint: how fast its set-point moves, at +-1 as fast as the drive; targets lead it by the drives' lag.

    Absolute targets whose noise is wider than the speed limit teach a policy that only their signs count: without its noise it
    throws targets from limit to limit, and a step of delay undoes it. Here noise is a share of the limit, and smooth.

    Attributes:
        time: time constant with which velocities follow the action [s].
        ahead: a set-point is never farther from its joint than it moves in this time at full speed [s]: a hand that leans on a
            table would wind it up until no action has an effect.
    """

    time: Positive = dataclasses.field(default=0.15, kw_only=True)
    ahead: Positive = dataclasses.field(default=0.1, kw_only=True)

    def init(self, key: Key, act: Act) -> Memory:
        """The set-point [rad or m] and its rate [share of the speed]: at the joints, at rest."""
        return act.joint_pos[self.group], jnp.zeros_like(act.joint_pos[self.group])

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Targets of the group, ahead of its set-point."""
        (point, rate), drives, joint_pos = memory, self.groups[self.group], act.joint_pos[self.group]
        rate = rate + (1.0 - np.exp(-drives.dt / self.time)) * (jnp.clip(own, -1.0, 1.0) - rate)
        most = drives.speed * self.ahead
        point = jnp.clip(point + drives.step * rate, joint_pos - most, joint_pos + most)
        point = jnp.clip(point, drives.low, drives.high)
        targets = jnp.clip(point + drives.lag * drives.speed * rate, drives.low, drives.high)
        return (point, rate), act.to(self.group, targets)

    def describe(self) -> Description:
        """Entries move set-points, which targets lead by ``lag`` [s]."""
        drives = self.groups[self.group]
        of = {"joints": list(drives.joints), "time": self.time, "ahead": self.ahead, "lag": decimals(drives.lag)}
        return {"type": "joint_velocity", **of}

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """Towards the targets as slowly as velocities follow the action: faster would swing."""
        drives, slow = self.groups[self.group], 2 * (self.time + late * self.groups[self.group].dt)
        way = act.targets[self.group] - act.joint_pos[self.group]
        return jnp.clip(way / (slow * drives.speed), -1.0, 1.0)


@dataclasses.dataclass(frozen=True)
class DriveTargets(Plain):
    """One entry a drive: its position target itself [rad or m], within the joints' ranges. For controllers."""

    @property
    def home(self) -> np.ndarray:
        """The robot's."""
        return np.concatenate([drives.home for drives in self.groups.values()])

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Targets of all groups."""
        for group, drives in self.groups.items():
            targets, own = own[: len(drives.home)], own[len(drives.home) :]
            act = act.to(group, jnp.clip(targets, drives.low, drives.high))
        return memory, act

    def describe(self) -> Description:
        """Joint positions of scale 1."""
        joints = [name for drives in self.groups.values() for name in drives.joints]
        return {"type": "joint_position", "joints": joints, "scale": 1.0, "offset": [0.0] * len(joints)}

    def bounds(self) -> Bounds:
        """The joints' ranges."""
        every = self.groups.values()
        return np.concatenate([drives.low for drives in every]), np.concatenate([drives.high for drives in every])

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """The targets themselves."""
        return jnp.concatenate([act.targets[group] for group in self.groups], axis=-1)


@dataclasses.dataclass(frozen=True)
class BinaryGripper(Gripper):
    """One entry, if there is a gripper: closed where negative, else open. Isaac Lab's ``BinaryJointPositionAction``.

    Attributes:
        hysteresis: it closes below minus that, opens from plus that on, and stays as it is between, at first open. Noise about
            zero opens and closes a hand many times a second; so it stays closed for long enough to grasp by chance.
    """

    hysteresis: NonNegative = dataclasses.field(default=0.0, kw_only=True)

    @property
    def home(self) -> np.ndarray:
        """Open."""
        return np.zeros(int(len(self.drives.home) > 0), np.float32)

    def init(self, key: Key, act: Act) -> Memory:
        """Whether it is closed, if that may matter."""
        return jnp.zeros((), bool) if self.hysteresis and len(self.home) else ()

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Targets of the gripper."""
        drives = self.drives
        if not len(own):
            return memory, act
        closed = own[0] < (jnp.where(memory, self.hysteresis, -self.hysteresis) if self.hysteresis else 0.0)
        targets = jnp.clip(jnp.where(closed, drives.close, drives.open), drives.low, drives.high)
        return (closed if self.hysteresis else memory), act.to("gripper", targets)

    def describe(self) -> Description:
        """``close`` for an entry below minus ``hysteresis``, ``open`` from plus that on, between as it was."""
        return {**self._described("binary"), "hysteresis": self.hysteresis}

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """Whichever of open and closed the targets move to; if they stay, whichever is nearer."""
        if not len(self.home):
            return super().invert(act, late)
        to, at = (opening(x["gripper"], self.drives.open, self.drives.close) for x in (act.targets, act.ctrl))
        return jnp.where(jnp.where(jnp.abs(to - at) > _STAYS, to - at, to) < 0, -1.0, 1.0)[..., None]


@dataclasses.dataclass(frozen=True)
class ContinuousGripper(Gripper):
    """One entry, if there is a gripper: closed at -1, open at 1, and between in proportion.

    A binary gripper that must not lose what it carries is told to close so surely that noise hardly ever opens it, and what would
    be paid for letting go is not found. Of a continuous one a little more is told at every step.
    """

    @property
    def home(self) -> np.ndarray:
        """As far open as it is at home."""
        drives = self.drives
        if not len(drives.home):
            return np.zeros(0, np.float32)
        return np.array([opening(drives.home, drives.open, drives.close)], np.float32)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Targets of the gripper."""
        drives = self.drives
        if not len(own):
            return memory, act
        share = jnp.clip(0.5 + 0.5 * own[0], 0.0, 1.0)
        return memory, act.to("gripper", jnp.clip(drives.close + share * (drives.open - drives.close), drives.low, drives.high))

    def describe(self) -> Description:
        """From ``close`` at -1 to ``open`` at 1."""
        return self._described("continuous")

    def invert(self, act: Act, late: int) -> Float[Array, "... n"]:
        """As far open as comes nearest."""
        if not len(self.home):
            return super().invert(act, late)
        return opening(act.targets["gripper"], self.drives.open, self.drives.close)[..., None]


@dataclasses.dataclass(frozen=True)
class AntiWindup(Plain):
    """Targets of a group that turn back start at most ``ahead`` [s] of full speed from their joints; for before a speed limit.

    Fingers press with a target that lies far behind what they hold. To let go they would first have to take that way back, at the
    speed of the drives: half a second in which nothing happens. Without any way back noise opens the hand.
    """

    group: str = dataclasses.field(default="gripper", kw_only=True)
    ahead: NonNegative = dataclasses.field(default=0.1, kw_only=True)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """The targets in force nearer to the joints, if the way to the new ones leads there."""
        to, now, joints = act.targets[self.group], act.ctrl[self.group], act.joint_pos[self.group]
        most = jnp.asarray(self.groups[self.group].speed * np.float32(self.ahead))
        start = jnp.clip(now, joints - most, joints + most)
        start = jnp.clip(start, jnp.minimum(now, to), jnp.maximum(now, to))
        return memory, dataclasses.replace(act, ctrl={**act.ctrl, self.group: start})

    def describe(self) -> Description:
        """Targets ``of`` joints that turn back."""
        return {"type": "anti_windup", "of": list(self.groups[self.group].joints), "ahead": self.ahead}


@dataclasses.dataclass(frozen=True)
class SpeedLimit(Plain):
    """Targets move at most as fast as the drives: those of a group, or of all of them (empty)."""

    group: str = dataclasses.field(default="", kw_only=True)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Targets nearer to those in force."""
        for group in (self.group,) if self.group else self.groups:
            step = jnp.asarray(self.groups[group].step)
            act = act.to(group, rate_limit(act.targets[group], act.ctrl[group], step=step))
        return memory, act

    def describe(self) -> Description:
        """Targets ``of`` joints move at most as fast as their drives."""
        limited = (self.group,) if self.group else self.groups
        return {"type": "speed_limit", "of": [name for group in limited for name in self.groups[group].joints]}


@dataclasses.dataclass(frozen=True)
class Delay(Plain):
    """The terms after this one get the action of some control steps ago (see ``memory.Delay``)."""

    steps: Steps = dataclasses.field(kw_only=True)
    hold: Share = dataclasses.field(default=1.0, kw_only=True)

    def init(self, key: Key, act: Act) -> Memory:
        """It has been home's."""
        return memories.Delay(self.steps, self.hold).init(key, act.action)

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """An action late."""
        memory, action = memories.Delay(self.steps, self.hold).step(memory, act.action)
        return memory, dataclasses.replace(act, action=toward(act.level, act.action, action))

    def describe(self) -> Description:
        """Control steps, the least and the most: what training reckoned with."""
        return {"type": "delay", "steps": list(self.steps)}


@dataclasses.dataclass(frozen=True)
class Noise(Plain):
    """The arm's targets are off by up to ``amount`` in every step [rad or m], uniformly, within the joints' ranges."""

    amount: NonNegative = dataclasses.field(kw_only=True)

    def init(self, key: Key, act: Act) -> Memory:
        """Its own random key."""
        return key

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """Targets of the arm."""
        memory, k_noise = jax.random.split(memory)
        drives, targets = self.groups["arm"], act.targets["arm"]
        off = jax.random.uniform(k_noise, targets.shape, minval=-self.amount, maxval=self.amount)
        return memory, act.to("arm", jnp.clip(toward(act.level, targets, targets + off), drives.low, drives.high))

    def describe(self) -> Description:
        """What training reckoned with."""
        return {"type": "noise", "amount": self.amount}


@dataclasses.dataclass(frozen=True)
class LowPass(Plain):
    """The terms after this one get the action smoothed by a first-order filter of time constant ``time`` [s], steps of ``dt``."""

    time: Positive = dataclasses.field(kw_only=True)
    dt: Positive = dataclasses.field(kw_only=True)

    def init(self, key: Key, act: Act) -> Memory:
        """It has been home's."""
        return act.action

    def step(self, memory: Memory, own: Float[Array, " n"], act: Act) -> tuple[Memory, Act]:
        """An action nearer to the last one."""
        memory = memory + (1.0 - np.exp(-self.dt / self.time)) * (act.action - memory)
        return memory, dataclasses.replace(act, action=memory)

    def describe(self) -> Description:
        """The time constant and the step [s]."""
        return {"type": "low_pass", "time": self.time, "dt": self.dt}


def decimals(values: np.ndarray) -> list[float]:
    """Single-precision numbers as the shortest decimals that stand for them: 0.05, not 0.05000000074505806."""
    return [float(str(np.float32(value))) for value in values]


def opening(at: Any, open: np.ndarray, close: np.ndarray) -> Any:
    """The action of a ``ContinuousGripper`` that brings fingers nearest to ``at`` [..., joints] [rad or m]."""
    way = open - close
    return 2.0 * ((at - close) @ way) / (way @ way or 1.0) - 1.0


class Chain:
    """All action terms of a task, in their order.

    Args:
        terms: by name.
        groups: the robot's drives, in the order of ``ctrl``.

    Attributes:
        home: the action that keeps the robot at home [na].
        kinds: of the terms that read it.

    Raises:
        UserError: no term reads the action.
    """

    def __init__(self, terms: Mapping[str, Any], groups: Groups):
        self.terms: dict[str, ActionTerm] = {name: term.func(groups, **term.params) for name, term in terms.items()}
        self._groups, sizes = groups, [len(term.home) for term in self.terms.values()]
        self._splits = np.cumsum(sizes)[:-1]
        if not sum(sizes):
            raise UserError(f"none of the actions {', '.join(terms) or '(there are none)'} reads the policy's output")
        self.home = np.concatenate([np.asarray(term.home, np.float32) for term in self.terms.values()])
        self.kinds = [type(term).__name__ for term in self.terms.values() if len(term.home)]

    def init(self, key: Key, joint_pos: Float[Array, " nj"], action: Float[Array, " na"] | None = None) -> dict[str, Memory]:
        """What the terms remember at the start, by their dotted names in the task; those that remember nothing are left out.

        Args:
            action: as it has been till then; None: home's.
        """
        act = self._act(jnp.asarray(self.home) if action is None else action, joint_pos, joint_pos)
        memory = {f"actions.{n}": term.init(jax.random.fold_in(key, i), act) for i, (n, term) in enumerate(self.terms.items())}
        return {name: value for name, value in memory.items() if jax.tree.leaves(value)}

    def step(
        self, memory: Mapping[str, Memory], action: Float[Array, " na"], joint_pos: Float[Array, " nj"], ctrl: Float[Array, " nu"]
    ) -> tuple[dict[str, Memory], Float[Array, " nu"]]:
        """The drives' targets for an action; of the episode's memory, what is the terms' changes."""
        act, after = dataclasses.replace(self._act(action, joint_pos, ctrl), level=memory.get(LEVEL)), dict(memory)
        for i, (name, term) in enumerate(self.terms.items()):
            own = jnp.split(act.action, self._splits)[i]
            remembered, act = term.step(memory.get(f"actions.{name}", ()), own, act)
            if f"actions.{name}" in memory:
                after[f"actions.{name}"] = remembered
        return after, jnp.concatenate(list(act.targets.values()))

    def describe(self) -> list[Description]:
        """How the action becomes position targets of the drives, as JSON: see ``docs/guides/deploy_onnx.md``.

        Raises:
            UserError: a term that only this package knows.
        """
        out = []
        for name, term in self.terms.items():
            what = getattr(term, "describe", lambda: None)()  # a guest's term may not have it
            if what is None:
                kind = type(term).__name__
                raise UserError(f"the action term {name} ({kind}) does not describe itself, so only this package knows it")
            if what.get("joints", True):  # a gripper's term of a robot without one does nothing
                out.append({"name": name, **what})
        return out

    def bounds(self) -> Bounds:
        """The actions that take each joint to its limits; beyond them nothing more happens."""
        low, high = zip(*(term.bounds() for term in self.terms.values()), strict=True)
        return np.concatenate(low).astype(np.float32), np.concatenate(high).astype(np.float32)

    def invert(
        self, targets: Float[Array, "... nu"], joint_pos: Float[Array, "... nu"], ctrl: Float[Array, "... nu"] | None = None
    ) -> Float[Array, "... na"]:
        """The action that gives position targets of the drives, or comes nearest: so a controller acts where a policy would.

        Args:
            targets: [rad or m].
            joint_pos: where the joints are [rad or m].
            ctrl: the targets now in force; None: where the joints are.
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
