"""Checks an arm before a policy runs on it, by small safe moves of one joint after another that a person watches.

A move goes a few degrees from home and back, through the safety layer, at a fifth of the joints' speeds. It shows which reading
followed (order), in which direction (sign), by how much (scale), the difference between reading and command at rest (offset), and
how late the reading followed (delay, which includes the drive's own).
"""

import dataclasses
import math
from collections.abc import Callable, Sequence

import numpy as np

from mjx_nero.deploy.arm import Clock
from mjx_nero.deploy.body import Body
from mjx_nero.deploy.guard import Guarded
from mjx_nero.deploy.loop import Stop
from mjx_nero.deploy.safety import Fault, Limits

MARK = "# From deploy --check on a "  # begins the file that ``yaml_of`` makes
ANGLE, SHARE = 0.1, 0.2  # size of a move [rad]; share of the speeds
SLIDE = 0.02  # size of a move of a slide [m]
_REST, _SAMPLE = 0.4, 0.005  # time at rest at each end; time between readings [s]
_LATEST = 0.3  # maximum delay [s]
_SAME, _SCALE, _OFFSET = 0.5, 0.1, 0.05  # share of the move that counts as following; tolerances of scale and offset

Ask = Callable[[str], "bool | None"]


@dataclasses.dataclass(frozen=True)
class Move:
    """A joint's move: its targets, and the readings of all joints.

    Attributes:
        sent, told: times of the targets [s], and the targets [rad or m].
        times, read: times of the readings [s], and the readings [k, n].
    """

    sent: np.ndarray
    told: np.ndarray
    times: np.ndarray
    read: np.ndarray


@dataclasses.dataclass(frozen=True)
class Joint:
    """The findings about a joint from its move.

    Attributes:
        name: the joint's name.
        follows: the joint whose reading moved most.
        scale: motion of the reading over motion of the command.
        offset: reading minus command at rest [rad or m].
        delay: from a command to the reading that follows it [s].
        seen: whether a person saw it move as announced; None: nobody was asked.
        there: whether the whole move was possible.
    """

    name: str
    follows: str
    scale: float
    offset: float
    delay: float
    seen: bool | None = None
    there: bool = True

    def wrong(self, grips: bool) -> list[str]:
        """Lists the reasons against running a policy with this joint; ``grips``: it belongs to the gripper."""
        out = [] if self.there else ["the fence does not let it move here"]
        if self.follows != self.name:
            out.append(f"the reading of {self.follows} moved instead: the order of the joints is wrong")
        elif abs(self.scale) < _SAME:
            out.append("its reading hardly moved: check that it is powered and free to move")
        elif self.scale < 0:
            out.append("its reading moved the other way: its sign is wrong")
        elif abs(self.scale - 1) > _SCALE and not grips:
            out.append(f"its reading moved {self.scale:.2f} times as far: its scale is wrong, or it does not follow")
        if not out and abs(self.offset) > _OFFSET and not grips:
            out.append(f"at rest its reading differs from its command by {self.offset:+.3f}: its zero is off, or it sags")
        if self.seen is False:
            out.append("you did not see it move as announced: its sign, zero or order differs from the model's")
        return out


def move(arm: Guarded, joint: int, step: float, limits: Limits, clock: Clock, stop: Stop) -> Move:
    """Moves a joint by ``step`` [rad or m] and back while the others stay. Ends early if ``stop`` says so or something fails."""
    begun, here = clock.now(), arm.read().position
    target, sent, told, times, read = here.copy(), [], [], [], []
    pace = limits.speed[joint] * SHARE * limits.dt
    way = np.concatenate([np.zeros(5), np.arange(pace, abs(step), pace), np.full(round(_REST / limits.dt), abs(step))])
    way = np.concatenate([way, np.arange(abs(step), 0, -pace), np.zeros(round(_REST / limits.dt))]) * math.copysign(1, step)
    for k, moved in enumerate(way):
        if ending := stop():
            arm.hold(ending)
        if arm.fault:
            break
        target[joint] = here[joint] + moved
        command = arm.command(target)
        sent.append(arm.sent or clock.now())
        told.append(command.position[joint])
        while (next_ := clock.now() + _SAMPLE) < begun + (k + 1) * limits.dt:
            clock.sleep_until(next_)
            seen = arm.read()
            times.append(seen.time)
            read.append(seen.position)
        clock.sleep_until(begun + (k + 1) * limits.dt)
    return Move(*(np.array(x) for x in (sent, told, times, read)))


