"""Sensors: between what is and what a policy sees, ``init(key, view) -> memory`` and ``step(memory, view) -> (memory, view)``.

One after another, as a task lists them; all terms of an observation group then see the same wrong world: an object that is seen
a centimetre to the left is as much farther from the gripper as it is nearer to the goal.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Share, Steps
from mjx_nero.mdp.memory import Delay
from mjx_nero.types import Key, View


@dataclasses.dataclass(frozen=True, kw_only=True)
class Encoders:
    """Joint positions as the encoders read them, where ``randomization.encoder_bias`` puts these off."""

    def init(self, key: Key, view: View) -> tuple[()]:
        """Nothing: the bias is the physics'."""
        return ()

    def step(self, memory: tuple[()], view: View) -> tuple[tuple[()], View]:
        """The readings in place of the positions."""
        if view.encoder_bias is None:
            return memory, view
        return memory, dataclasses.replace(view, joint_pos=view.joint_pos + view.encoder_bias)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectPosition:
    """Where a camera sees an object: off by a constant of the episode, by noise, and late.

    Attributes:
        object: its name.
        offset: along each axis, at most, the same for an episode [m].
        noise: along each axis, at most, drawn in every step [m].
        delay: by how many control steps it is late, the least and the most.
        hold: the chance that a step keeps the delay of the one before.
    """

    object: str = "cube"
    offset: NonNegative = 0.0
    noise: NonNegative = 0.0
    delay: Steps = (0, 0)
    hold: Share = 1.0

    def init(self, key: Key, view: View) -> tuple:
        """The episode's offset, and where the object has always been."""
        key, k_offset, k_delay = jax.random.split(key, 3)
        offset = jax.random.uniform(k_offset, (3,), minval=-self.offset, maxval=self.offset)
        return key, offset, self._line.init(k_delay, view.objects[self.object].pos_w) if self._late else ()

    def step(self, memory: tuple, view: View) -> tuple[tuple, View]:
        """The view with the object elsewhere."""
        key, offset, line = memory
        key, k_noise = jax.random.split(key)
        seen = view.objects[self.object]
        pos = seen.pos_w
        if self._late:
            line, pos = self._line.step(line, pos)
        pos = pos + offset + self.noise * jax.random.uniform(k_noise, (3,), minval=-1.0, maxval=1.0)
        objects = {**view.objects, self.object: dataclasses.replace(seen, pos_w=pos)}
        return (key, offset, line), dataclasses.replace(view, objects=objects)

    @property
    def _line(self) -> Delay:
        return Delay(self.delay, self.hold)

    @property
    def _late(self) -> bool:
        return self.delay != (0, 0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BasePose:
    """The robot stands beside where it was calibrated to stand: all objects are seen moved by one rigid motion about its base.

    That is what a base elsewhere comes to for an arm that knows the world by cameras alone, as long as the base stands upright;
    the commanded point is the robot's own.

    Attributes:
        offset: along each axis, at most [m].
        turn: about the vertical axis, at most [rad].
    """

    offset: NonNegative = 0.0
    turn: NonNegative = 0.0

    def init(self, key: Key, view: View) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """The episode's motion."""
        k_offset, k_turn = jax.random.split(key)
        offset = jax.random.uniform(k_offset, (3,), minval=-self.offset, maxval=self.offset)
        return offset, jax.random.uniform(k_turn, (), minval=-self.turn, maxval=self.turn)

    def step(self, memory: tuple, view: View) -> tuple[tuple, View]:
        """The view with the objects elsewhere."""
        offset, turn = memory
        quat = math.axis_angle(jnp.array([0.0, 0.0, 1.0]), turn)

        def moved(seen):
            pos = math.rotate(quat, seen.pos_w - view.root_pos_w) + view.root_pos_w + offset
            return dataclasses.replace(seen, pos_w=pos, quat_w=math.quat_mul(quat, seen.quat_w))

        return memory, dataclasses.replace(view, objects={name: moved(seen) for name, seen in view.objects.items()})
