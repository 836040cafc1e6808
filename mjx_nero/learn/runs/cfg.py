"""What a run is: its environment, its learner and how long it goes on."""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Annotated, Any

import jax

from mjx_nero import config
from mjx_nero.config import bounds, flag
from mjx_nero.config.bounds import Bounds, Count, NonNegative, OneOf, Seed, Whole
from mjx_nero.envs import registry
from mjx_nero.envs.task import EnvCfg
from mjx_nero.learn import learner

OnNan = Annotated[str, OneOf("stop", "rewind")]


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the user named beside environment, preset and learner: what a run's config is made from once more."""

    robot: str | None = None
    env: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # fields by dotted name
    learner: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class RunCfg:
    """One run of train.py. Flags are made of it. Where a run goes on, what is ``free`` may change, what is ``kept`` may not."""

    env_name: str
    preset: str
    env: Any  # EnvCfg
    hyperparameters: Any  # of the learner: its config
    learner: str = flag("ppo")  # who learns
    asked: Asked = Asked()
    impl: str = flag("auto", free=True)
    seed: Seed = flag(0, kept=True)
    out: pathlib.Path | None = flag(None)  # run folder (default: runs/<env>_<time>)
    restore: pathlib.Path | None = flag(None)  # run folder or checkpoint to go on from, or a policy to start from
    eval_every: Whole = flag(0, free=True)  # env steps between evaluations; 0: 12 a run
    checkpoint_every: Whole = flag(0, free=True)  # env steps between checkpoints; 0: 5 a run
    eval_episodes: Annotated[int, Bounds(1, 100_000)] = dataclasses.field(default=256, metadata={"kept": True})
    checkpoint_minutes: NonNegative = flag(10.0, free=True)  # the most minutes between checkpoints; 0: env steps alone decide
    keep: Count = flag(3, free=True)  # checkpoints to keep beside the best
    on_nan: OnNan = flag("stop", free=True)  # when training diverges: stop, or rewind once and go on slower
    auto: bool = False  # go on if ``out`` holds a checkpoint, start if not
    max_minutes: NonNegative = flag(0.0, free=True)  # stop after so many minutes of training, compilation apart; 0: no limit
    num_devices: Annotated[int, Bounds(1, 4096)] = flag(1, free=True)  # GPUs to spread the environments over
    track: Annotated[str, OneOf("", "wandb")] = flag("")  # also tell this service how it goes (the extra track)

    def __post_init__(self):
        bounds.check(self)

    @property
    def num_envs(self) -> int:
        """On all devices together."""
        return self.hyperparameters.num_envs

    @property
    def num_timesteps(self) -> int:
        """Env steps in all."""
        return self.hyperparameters.num_timesteps


def resolve(
    env: str,
    preset: str,
    robot: str | None,
    env_fields: Mapping[str, Any],
    learner_fields: Mapping[str, Any],
    learner: str = "ppo",
    **rest: Any,
) -> RunCfg:
    """A run's config from names and dotted fields.

    Args:
        robot: another than the environment's own, by name or folder.

    Raises:
        UserError: unknown names or fields, wrong types.
    """
    cfg = registry.env_cfg(env, preset, robot, **env_fields)
    hyperparameters = config.override(learner_cfg(cfg, preset, learner), learner_fields)
    asked = Asked(robot, dict(env_fields), dict(learner_fields))
    return RunCfg(env, preset, cfg, hyperparameters, learner, asked, **rest)


def learner_cfg(cfg: EnvCfg, preset: str, name: str = "ppo") -> Any:
    """The hyperparameters that go with a preset, and those that the task asks for."""
    return learner.cfg_for(name, preset, cfg.training)


def fit_machine(run: RunCfg) -> tuple[RunCfg, str]:
    """Fills in what the machine decides: number of environments, env steps, time limit, and whatever the learner fits to devices.

    Returns:
        the run, and a line that says so where there is no GPU.
    """
    on_cpu, budget = jax.default_backend() == "cpu", run.env.budget
    enough = budget.steps_on_cpu if on_cpu else budget.steps
    hyperparameters = dataclasses.replace(
        run.hyperparameters,
        num_envs=run.num_envs or (256 if on_cpu else 8192),
        num_timesteps=run.num_timesteps or enough,
    )
    hyperparameters = learner.find(run.learner).fit(hyperparameters, run.num_devices * jax.process_count())
    asked, run = run.num_timesteps, dataclasses.replace(run, hyperparameters=hyperparameters)
    if not on_cpu:
        return run, ""
    run = dataclasses.replace(run, eval_episodes=min(run.eval_episodes, 64))
    if asked:
        return run, ""
    run = dataclasses.replace(run, max_minutes=run.max_minutes or 10.0)
    note = (
        f"no GPU: {run.num_envs} environments for {enough / 1e6:g} M steps, at most {run.max_minutes:g} minutes; "
        "an NVIDIA H200 makes 60 M steps of 8,192 environments in half a minute"
    )
    return run, note
