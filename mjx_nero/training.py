"""A training run: machine defaults, the loop with progress and checkpoints, final files."""

import concurrent.futures
import contextlib
import dataclasses
import importlib
import json
import pathlib
import shlex
import signal
import time
from collections.abc import Callable
from typing import Any

import jax
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from mjx_nero import checkpoint, config, memory, policy, registry, render, rollout, wrappers
from mjx_nero.env import EnvCfg, ManipulationEnv
from mjx_nero.physics import compiler_options
from mjx_nero.physics.mjx_warp import WarpPhysics
from mjx_nero.ppo import PRESETS, Learner, PpoCfg, TrainState
from mjx_nero.run_folder import RunFolder
from mjx_nero.types import UserError


@dataclasses.dataclass(frozen=True)
class RunCfg:
    """One run of train.py."""

    env_name: str
    preset: str
    env: Any  # EnvCfg
    ppo: PpoCfg
    impl: str = "auto"
    seed: int = 0
    out: pathlib.Path | None = None
    restore: pathlib.Path | None = None
    eval_every: int = 0  # env steps; 0: twelve times a run
    checkpoint_every: int = 0  # env steps; 0: five times a run
    eval_episodes: int = 256
    max_minutes: float = 0.0  # of training, compilation apart; 0: no limit
    video: bool = True
    num_devices: int = 1  # GPUs to spread the environments over


def fit_machine(run: RunCfg) -> tuple[RunCfg, str]:
    """Fills in what the machine decides: number of environments, env steps, time limit. With a line that says so."""
    ppo, lifts = run.ppo, run.env.scene.cube
    if jax.default_backend() != "cpu":
        enough = 100_000_000 if lifts else 60_000_000
        ppo = dataclasses.replace(ppo, num_envs=ppo.num_envs or 8192, num_timesteps=ppo.num_timesteps or enough)
        return dataclasses.replace(run, ppo=ppo), ""
    # Few environments learn from fewer steps, which is what a CPU is short of.
    short, enough = not ppo.num_timesteps, 10_000_000 if lifts else 2_000_000
    ppo = dataclasses.replace(ppo, num_envs=ppo.num_envs or 256, num_timesteps=ppo.num_timesteps or enough)
    run = dataclasses.replace(run, ppo=ppo, eval_episodes=min(run.eval_episodes, 64))
    if not short:
        return run, ""
    run = dataclasses.replace(run, max_minutes=run.max_minutes or 10.0)
    note = (
        f"no GPU: {ppo.num_envs} environments for {enough / 1e6:g} M steps, at most {run.max_minutes:g} minutes; "
        "an NVIDIA H200 makes 60 M steps of 8,192 environments in half a minute"
    )
    return run, note


