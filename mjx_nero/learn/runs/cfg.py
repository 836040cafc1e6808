"""What a run is: its environment, its learner and how long it goes on."""

import dataclasses
import pathlib
from collections.abc import Mapping
from typing import Annotated, Any

import jax

from mjx_nero import bounds, config
from mjx_nero.bounds import Bounds, Count, NonNegative, OneOf, Seed, Whole
from mjx_nero.envs import registry
from mjx_nero.envs.task import EnvCfg
from mjx_nero.learn import learner


@dataclasses.dataclass(frozen=True)
class Asked:
    """What the user named beside environment, preset and learner: what a run's config is made from once more."""

    robot: str | None = None
    env: Mapping[str, Any] = dataclasses.field(default_factory=dict)  # fields by dotted name
    learner: Mapping[str, Any] = dataclasses.field(default_factory=dict)


@dataclasses.dataclass(frozen=True)
class RunCfg:
    """One run of train.py."""

    env_name: str
    preset: str
    env: Any  # EnvCfg
    hyperparameters: Any  # of the learner: its config
    learner: str = "ppo"
    asked: Asked = Asked()
    impl: str = "auto"
    seed: Seed = 0
    out: pathlib.Path | None = None
    restore: pathlib.Path | None = None
    eval_every: Whole = 0  # env steps; 0: twelve times a run
    checkpoint_every: Whole = 0  # env steps; 0: five times a run
    eval_episodes: Annotated[int, Bounds(1, 100_000)] = 256
    checkpoint_minutes: NonNegative = 10.0  # at most between checkpoints; 0: env steps alone decide
    keep: Count = 3  # checkpoints, the best apart
    on_nan: Annotated[str, OneOf("stop", "rewind")] = "stop"  # "rewind": once, to the last checkpoint, slower from there
    auto: bool = False  # go on if ``out`` holds a checkpoint, start if not
    max_minutes: NonNegative = 0.0  # of training, compilation apart; 0: no limit
    num_devices: Annotated[int, Bounds(1, 4096)] = 1  # GPUs to spread the environments over
    track: str = ""  # who is told of the metrics beside the folder: "wandb"; empty: nobody

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
    lifts, on_cpu = bool(run.env.scene.objects), jax.default_backend() == "cpu"
    tasks_own = run.env.training.get("num_timesteps", 0)
    # Few environments learn from fewer steps, which is what a CPU is short of.
    enough = (10_000_000 if lifts else 2_000_000) if on_cpu else tasks_own or (100_000_000 if lifts else 60_000_000)
    short = run.num_timesteps in (0, tasks_own)  # nobody has asked for another number
    hyperparameters = dataclasses.replace(
        run.hyperparameters,
        num_envs=run.num_envs or (256 if on_cpu else 8192),
        num_timesteps=enough if short else run.num_timesteps,
    )
    hyperparameters = learner.find(run.learner).fit(hyperparameters, run.num_devices * jax.process_count())
    run = dataclasses.replace(run, hyperparameters=hyperparameters)
    if not on_cpu:
        return run, ""
    run = dataclasses.replace(run, eval_episodes=min(run.eval_episodes, 64))
    if not short:
        return run, ""
    run = dataclasses.replace(run, max_minutes=run.max_minutes or 10.0)
    note = (
        f"no GPU: {run.num_envs} environments for {enough / 1e6:g} M steps, at most {run.max_minutes:g} minutes; "
        "an NVIDIA H200 makes 60 M steps of 8,192 environments in half a minute"
    )
    return run, note
