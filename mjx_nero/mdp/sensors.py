"""Sensors: what stands between state and policy. ``init(key, view) -> memory``, ``step(memory, view) -> (memory, view)``.

They apply in the task's order, before the observation terms, so all terms of a group see the same wrong world. An object seen a
centimetre too far left is that much farther from the gripper and that much nearer to the goal.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from mjx_nero import math
from mjx_nero.config.bounds import NonNegative, Share, Steps
from mjx_nero.mdp.memory import delay
from mjx_nero.types import Key, View


@dataclasses.dataclass(frozen=True, kw_only=True)
class Encoders:
    """Joint encoders, which read positions off by the bias of ``randomization.encoder_bias``."""

    def init(self, key: Key, view: View) -> tuple[()]:
        """Returns an empty memory: the physics holds the bias."""
        return ()

    def step(self, memory: tuple[()], view: View) -> tuple[tuple[()], View]:
        """Replaces the positions by the readings."""
        if view.encoder_bias is None:
            return memory, view
        return memory, dataclasses.replace(view, joint_pos=view.joint_pos + view.encoder_bias)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ObjectPosition:
    """A camera's estimate of an object's position: off by a constant per episode, noisy, and late.

    Attributes:
        object: the object's name.
        offset: greatest constant offset along each axis [m].
        noise: greatest noise along each axis, drawn at every step [m].
        delay: least and greatest delay [control steps].
        hold: probability that a step keeps the previous step's delay.
    """

    object: str = "cube"
    offset: NonNegative = 0.0
    noise: NonNegative = 0.0
    delay: Steps = (0, 0)
    hold: Share = 1.0

    def init(self, key: Key, view: View) -> tuple:
        """Draws the episode's offset, and fills the delay with the first position."""
        key, k_offset, k_delay = jax.random.split(key, 3)
        offset = jax.random.uniform(k_offset, (3,), minval=-self.offset, maxval=self.offset)
        late = delay(self.delay, self.hold)
        return key, offset, late.init(k_delay, view.objects[self.object].pos_w) if late else ()

    def step(self, memory: tuple, view: View) -> tuple[tuple, View]:
        """Moves the object in the view."""
        key, offset, line = memory
        key, k_noise = jax.random.split(key)
        seen = view.objects[self.object]
        pos = seen.pos_w
        if late := delay(self.delay, self.hold):
            line, pos = late.step(line, pos)
        pos = pos + offset + self.noise * jax.random.uniform(k_noise, (3,), minval=-1.0, maxval=1.0)
        objects = {**view.objects, self.object: dataclasses.replace(seen, pos_w=pos)}
        return (key, offset, line), dataclasses.replace(view, objects=objects)


@dataclasses.dataclass(frozen=True, kw_only=True)
class BasePose:
    """A wrongly calibrated base: all objects are seen moved by one rigid motion about it.

    For an arm that knows the world through cameras alone, this equals a displaced base, as long as the base stands upright. The
    commanded point stays, as it is given in the robot's own frame.

    Attributes:
        offset: greatest offset along each axis [m].
        turn: greatest turn about the vertical axis [rad].
    """

    offset: NonNegative = 0.0
    turn: NonNegative = 0.0

    def init(self, key: Key, view: View) -> tuple[Float[Array, "3"], Float[Array, ""]]:
        """Draws the episode's motion."""
        k_offset, k_turn = jax.random.split(key)
        offset = jax.random.uniform(k_offset, (3,), minval=-self.offset, maxval=self.offset)
        return offset, jax.random.uniform(k_turn, (), minval=-self.turn, maxval=self.turn)

    def step(self, memory: tuple, view: View) -> tuple[tuple, View]:
        """Moves the objects in the view."""
        offset, turn = memory
        quat = math.axis_angle(jnp.array([0.0, 0.0, 1.0]), turn)

        def moved(seen):
            pos = math.rotate(quat, seen.pos_w - view.root_pos_w) + view.root_pos_w + offset
            return dataclasses.replace(seen, pos_w=pos, quat_w=math.quat_mul(quat, seen.quat_w))

        return memory, dataclasses.replace(view, objects={name: moved(seen) for name, seen in view.objects.items()})
