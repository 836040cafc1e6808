"""Demonstrations: episodes that an agent plays side by side, as episodes of a data set.

An episode depends only on its number and the seed, so each can be replayed. Its last digits also depend on how many are played
side by side: XLA rounds products of another number of rows differently. Noise on the agent's actions takes it to states that it
would not reach by itself. The executed action is kept beside its label, the action without noise (Laskey et al. 2017, DART).
"""

import dataclasses
import functools
from collections.abc import Iterator
from typing import Any

from mjx_nero.sim.quiet import State

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from mjx_nero import math
from mjx_nero.data import Episode
from mjx_nero.data import episode as names
from mjx_nero.data.units import Units
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.imitation.recording.pictures import Cameras
from mjx_nero.learn import device_memory, waiting
from mjx_nero.learn.play.rollout import Agent
from mjx_nero.sim import kinematics
from mjx_nero.types import DelayMemory, Key, View

SMOOTH_S = 0.2  # [s] time constant of the noise, because drives do not follow noise that changes at every step
SEGMENT = 10  # control steps between two checks of which episodes have ended, if they may end early
_NOISE = 0xDA27  # folded into an episode's key


class Player:
    """Plays episodes by their numbers, ``size`` at a time, in one compiled program.

    Args:
        env: the environment.
        agent: the agent that plays.
        units: units of states and actions in the data set.
        kept: features that episodes keep.
        deltas: actions are steps of the hand instead of joint targets.
        noise: standard deviation of the noise on the arm's actions, in the agent's units.
        cameras: cameras whose pictures episodes keep.
        early: an episode ends as soon as success has held for as long as the task requires, and the next one takes its place.
        velocities: the state also has the joints' velocities.

    Raises:
        UserError: so many episodes of this length do not fit into memory.
    """

    def __init__(
        self,
        env: ManipulationEnv,
        agent: Agent,
        units: Units,
        size: int,
        kept: tuple[str, ...],
        deltas: bool = False,
        noise: float = 0.0,
        cameras: Cameras | None = None,
        early: bool = False,
        velocities: bool = False,
    ):
        self._cameras, self._early, self._velocities = cameras, early, velocities
        self.env, self.agent, self.units, self.size, self.kept, self.noise = env, agent, units, size, kept, noise
        self._arm = len(env.cfg.robot.arm.joints)
        robot = env.cfg.robot
        self._hand = kinematics.Chain(env.physics_model, robot.joints, [robot.ee_site]) if deltas else None
        self._steps = min(SEGMENT, env.episode_length) if early else env.episode_length
        self._play, self._refill = jax.jit(self._play_all), jax.jit(self._refill_all)
        one = jax.eval_shape(
            self._record, env.state_shape, jax.ShapeDtypeStruct((env.action_size,), jnp.float32), env.state_shape
        )
        # Copies of the steps: from the device, ordered by slots, and as episodes; meanwhile others are written, from two.
        device_memory.check_batch(env, size, "--side-by-side", 5.0 * size * env.episode_length * device_memory.size(one))

    def close(self) -> None:
        """Frees the renderers."""
        if self._cameras:
            self._cameras.close()

    def __call__(self, first: int, seed: int) -> Iterator[Episode]:
        """Plays episodes in the order of their numbers, from ``first`` on, without end.

        A number always uses the same slot, wherever playing begins, because a compiled program rounds each row of a batch
        differently.
        """
        key, numbers = jax.random.PRNGKey(seed), first + (np.arange(self.size) - first) % self.size
        empty = jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), jax.eval_shape(self._begin_all, jnp.asarray(numbers), key))
        slots, due = self._refill(empty, jnp.ones(self.size, bool), jnp.asarray(numbers), key), first
        parts: list[list] = [[] for _ in numbers]
        won, done = np.zeros(self.size, bool), dict[int, Episode]()
        while True:
            slots, played = waiting.result_of(self._play, slots, jnp.asarray(numbers), key)
            look, kept, alive, wins = jax.device_get(played)
            kept = jax.tree.map(lambda x: np.ascontiguousarray(x.swapaxes(0, 1)), kept)
            counts, ended = alive.sum(axis=0).astype(int), np.asarray(slots[-1]) == 0
            won |= wins.any(axis=0)
            for i in range(self.size):
                parts[i].append(_cut(kept, i, counts[i]))
                if ended[i]:
                    mine = {name: x[i] for name, x in look.items()}
                    done[int(numbers[i])] = self._episode(parts[i], mine, bool(won[i]), int(numbers[i]))
                    parts[i], won[i], numbers[i] = [], False, numbers[i] + self.size
            while due in done:
                yield done.pop(due)
                due += 1
            slots = self._refill(slots, jnp.asarray(ended), jnp.asarray(numbers), key)

    def _episode(self, parts: list, look: dict[str, np.ndarray], success: bool, number: int) -> Episode:
        arrays = {name: np.concatenate([part[0][name] for part in parts]) for name in parts[0][0]}
        made = Episode(arrays, success, number)
        if not (cameras := self._cameras):
            return made
        qpos, scenery = jax.tree.map(lambda *x: np.concatenate(x), *(part[1:] for part in parts))
        look = {name: np.broadcast_to(x, (len(qpos), *x.shape)) for name, x in look.items()}
        scenery = dataclasses.replace(scenery, look=look)
        films = {names.PICTURES + name: functools.partial(cameras.frames, name, qpos, scenery) for name in cameras.names}
        return dataclasses.replace(made, pictures=films)

    def _begin_all(self, numbers: Array, key: Key) -> tuple:
        """Starts an episode in every slot: state, the agent's memory, noise, number of steps, and whether it continues."""
        state = jax.vmap(self.env.reset)(_keys(numbers, key))
        n = self.size
        return state, self.agent.init(state), jnp.zeros((n, self._arm)), jnp.zeros(n, jnp.int32), jnp.ones(n)

    def _refill_all(self, slots: tuple, ended: Bool[Array, " n"], numbers: Array, key: Key) -> tuple:
        def fresh(new: Array, old: Array) -> Array:
            return jnp.where(ended.reshape(ended.shape + (1,) * (new.ndim - 1)), new, old)

        return jax.tree.map(fresh, self._begin_all(numbers, key), slots)

    def _play_all(self, slots: tuple, numbers: Array, key: Key) -> tuple[tuple, Any]:
        """Plays a segment.

        Returns:
            the slots, and for each step [steps, n, ...]: features and what pictures need, whether its episode was still going
            on, and whether the step made it a success. The look, which stays the same during an episode, is apart [n, ...].
        """
        env, apart = self.env, jax.vmap(jax.random.fold_in, (0, None))(_keys(numbers, key), _NOISE)

        def step(slots: tuple, _: None) -> tuple:
            state, memory, off, at, alive = slots
            clean, memory = self.agent.act(None, memory, state, key)
            off = self._next_noise(off, apart, at)
            action = clean.at[:, : self._arm].add(off) if self.noise else clean
            after = jax.vmap(env.step)(state, action)
            if self._early:
                after = jax.vmap(self._ended)(after)
            drawn: tuple = ()
            if self._cameras:
                drawn = state.pipeline_state.qpos, dataclasses.replace(jax.vmap(env.scenery)(state), look={})
            kept = jax.vmap(self._record)(state, clean, after), *drawn
            won = (alive > 0) & (after.done > 0) & (after.metrics["success"] > 0)
            return (after, memory, off, at + 1, alive * (1 - after.done)), (kept, alive, won)

        steps: tuple
        look = jax.vmap(env.scenery)(slots[0]).look if self._cameras else {}
        slots, steps = jax.lax.scan(step, slots, length=self._steps)
        return slots, (look, *steps)

    def _ended(self, state: State) -> State:
        """Ends an episode with success if that has held long enough."""
        held = state.info["carry"].memory["success.hold"] >= max(1, round(self.env.cfg.success.hold_s / self.env.dt))
        success = jnp.where(held, 1.0, state.metrics["success"])
        return state.replace(done=jnp.where(held, 1.0, state.done), metrics={**state.metrics, "success": success})

    def _next_noise(self, off: Float[Array, "n na"], keys: Key, at: Int[Array, " n"]) -> Float[Array, "n na"]:
        """Filters white noise by a first-order filter that keeps its standard deviation at every step.

        Args:
            at: number of steps in each episode so far.
        """
        if not self.noise:
            return off
        stays, later = np.exp(-self.env.dt / SMOOTH_S), at[:, None] > 0
        drawn = jax.vmap(lambda key, at: jax.random.normal(jax.random.fold_in(key, at), (self._arm,)))(keys, at)
        return jnp.where(later, stays, 0.0) * off + self.noise * jnp.where(later, np.sqrt(1 - stays**2), 1.0) * drawn

    def _record(self, state: State, clean: Float[Array, " na"], after: State) -> dict[str, Float[Array, " n"]]:
        """Collects the features of one environment's step: its state before, label, executed action, and outcome."""
        env = self.env
        view = env.view(state)
        label, told = env.targets(_prompt(state, clean), clean), after.pipeline_state.ctrl
        seen = state.obs["state"]
        parts = jax.tree.leaves(seen)  # the terms by name, if the group stays apart
        label, told = (self._deltas(view, x) if self._hand else self.units.shown(x) for x in (label, told))
        flags = after.done > 0, after.metrics["success"] > 0
        found = {
            names.STATE: joint_state(view, self.units, self._velocities),
            names.ENVIRONMENT: environment_state(env, view, seen=bool(self._cameras)),
            names.ACTION: label,
            names.EXECUTED: told,
            names.SEEN: jnp.concatenate([jnp.ravel(x) for x in parts]),
            names.DONE_BY: clean,
            names.QPOS: state.pipeline_state.qpos,
            names.REWARD: after.reward[None],
            names.DONE: flags[0][None],
            names.SUCCESS: flags[1][None],
        }
        return {name: found[name] for name in self.kept if name in found}

    def _deltas(self, view: View, targets: Float[Array, " nu"]) -> Float[Array, " n"]:
        """Returns the motion of the hand from its pose to the targets' pose (m, rotation vector, world), and the gripper's
        targets."""
        assert self._hand
        (pos,), (quat,) = self._hand.poses(targets)
        turn = math.quat_log(math.quat_mul(quat, math.quat_conj(view.ee_quat_w)))
        return jnp.concatenate([pos - view.ee_pos_w, turn, self.units.shown(targets)[self._arm :]])


