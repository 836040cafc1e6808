"""Trains a policy: python train.py --env nero_lift. See --help."""

import argparse
from collections.abc import Sequence

from mjx_nero.envs.task import EnvCfg
from mjx_nero.learn import learner
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.tasks import registry
from mjx_nero.tools import cli, config_help


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = _parser()
    args, dotted = parser.parse(argv, lambda: ("env", *learner.names()), _fields)
    from mjx_nero.learn import machines  # not needed for help

    cli.setup_jax()
    machines.join()  # before a task's config is made, which computes
    args.learner = _learner(args, registry.env_cfg(args.env, args.preset, args.robot))
    parser.only(dotted, learner.names(), args.learner)
    from mjx_nero.tools import train_run  # imports Brax, which help does not need

    train_run.start(args, dotted, parser.given(argv))


def _fields(args: argparse.Namespace) -> str:
    """Lists the config fields for ``--help``."""
    cfg = registry.env_cfg(args.env, args.preset, args.robot)
    name = _learner(args, cfg)
    return config_help.listed({"env": cfg, name: learner.cfg_for(name, args.preset, cfg.training)})


def _learner(args: argparse.Namespace, cfg: EnvCfg) -> str:
    """Returns the learner that the user named, or else the task's own."""
    return args.learner or cfg.learner


def _parser() -> cli.Parser:
    parser = cli.Parser("train", "Trains a policy in thousands of environments, which run in one compiled program.")
    parser.add_environment()
    parser.add_argument("--learner", help=f"one of {', '.join(learner.names())} (default: the task's own)")
    parser.add_argument("--num-envs", type=cli.positive, help="number of environments (default: 8192 on a GPU, 256 on a CPU)")
    parser.add_argument(
        "--num-timesteps",
        type=cli.positive,
        help="total env steps (default: env.budget.steps; on a CPU env.budget.steps_on_cpu, and at most 10 minutes)",
    )
    parser.add_seed(0, several=True)
    parser.add_impl()
    parser.add_fields(RunCfg)
    parser.add_argument(
        "--trust",
        action="store_true",
        help="with --restore: trust the run, and read files outside its folder that its config names",
    )
    parser.add_argument("--resume", choices=("auto",), help="resume the run in --out, or start it if there is none")
    parser.add_argument("--no-video", dest="video", action="store_false", help="write no video of the trained policy")
    parser.add_video()
    return parser
