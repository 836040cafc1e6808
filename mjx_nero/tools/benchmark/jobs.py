"""The measurements to run, and their rows."""

import argparse
import dataclasses
import functools
import gc
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence

from mjx_nero import config
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.envs.task import EnvCfg, for_controllers
from mjx_nero.learn import device_memory
from mjx_nero.runs import cfg as run_cfg
from mjx_nero.runs import compiled, evaluation
from mjx_nero.runs.evaluation_cfg import expert_of
from mjx_nero.sim.physics import impls, resolve_impl
from mjx_nero.tools import cli
from mjx_nero.tools.benchmark import SIZES, drawing, inverse_kinematics, learning, start, throughput
from mjx_nero.tools.benchmark.program import Row


@dataclasses.dataclass(frozen=True)
class Job:
    """One measurement. ``size`` is its number of environments; 0: it has no size."""

    what: str
    impl: str
    size: int
    rows: Callable[[], Iterable[Row]]

    def failed(self, note: str) -> Row:
        row: Row = {"what": self.what, "impl": self.impl}
        return row | ({"num_envs": self.size} if self.size else {}) | {"note": note}


def jobs(
    args: argparse.Namespace,
    cfg: EnvCfg,
    hyperparameters: Mapping[str, str],
    whats: list[str],
    argv: Sequence[str],
    kept: Sequence[Row] = (),
) -> list[Job]:
    """Returns all measurements, in order. Builds everything they need except compiled code, so that mistakes show up here.

    Args:
        kept: rows of the seeds that an interrupted command finished.
    """

    def make_run(cfg: EnvCfg, impl: str, num_envs: int) -> run_cfg.RunCfg:
        return run_cfg.fit_machine(run_of(args, hyperparameters, cfg, impl, num_envs))[0]

    found = []
    for impl in dict.fromkeys(resolve_impl(impl) for impl in cli.choices(args.impl, "impl", impls())):
        for what in whats:
            if what == "learning":
                for n in args.num_envs or [0]:
                    run = make_run(cfg, impl, n)
                    own = [row for row in kept if (row["impl"], row["num_envs"]) == (impl, run.num_envs)]
                    rows = functools.partial(learning.measure_learning, run, args.seeds, args.target, own)
                    compiled.make_learner(run)
                    found.append(Job(what, impl, run.num_envs, rows))
            elif what == "start":
                run = make_run(cfg, impl, (args.num_envs or [0])[0])
                compiled.make_learner(run)
                found.append(Job(what, impl, run.num_envs, functools.partial(start.measure_start, [*argv, "--impl", impl], run)))
            elif what not in ("ik", "render"):
                task = for_controllers(cfg) if what == "control" else cfg
                sizes = args.num_envs or SIZES
                found += [_throughput(what, ManipulationEnv(task, impl, n), args, make_run) for n in sizes]
    if "render" in whats:
        env = ManipulationEnv(cfg)
        found.append(Job("render", "", 0, lambda: [drawing.measure_render(env, min(20, args.steps), args.repeats)]))
    if "ik" in whats:
        found.append(Job("ik", "", 0, lambda: inverse_kinematics.measure_ik(cfg.robot, args.batch, args.repeats)))
    return found


def _throughput(what: str, env: ManipulationEnv, args: argparse.Namespace, make_run: Callable[..., run_cfg.RunCfg]) -> Job:
    make: Callable[[], throughput.Program]
    about: Row = {}
    if what == "ppo":
        run = make_run(env.cfg, env.impl, env.num_envs)
        learner = compiled.make_learner(run)
        iterations = max(1, args.steps * env.num_envs // learner.steps_per_iteration)
        make = functools.partial(throughput.training, learner, iterations)
        about = {"learner": args.learner} if args.learner != "ppo" else {}
    elif what == "control":
        name = expert_of(env.cfg.controllers)
        make = functools.partial(throughput.controlled, env, evaluation.controller(name, env, args.env))
        about = {"controller": name}
    else:
        measured = {"physics": throughput.physics, "step": throughput.step, "reset": throughput.reset}[what]
        make = functools.partial(measured, env, args.steps)
    return Job(what, env.impl, env.num_envs, lambda: [throughput.measure(what, env, make, args.repeats) | about])


def run_of(args: argparse.Namespace, asked: Mapping[str, str], cfg: EnvCfg, impl: str, num_envs: int) -> run_cfg.RunCfg:
    """Returns the run that a measurement with these flags starts. JAX is not used yet."""
    sizes = {"num_envs": num_envs, "num_timesteps": args.num_timesteps}
    fields = {**asked, **{name: value for name, value in sizes.items() if value}}
    learner = config.override(run_cfg.learner_cfg(cfg, args.preset, args.learner), fields)
    how = {"impl": impl, "eval_every": args.eval_every, "num_devices": args.num_devices, "learner": args.learner}
    return run_cfg.RunCfg(args.env, args.preset, cfg, learner, **how)


def measured(jobs: Iterable[Job]) -> Iterator[Row]:
    """Yields the rows of all jobs. If memory runs out, a row says so, and larger sizes of the same measurement are skipped."""
    full: dict[tuple[str, str], int] = {}
    for job in jobs:
        limit = full.get((job.what, job.impl))
        if limit is not None and job.size >= limit:
            yield job.failed(f"not run: out of memory at {limit:,}")
            continue
        try:
            yield from job.rows()
            continue
        except (MemoryError, RuntimeError) as error:
            if not (isinstance(error, MemoryError) or device_memory.says_so(error)):
                raise
            message = (str(error) or type(error).__name__).splitlines()[0]
        full[job.what, job.impl] = job.size
        gc.collect()  # the traceback held the arrays
        yield job.failed(f"out of memory: {message}")
