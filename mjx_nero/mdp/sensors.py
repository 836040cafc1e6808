"""Sensor models between state and policy: ``init(key, view) -> memory`` and ``step(memory, view) -> (memory, view)``.

They apply in the task's order, before the observation terms, so all terms of a group see the same errors. An error in an object's
position, for example, changes its distances from gripper and goal as well.

A sensor with a ``camera`` may read only ``every`` so many of its pictures; ``due(memory)`` then says whether it reads the current
one (``images.Lens``).
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
    """Joint encoders: they add the bias of ``randomization.encoder_bias`` to the joint positions."""

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
    """A camera's estimate of an object's position: with a constant offset per episode, with noise, and late.

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
class Gauge:
    """A force sensor: with a constant offset and factor per episode, with noise, and late.

    Attributes:
        reading: name in ``View.readings``, such as ``wrist``.
        offset: greatest constant offset of each number [N, N m]; one for all, or one for each.
        scale: greatest deviation of each number's factor from 1.
        noise: greatest noise of each number, drawn at every step; one for all, or one for each.
        delay: least and greatest delay [control steps].
        hold: probability that a step keeps the previous step's delay.
    """

    reading: str = "wrist"
    offset: tuple[NonNegative, ...] = (0.0,)
    scale: NonNegative = 0.0
    noise: tuple[NonNegative, ...] = (0.0,)
    delay: Steps = (0, 0)
    hold: Share = 1.0

    def init(self, key: Key, view: View) -> tuple:
        """Draws the episode's errors, and fills the delay with the first reading."""
        key, k_offset, k_scale, k_delay = jax.random.split(key, 4)
        value = view.readings[self.reading]
        offset = jnp.array(self.offset) * jax.random.uniform(k_offset, value.shape, minval=-1.0, maxval=1.0)
        factor = 1.0 + self.scale * jax.random.uniform(k_scale, value.shape, minval=-1.0, maxval=1.0)
        late = delay(self.delay, self.hold)
        return key, offset, factor, late.init(k_delay, value) if late else ()

    def step(self, memory: tuple, view: View) -> tuple[tuple, View]:
        """Replaces the reading by the sensor's output."""
        key, offset, factor, line = memory
        key, k_noise = jax.random.split(key)
        value = view.readings[self.reading]
        if late := delay(self.delay, self.hold):
            line, value = late.step(line, value)
        value = factor * value + offset
        value = value + jnp.array(self.noise) * jax.random.uniform(k_noise, value.shape, minval=-1.0, maxval=1.0)
        return (key, offset, factor, line), dataclasses.replace(view, readings={**view.readings, self.reading: value})


@dataclasses.dataclass(frozen=True, kw_only=True)
class BasePose:
    """A calibration error of the base: all objects and fixtures are seen moved by one rigid motion about it.

    For an arm that sees the world through cameras alone, this equals a displaced base, as long as the base stands upright. The
    commanded point does not move, because it is given in the robot's own frame.

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
        """Moves the objects and fixtures in the view."""
        offset, turn = memory
        quat = math.axis_angle(jnp.array([0.0, 0.0, 1.0]), turn)

        def moved(pos):
            return math.rotate(quat, pos - view.root_pos_w) + view.root_pos_w + offset

        def placed(seen):
            return dataclasses.replace(seen, pos_w=moved(seen.pos_w), quat_w=math.quat_mul(quat, seen.quat_w))

        def stands(seen):
            pos = {name: moved(at) for name, at in seen.site_pos_w.items()}
            turn = {name: math.quat_mul(quat, at) for name, at in seen.site_quat_w.items()}
            return dataclasses.replace(placed(seen), site_pos_w=pos, site_quat_w=turn)

        objects = {name: placed(seen) for name, seen in view.objects.items()}
        fixtures = {name: stands(seen) for name, seen in view.fixtures.items()}
        return memory, dataclasses.replace(view, objects=objects, fixtures=fixtures)