def train(run: RunCfg, command: str = "train.py") -> dict[str, Any]:
    """Trains a policy and leaves everything about it in the run folder; returns the summary that it prints.

    Args:
        command: how the user called us, for the hint how to go on.

    Raises:
        UserError: anything that the user can mend: impl, folder, checkpoint, sizes.
    """
    console = Console(stderr=True)
    run, note = fit_machine(run)
    ppo = run.ppo
    source = _checkpoint_path(run.restore) if run.restore else None
    resume_folder = run.restore if run.restore and run.restore.is_dir() else None
    stamp = time.strftime("%Y%m%d_%H%M%S")
    path = run.out or resume_folder or pathlib.Path("runs") / f"{run.env_name}_{stamp}"
    env = ManipulationEnv(run.env, impl=run.impl, num_envs=ppo.num_envs)
    learner = Learner(wrappers.for_training(env), ppo, run.num_devices)
    memory.check(learner)
    folder = RunFolder(path, resume=resume_folder is not None and path.resolve() == resume_folder.resolve())
    meta = policy.describe(env, run.env_name, run.preset, ppo.network)

    if note:
        console.print(note, highlight=False, soft_wrap=True)
    started = time.perf_counter()
    iterations = -(-ppo.num_timesteps // learner.steps_per_iteration)
    chunk = min(iterations, 20 if jax.default_backend() != "cpu" else 2)
    with (
        console.status("compiling (a minute or two the first time) ..."),
        folder.unless_failed(),
        memory.in_one_line(learner),
        _threads() as side_by_side,  # compilers work without Python's lock
    ):
        side_by_side.submit(importlib.import_module, "tensorboardX")  # seconds where it finds PyTorch
        waiting = []
        if isinstance(env.physics, WarpPhysics):
            waiting.append(side_by_side.submit(env.physics.load, ppo.num_envs // run.num_devices, run.num_devices))
        starting = side_by_side.submit(_initial_state, learner, run.seed, source)
        shapes = learner.place(jax.eval_shape(learner.init, jax.random.PRNGKey(0)))
        program = jax.jit(learner.run, static_argnums=1, donate_argnums=0).lower(shapes, chunk)
        state = starting.result()
        if state.iteration >= iterations:
            made = int(state.iteration) * learner.steps_per_iteration
            raise UserError(f"{source} has made its {made:,} steps already: pass a larger --num-timesteps")
        compiling = side_by_side.submit(program.compile, compiler_options(env.impl))
        evaluate = Evaluator(run, learner)
        waiting.append(side_by_side.submit(evaluate.compiler(learner.on_one_device(state))))
        advance = compiling.result()
        memory.check_compiled(learner, advance)
        for work in waiting:
            work.result()
        first = evaluate(learner.on_one_device(state))
    compile_s = time.perf_counter() - started
    spread = f" on {run.num_devices} devices" if run.num_devices > 1 else ""
    console.print(
        f"{path}: compiled in {compile_s:.0f} s; {env.impl}, {ppo.num_envs} environments{spread}",
        highlight=False,
        soft_wrap=True,
    )

    done = int(state.iteration)
    folder.begin(config.to_dict(run), done * learner.steps_per_iteration)
    loop = _Loop(run, learner, folder, evaluate, advance, chunk, iterations, meta, console)
    try:
        with memory.in_one_line(learner):
            state, stopped = loop.run(state, first)
    finally:
        folder.close()
    steps = int(state.iteration) * learner.steps_per_iteration
    if stopped == "interrupted":
        console.print(
            f"stopped at {steps:,} steps, all saved; go on with: {command} --restore {path}", highlight=False, soft_wrap=True
        )
    checkpoint.save(path / "policy.safetensors", (state.normalizer, state.params), {**meta, "env_steps": steps})
    summary = {
        "env": run.env_name,
        "preset": run.preset,
        "seed": run.seed,
        "impl": env.impl,
        "num_envs": ppo.num_envs,
        "num_devices": run.num_devices,
        "env_steps": steps,
        "compile_s": round(compile_s, 1),
        "train_s": round(loop.wall, 1),
        "steps_per_s": round(loop.steps_per_s),
        "seconds_to_95": loop.seconds_to_95,
        "steps_to_95": loop.steps_to_95,
        "nan_count": loop.nan_count,
        "overflow_count": loop.overflow_count,
        "stopped": stopped,
        "evaluation": loop.last_eval,
        "device": jax.devices()[0].device_kind,
    }
    (path / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    if run.video and stopped != "interrupted":
        _video(env, run, learner.on_one_device(state), learner, path / "video.mp4", console)
    return {**summary, "folder": str(path)}


class _Loop:
    """The training loop between compilation and the final files."""

    def __init__(self, run, learner, folder, evaluate, advance, chunk, iterations, meta, console):
        self.r, self.learner, self.folder, self.evaluate, self.advance = run, learner, folder, evaluate, advance
        self.chunk, self.iterations, self.meta, self.console = chunk, iterations, meta, console
        total = iterations * learner.steps_per_iteration
        self.eval_every = run.eval_every or max(1, total // 12)
        self.save_every = run.checkpoint_every or max(1, total // 5)
        self.wall = self.steps_per_s = 0.0
        self.seconds_to_95 = self.steps_to_95 = None
        self.nan_count = self.overflow_count = 0
        self.last_eval: dict[str, Any] = {}

    def run(self, state: TrainState, first: dict[str, Any]) -> tuple[TrainState, str]:
        """Trains until the steps or minutes are used up or Ctrl-C; says which."""
        per = self.learner.steps_per_iteration
        steps = start = int(state.iteration) * per
        self.last_eval = first
        if not self.folder.rows:
            self._log(steps, {}, first)
        wait = {"eval": steps + self.eval_every, "save": steps + self.save_every}
        begun = time.perf_counter()
        with self._progress() as (bar, task), _stop_on_ctrl_c(self.console) as stop:
            while steps < self.iterations * per:
                t = time.perf_counter()
                state, metrics = self.advance(state)
                metrics = {name: float(value) for name, value in metrics.items()}  # waits for the device
                self.steps_per_s = self.chunk * per / (time.perf_counter() - t)
                steps += self.chunk * per
                self.wall = time.perf_counter() - begun
                row = self._training_row(metrics)
                out_of_time = 0 < self.r.max_minutes * 60 <= self.wall
                interrupted = stop.is_set  # read once: a Ctrl-C from here on ends the next round, not this one half-saved
                last = steps >= self.iterations * per or out_of_time or interrupted
                evaluation = {}
                if steps >= wait["eval"] or last:
                    self.last_eval = evaluation = self.evaluate(self.learner.on_one_device(state))
                    wait["eval"] += self.eval_every
                    self.wall = time.perf_counter() - begun
                    if self.seconds_to_95 is None and evaluation["success_rate"] >= 0.95:
                        self.seconds_to_95, self.steps_to_95 = round(self.wall, 1), steps
                self._log(steps, row, evaluation)
                if steps >= wait["save"] or last:
                    wait["save"] += self.save_every
                    name = f"{steps:012d}.safetensors"
                    checkpoint.save(self.folder.path / "checkpoints" / name, state, {**self.meta, "kind": "checkpoint"})
                bar.update(task, completed=steps - start, total=self.iterations * per - start, **self._shown(row))
                if interrupted:
                    return state, "interrupted"
                if out_of_time:
                    return state, "time limit"
        return state, "finished"

    def _training_row(self, metrics: dict[str, float]) -> dict[str, float]:
        """Means of a chunk: sums over an iteration become figures an episode."""
        per, length = self.learner.steps_per_iteration, self.learner.env.unwrapped.episode_length
        episodes = max(metrics["sum/episodes"], 1e-9)
        grasps = max(metrics["sum/grasped"], 1e-9)
        self.nan_count += round(metrics["sum/nan"] * self.chunk)
        self.overflow_count += round(metrics["sum/overflow"] * self.chunk)
        row = {
            "steps_per_s": self.steps_per_s,
            "train/return": metrics["sum/reward"] / per * length,
            "train/time_to_grasp": metrics["sum/grasp_time"] / grasps,
            "nan_count": self.nan_count,
            "overflow_count": self.overflow_count,
        }
        row |= {
            f"train/{name}": metrics[f"sum/{name}"] / episodes for name in ("success", "grasped", "dropped", "final_distance")
        }
        prefix = "sum/reward/"
        row |= {f"reward/{k.removeprefix(prefix)}": v / per * length for k, v in metrics.items() if k.startswith(prefix)}
        return row | {f"ppo/{k}": v for k, v in metrics.items() if not k.startswith("sum/")}

    def _log(self, steps: int, row: dict[str, float], evaluation: dict[str, Any]) -> None:
        shown = {f"eval/{k}": v for k, v in evaluation.items() if isinstance(v, float | int)}
        self.folder.log({"steps": steps, "wall_s": round(self.wall, 3), **row, **shown})
        if evaluation and not self.console.is_terminal:
            text = f"{steps:>12,} steps {self.wall:7.1f} s  return {evaluation['return_mean']:8.2f}"
            self.console.print(f"{text}  success {evaluation['success_rate']:.3f}", highlight=False)

    def _shown(self, row: dict[str, float]) -> dict[str, str]:
        return {
            "sps": f"{self.steps_per_s:,.0f}",
            "ret": f"{row['train/return']:.1f}",
            "suc": f"{self.last_eval['success_rate']:.2f}",
        }

    @contextlib.contextmanager
    def _progress(self):
        columns = (
            BarColumn(bar_width=24),
            TextColumn("{task.completed:,.0f}/{task.total:,.0f} steps"),
            TextColumn("{task.fields[sps]} steps/s  return {task.fields[ret]}  success {task.fields[suc]}  ETA"),
            TimeRemainingColumn(),
        )
        with Progress(*columns, console=self.console, disable=not self.console.is_terminal) as bar:
            yield bar, bar.add_task("", sps="-", ret="-", suc="-")


@contextlib.contextmanager
def _threads():
    """An executor that does not keep an error or Ctrl-C waiting for the others' ends."""
    pool = concurrent.futures.ThreadPoolExecutor()
    try:
        yield pool
    finally:
        pool.shutdown(wait=False, cancel_futures=True)


class _Stop:
    is_set = False


@contextlib.contextmanager
def _stop_on_ctrl_c(console: Console):
    """The first Ctrl-C sets a flag, so that the chunk in flight ends whole; the second interrupts."""
    stop = _Stop()

    def handle(*_):
        if stop.is_set:
            raise KeyboardInterrupt
        stop.is_set = True
        console.print("stopping after this update (Ctrl-C again: at once) ...")

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)


def _act(learner: Learner) -> rollout.Act:
    """The learner's deterministic policy, as the runners take it."""
    return lambda params, obs, _: policy.make_act(learner.networks, params)(obs)


class Evaluator:
    """Deterministic policy, no observation noise, episodes that training never saw; in MuJoCo's C library unless on Warp."""

    def __init__(self, run: RunCfg, learner: Learner):
        impl = "warp" if learner.env.unwrapped.impl == "warp" else "native"
        env = ManipulationEnv(dataclasses.replace(run.env, corruption=False), impl=impl, num_envs=run.eval_episodes)
        self._seed, self._runner = run.seed, rollout.runner(env, _act(learner), run.eval_episodes)

    def compiler(self, state: TrainState) -> Callable[[], None]:
        """See ``rollout.Runner.compiler``."""
        return self._runner.compiler((state.normalizer, state.params))

    def __call__(self, state: TrainState) -> dict[str, Any]:
        return self._runner((state.normalizer, state.params), self._seed).summary()


def _initial_state(learner: Learner, seed: int, source: pathlib.Path | None) -> TrainState:
    """A fresh state, or that of a checkpoint; of a policy file, its networks alone."""
    init = jax.jit(learner.init)
    key = jax.random.PRNGKey(seed)
    if source is None:
        return learner.place(init(key))
    if checkpoint.load_meta(source).get("kind") == "checkpoint":
        return learner.place(checkpoint.load(source, jax.eval_shape(learner.init, key)))
    fresh = init(key)
    normalizer, params = checkpoint.load(source, (fresh.normalizer, fresh.params))
    return learner.place(fresh.replace(normalizer=normalizer, params=params))


def _checkpoint_path(restore: pathlib.Path) -> pathlib.Path:
    """The newest checkpoint of a run folder, or the file itself."""
    if restore.is_dir():
        found = sorted((restore / "checkpoints").glob("*.safetensors"))
        if not found:
            raise UserError(f"{restore} holds no checkpoint to restore: give a run folder or a .safetensors file")
        return found[-1]
    checkpoint.load_meta(restore)
    return restore


def _video(env: ManipulationEnv, run: RunCfg, state: TrainState, learner: Learner, path: pathlib.Path, console: Console) -> None:
    """Three episodes of the trained policy, played in MuJoCo C."""
    play_env = ManipulationEnv(dataclasses.replace(run.env, corruption=False), impl="native")
    played = rollout.runner(play_env, _act(learner), 3, record=3)((state.normalizer, state.params), run.seed)
    try:
        render.write_episodes(path, env.mj_model, played.qpos, played.goals, env.dt)
    except UserError as error:
        console.print(str(error), highlight=False, soft_wrap=True)


def command_line(argv: list[str]) -> str:
    """The user's command without --restore and --out, to show how to go on."""
    kept, skip = [], False
    for word in argv:
        if skip:
            skip = False
        elif word in ("--restore", "--out"):
            skip = True
        elif not word.startswith(("--restore=", "--out=")):
            kept.append(word)
    return shlex.join(["python", "train.py", *kept])


def resolve(
    env: str, preset: str, robot: str | None, env_fields: dict[str, Any], ppo_fields: dict[str, Any], **rest: Any
) -> RunCfg:
    """A run's config from names and dotted fields.

    Args:
        robot: another than the environment's own, by name or folder.

    Raises:
        UserError: unknown names or fields, wrong types.
    """
    cfg = registry.env_cfg(env, preset, robot, **env_fields)
    return RunCfg(env_name=env, preset=preset, env=cfg, ppo=config.override(learner_cfg(cfg, preset), ppo_fields), **rest)


def learner_cfg(cfg: EnvCfg, preset: str) -> PpoCfg:
    """The hyperparameters that go with a preset, and those that the task asks for."""
    return config.override(PRESETS.get(preset, PpoCfg()), cfg.training)