def _cut(kept: tuple, slot: int, steps: int) -> tuple:
    """Selects the steps of one slot from a segment, leaves [n, steps, ...]."""
    features, *drawn = kept
    return {name: x[slot, :steps] for name, x in features.items()}, *jax.tree.map(lambda x: x[slot, :steps], drawn)


def joint_state(view: View, units: Units, velocities: bool) -> Float[Array, " n"]:
    """Returns joint positions in a data set's units and, if requested, velocities in these units per second."""
    shown = units.shown(view.joint_pos)
    return jnp.concatenate([shown, view.joint_vel * units.factor]) if velocities else shown


def told(env: ManipulationEnv, seen: bool) -> tuple[str, ...]:
    """Lists the things whose poses are in ``environment_state``.

    Args:
        seen: pictures show everything but the goal.
    """
    return ("goal",) if seen else ("hand", *env.cfg.scene.objects, "goal")


def environment_state(env: ManipulationEnv, view: View, seen: bool) -> Float[Array, " n"]:
    """Returns the poses of hand, objects and goal in the world (m, wxyz); only the goal's if pictures show the rest."""
    poses = {name: (each.pos_w, each.quat_w) for name, each in view.objects.items()}
    poses |= {"hand": (view.ee_pos_w, view.ee_quat_w), "goal": (view.goal_pos_w, view.goal_quat_w)}
    return jnp.concatenate([x for name in told(env, seen) for x in poses[name]])


def _prompt(state: State, action: Float[Array, " na"]) -> State:
    """Fills all action delays of a state with ``action``, because a label is the present action without delay."""
    carry = state.info["carry"]
    memory = {
        name: dataclasses.replace(held, past=jnp.broadcast_to(action, held.past.shape))
        if name.startswith("actions.") and isinstance(held, DelayMemory)
        else held
        for name, held in carry.memory.items()
    }
    return state.replace(info={**state.info, "carry": carry.replace(memory=memory)})


def start(env: ManipulationEnv, number: int, seed: int) -> State:
    """Returns the state in which an episode starts."""
    return env.reset(_keys(jnp.asarray([number]), jax.random.PRNGKey(seed))[0])


def _keys(numbers: Array, key: Key) -> Key:
    return jax.vmap(jax.random.fold_in, (None, 0))(key, numbers)
