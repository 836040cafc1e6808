"""Cloning (Pomerleau 1989): the policy's network learns the demonstrated action for each demonstrated observation.

Only evaluations step the environments. The network is PPO's, so the policy can be played, exported and fine-tuned by PPO.
"""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Any

from mjx_nero.sim.quiet import Env

import jax
import jax.numpy as jnp
import numpy as np
import optax
from flax import struct
from jaxtyping import Array, Int

from mjx_nero import config
from mjx_nero.data import open_dataset
from mjx_nero.data.episode import DONE_BY, SEEN, Dataset
from mjx_nero.errors import UserError
from mjx_nero.imitation.clone.cfg import PRESETS, CloneCfg
from mjx_nero.learn import learner
from mjx_nero.learn.learner import HELD, Kind, Observation
from mjx_nero.learn.ppo.cfg import differing
from mjx_nero.learn.ppo.networks import ACTOR, from_meta, init_params, make_act, make_networks
from mjx_nero.types import Bank, Key, Shown


@struct.dataclass
class CloneState:
    """The whole state of a run."""

    normalizer: Any
    params: Any
    opt_state: Any
    iteration: Int[Array, ""]
    seed: Int[Array, ""]  # draws which steps an iteration learns from
    slow: Array  # factor of the learning rate


class Learner(learner.Learner):
    """A ``learner.Learner`` that learns from demonstrations.

    Args:
        env: batch of environments, from ``wrappers.for_training``.
        cfg: hyperparameters, with ``num_envs`` and ``num_timesteps`` filled in.
        num_devices: must be one.

    Raises:
        UserError: there are no demonstrations, they do not fit the environment, or there are several devices.
    """

    divisor = 1

    def __init__(self, env: Env, cfg: CloneCfg, num_devices: int = 1):
        if num_devices > 1:
            raise UserError("--learner clone learns on one device: leave out --num-devices")
        if not cfg.data:
            raise UserError("--learner clone learns from demonstrations: pass --clone.data DIR, a folder that 'demos' wrote")
        self.env, self.cfg, self.num_envs, self.num_devices = env, cfg, cfg.num_envs, num_devices
        self._sizes = env.observation_size
        self._networks = make_networks(self._sizes, env.action_size, cfg.network)
        self.steps_per_iteration = cfg.minibatch_size * cfg.updates
        parts = [_read(pathlib.Path(name.strip()), env) for name in cfg.data.split(",")]
        self._seen, self._done = (np.concatenate(part) for part in zip(*parts, strict=True))
        total = max(1, -(-cfg.num_timesteps // self.steps_per_iteration)) * cfg.updates
        rate = optax.cosine_decay_schedule(cfg.learning_rate, total)
        self._optimizer = optax.flatten(
            optax.chain(optax.clip_by_global_norm(cfg.max_grad_norm), optax.adamw(rate, weight_decay=cfg.weight_decay))
        )

    def init(self, key: Key, bank: Bank | None = None, shown: Shown | None = None) -> CloneState:
        """Makes new networks; the demonstrations' mean and deviation normalize observations."""
        k_net, k_seed = jax.random.split(key)
        normalizer, params = init_params(self._networks, self._sizes, k_net)
        normalizer = normalizer.replace(
            mean={**normalizer.mean, ACTOR: jnp.asarray(self._seen.mean(axis=0))},
            std={**normalizer.std, ACTOR: jnp.asarray(np.maximum(self._seen.std(axis=0), 1e-4))},
        )
        seed = jax.random.randint(k_seed, (), 0, 1 << 30)
        opt_state = self._optimizer.init(params.policy)
        return CloneState(normalizer, params, opt_state, jnp.zeros((), jnp.int32), seed, jnp.ones(()))

    def run(self, state: CloneState, iterations: int) -> tuple[CloneState, dict[str, Array]]:
        """See ``learner.Learner``."""
        state, losses = jax.lax.scan(lambda s, _: self._iterate(s), state, length=iterations)
        return state, {"loss": losses.mean()}

    def _iterate(self, state: CloneState) -> tuple[CloneState, Array]:
        shape = self.cfg.updates, self.cfg.minibatch_size
        shapes = [jax.ShapeDtypeStruct((*shape, x.shape[1]), jnp.float32) for x in (self._seen, self._done)]
        batches = jax.pure_callback(self._draw, tuple(shapes), state.seed, state.iteration)

        def update(carry: tuple, batch: tuple) -> tuple:
            params, opt_state = carry
            loss, gradient = jax.value_and_grad(self._loss)(params, state, *batch)
            change, opt_state = self._optimizer.update(gradient, opt_state, params)
            return (optax.apply_updates(params, jax.tree.map(lambda x: state.slow * x, change)), opt_state), loss

        done: Any = jax.lax.scan(update, (state.params.policy, state.opt_state), batches)
        (policy, opt_state), losses = done
        params = state.params.replace(policy=policy)
        return dataclasses.replace(state, params=params, opt_state=opt_state, iteration=state.iteration + 1), losses.mean()

    def _draw(self, seed: Any, iteration: Any) -> tuple[np.ndarray, np.ndarray]:
        """Draws the steps that an iteration learns from, in the host's memory [updates, steps, numbers]."""
        drawn = np.random.default_rng((int(seed), int(iteration)))
        rows = drawn.integers(len(self._seen), size=(self.cfg.updates, self.cfg.minibatch_size))
        return self._seen[rows], self._done[rows]

    def _loss(self, policy: Any, state: CloneState, seen: Array, done: Array) -> Array:
        """Computes the mean squared error of the deterministic action."""
        params = state.normalizer, state.params.replace(policy=policy)
        return jnp.mean((make_act(self._networks, params)({ACTOR: seen}) - done) ** 2)

    def slower(self, state: CloneState) -> CloneState:
        """Returns the state with a tenth of the learning rate, and other random draws."""
        return dataclasses.replace(state, slow=0.1 * state.slow, seed=state.seed + 1)

    def act(self, params: tuple, obs: Observation) -> jax.Array:
        """Returns the mode of the action distribution."""
        return make_act(self._networks, params)(obs)

    def describe(self) -> dict[str, Any]:
        """Describes the networks for the policy's file."""
        return {"network": config.to_dict(self.cfg.network)}

    def footprint(self) -> tuple[float, float]:
        """Counts the steps of an iteration twice: as drawn, and on the device."""
        width = self._seen.shape[1] + self._done.shape[1]
        return 8.0 * self.steps_per_iteration * width, 0.0


def _read(path: pathlib.Path, env: Env) -> tuple[np.ndarray, np.ndarray]:
    """Reads observations and actions [steps, numbers], and checks that they fit the environment's policies.

    Raises:
        UserError: they do not fit.
    """
    found, own = open_dataset(path), env.unwrapped
    size = own.observation_size[ACTOR]
    if isinstance(size, Mapping):
        raise UserError(
            "--learner clone reads observations as one vector, and this task keeps its terms apart: pass another --preset"
        )
    _same(path, found, "observations", SEEN, size[-1])
    _same(path, found, "actions", DONE_BY, own.action_size)
    low, high = own.actions.bounds()  # beyond them nothing more happens, so there is nothing to learn
    return found.column(SEEN), np.clip(found.column(DONE_BY), low, high)


def _same(path: pathlib.Path, found: Dataset, what: str, name: str, size: int) -> None:
    features, about = found.schema.features, found.schema.about
    there = features[name].size if name in features else 0
    if there != size:
        raise UserError(
            f"{path} has {what} of {there} numbers (env {about.get('env')}, preset {about.get('preset')}, through "
            f"{about.get('through')}), but a policy here has {size}: pass the --env and --preset that it was made with, or make "
            "one with 'demos --agent policy' or 'demos --through task'"
        )
    if not len(found):
        raise UserError(f"{path} holds no episode yet: give another folder, or write some with 'demos --out'")


KIND = Kind(make=Learner, presets=PRESETS, policy=from_meta, held=HELD, differing=differing)