def judged(made: Move, joint: int, names: tuple[str, ...], step: float) -> Joint:
    """Evaluates a joint's move."""
    far = np.abs(made.told - made.told[0]).max() > 0.8 * abs(step)
    settled = (made.times > made.sent[0]) & (np.abs(np.interp(made.times, made.sent, made.told) - made.told[0]) < 1e-6)
    start = made.read[made.times < made.sent[5]].mean(axis=0)
    top = made.told[int(np.abs(made.told - made.told[0]).argmax())]
    high = np.abs(np.interp(made.times, made.sent, made.told) - top) < 1e-6
    late = made.times > made.times[high][0] + _REST / 2 if high.any() else high
    reached = made.read[high & late].mean(axis=0) if (high & late).any() else made.read[-1]
    moved = reached - start
    most, way = int(np.abs(moved).argmax()), top - made.told[0]
    ends = settled & ((made.times < made.sent[5]) | (made.times > made.sent[-1] - _REST / 2))
    offset = float(made.read[ends, joint].mean() - made.told[0]) if ends.any() else 0.0
    scale = float(moved[joint] / way) if way else 0.0
    return Joint(names[joint], names[most], scale, offset, delay_of(made, joint), None, bool(far))


def delay_of(made: Move, joint: int) -> float:
    """Returns the delay [s] at which reading and command differ least, apart from scale and offset."""
    seen, best = made.read[:, joint], (math.inf, 0.0)
    for delay in np.arange(0.0, _LATEST, 0.001):
        last = np.clip(np.searchsorted(made.sent, made.times - delay, side="right") - 1, 0, None)
        columns = np.stack([made.told[last], np.ones(len(seen))], axis=1)
        rest = np.linalg.lstsq(columns, seen, rcond=None)[0]
        best = min(best, (float(np.sum((columns @ rest - seen) ** 2)), float(delay)))
    return best[1]


def described(body: Body, position: np.ndarray, joint: int, step: float) -> str:
    """Describes what a person sees when a joint moves by ``step``: where the end effector goes."""
    before, turn = body.ee(position)
    there = position.copy()
    there[joint] += step
    after, turned = body.ee(there)
    way = after - before
    axis = int(np.abs(way).argmax())
    words = (("forwards, along +x", "backwards, along -x"), ("to +y, its left", "to -y, its right"), ("up", "down"))
    if abs(way[axis]) > 0.003:
        return f"the hand goes {1e3 * abs(way[axis]):.0f} mm {words[axis][int(way[axis] < 0)]}"
    cosine = min(1.0, abs(float(turn @ turned)))
    return f"the hand turns by {math.degrees(2 * math.acos(cosine)):.0f} degrees on the spot"


def walk(
    arm: Guarded, limits: Limits, body: Body, clock: Clock, stop: Stop, ask: Ask, say: Callable[[str], None] = print
) -> tuple[list[Joint], Fault | None]:
    """Moves each joint of an arm that is at home.

    Returns:
        the findings, and why the check stopped early (None: it did not).
    """
    found: list[Joint] = []
    for joint, name in enumerate(limits.names):
        at = arm.read().position
        size = ANGLE if limits.upper[joint] - limits.lower[joint] > 0.5 else SLIDE
        up = limits.upper[joint] - at[joint] >= at[joint] - limits.lower[joint]
        step = min(size, 0.4 * (limits.upper[joint] - limits.lower[joint])) * (1 if up else -1)
        said = described(body, at, joint, step) if limits.arm[joint] else "the fingers move"
        say(f"{name} moves by {step:+.2f}: {said}")
        made = move(arm, joint, step, limits, clock, stop)
        if arm.fault or len(made.times) < 10:
            return found, arm.fault or Fault("stop", "too few readings")
        one = judged(made, joint, limits.names, step)
        seen = ask(f"did {name} do that, and nothing else move?")
        if arm.fault:
            return found, arm.fault
        found.append(dataclasses.replace(one, seen=seen))
    return found, None


def yaml_of(robot: str, found: list[Joint], arm: Sequence[str]) -> str:
    """Returns the YAML that ``deploy --identified`` and ``--env.identified`` read: offsets, and the delay with its range over the
    joints.

    Args:
        arm: names of the arm's joints.
    """
    mine = [joint for joint in found if joint.name in arm]
    delays = sorted(joint.delay for joint in mine)
    middle = delays[len(delays) // 2]
    lines = [
        f"{MARK}{robot}: offsets [rad or m], and the delay [s], which includes the drives' own.",
        f"robot: {robot}",
        f"delay: {{value: {middle:.4f}, low: {delays[0]:.4f}, high: {delays[-1]:.4f}}}",
        "joints:",
    ]
    for joint in mine:
        value = f"{joint.offset:.5f}"
        lines.append(f"  {joint.name}: {{offset: {{value: {value}, low: {value}, high: {value}}}}}")
    return "\n".join(lines) + "\n"
