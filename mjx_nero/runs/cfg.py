"""The config of a run: its environment, its learner and its length."""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Annotated, Any

import jax

from mjx_nero import config
from mjx_nero.config import bounds, flag
from mjx_nero.config.bounds import Bounds, Count, NonNegative, OneOf, Seed, Whole
from mjx_nero.envs import things
from mjx_nero.envs.task import EnvCfg
from mjx_nero.learn import learner
from mjx_nero.tasks import registry

OnNan = Annotated[str, OneOf("stop", "rewind")]


@dataclasses.dataclass(frozen=True)
class Asked:
    """The user's choices besides environment, preset and learner, from which the run's config can be rebuilt."""

    robot: str | None = None
    env: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # fields by dotted name
    learner: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class RunCfg:
    """One training run, from which train.py makes its flags. Resuming may change ``free`` fields, but not ``kept`` ones."""

    env_name: str
    preset: str
    env: Any  # EnvCfg
    hyperparameters: Any  # the learner's config
    learner: str = flag("ppo")  # name of the learner
    asked: Asked = Asked()
    impl: str = flag("auto", free=True)
    seed: Seed = flag(0, kept=True)
    out: pathlib.Path | None = flag(None)  # run folder (default: runs/<env>_<time>)
    restore: pathlib.Path | None = flag(None)  # run folder or checkpoint to resume, or a policy to start from
    eval_every: Whole = flag(0, free=True)  # env steps between evaluations; 0: 12 per run
    checkpoint_every: Whole = flag(0, free=True)  # env steps between checkpoints; 0: 5 per run
    eval_episodes: Annotated[int, Bounds(1, 100_000)] = dataclasses.field(default=256, metadata={"kept": True})
    checkpoint_minutes: NonNegative = flag(10.0, free=True)  # maximum time between checkpoints [min]; 0: no limit
    keep: Count = flag(3, free=True)  # number of newest checkpoints to keep, besides the best
    on_nan: OnNan = flag("stop", free=True)  # when training diverges: stop, or rewind once with a lower learning rate
    auto: bool = False  # resume if ``out`` holds a checkpoint, else start
    max_minutes: NonNegative = flag(0.0, free=True)  # maximum training time, without compilation [min]; 0: no limit
    num_devices: Annotated[int, Bounds(1, 4096)] = flag(1, free=True)  # number of GPUs that share the environments
    track: Annotated[str, OneOf("", "wandb")] = flag("")  # service that also receives the metrics (needs the extra track)

    def __post_init__(self):
        bounds.check(self)

    @property
    def num_envs(self) -> int:
        """Number of environments on all devices together."""
        return self.hyperparameters.num_envs

    @property
    def num_timesteps(self) -> int:
        """Total env steps."""
        return self.hyperparameters.num_timesteps


def resolve(
    env: str,
    preset: str,
    robot: str | None,
    env_fields: Mapping[str, Any],
    learner_fields: Mapping[str, Any],
    learner: str = "",
    **rest: Any,
) -> RunCfg:
    """Builds a run's config from names and dotted fields.

    Args:
        robot: robot instead of the environment's own, by name or folder.
        learner: name of the learner; empty: the task's own.

    Raises:
        UserError: a name or field is unknown, or a value has the wrong type.
    """
    cfg = things.overridden(registry.env_cfg(env, preset, robot), env_fields)
    learner = learner or cfg.learner
    hyperparameters = config.override(learner_cfg(cfg, preset, learner), learner_fields)
    asked = Asked(robot, dict(env_fields), dict(learner_fields))
    return RunCfg(env, preset, cfg, hyperparameters, learner, asked, **rest)


def learner_cfg(cfg: EnvCfg, preset: str, name: str = "ppo") -> Any:
    """Returns the hyperparameters of a preset, with the task's own."""
    return learner.cfg_for(name, preset, cfg.training)


def fit_machine(run: RunCfg) -> tuple[RunCfg, str]:
    """Fills in what the machine decides: number of environments, env steps, time limit, and what the learner adapts to devices.

    Returns:
        the run, and a note for the user if there is no GPU.
    """
    on_cpu, budget = jax.default_backend() == "cpu", run.env.budget
    enough = budget.steps_on_cpu if on_cpu else budget.steps
    kind = learner.find(run.learner)
    hyperparameters = dataclasses.replace(
        run.hyperparameters,
        num_envs=run.num_envs or kind.envs[not on_cpu],
        num_timesteps=run.num_timesteps or enough,
    )
    hyperparameters = kind.fit(hyperparameters, run.num_devices * jax.process_count())
    asked, run = run.num_timesteps, dataclasses.replace(run, hyperparameters=hyperparameters)
    if not on_cpu:
        return run, ""
    run = dataclasses.replace(run, eval_episodes=min(run.eval_episodes, 64))
    if asked:
        return run, ""
    run = dataclasses.replace(run, max_minutes=run.max_minutes or 10.0)
    steps = f"{run.num_envs} environments for {enough / 1e6:g} M steps"
    note = f"no GPU: {steps}, at most {run.max_minutes:g} minutes; {kind.pace}"
    return run, note
