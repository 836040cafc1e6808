"""Trains a policy: python train.py --env nero_lift. See --help."""

import argparse
from collections.abc import Sequence
from typing import Any

from mjx_nero import cli
from mjx_nero.envs import registry
from mjx_nero.learn import learner


def main(argv: Sequence[str]) -> None:
    """The command line."""
    parser = _parser()
    args, dotted = parser.parse(argv, lambda: ("env", *learner.names()), _cfgs)
    parser.only(dotted, learner.names(), args.learner)
    from mjx_nero.tools import train_run  # with Brax, which help does without

    train_run.start(args, dotted, parser.given(argv))


def _cfgs(args: argparse.Namespace) -> dict[str, Any]:
    """What ``--help`` lists the fields of."""
    cfg = registry.env_cfg(args.env, args.preset, args.robot)
    return {"env": cfg, args.learner: learner.cfg_for(args.learner, args.preset, cfg.training)}


def _parser() -> cli.Parser:
    parser = cli.Parser(
        prog=cli.called_as("train"), description="Trains a policy on thousands of environments in one compiled step."
    )
    parser.add_environment(registry.list_envs())
    parser.add_argument("--learner", default="ppo", help=f"one of {', '.join(learner.names())} (default: %(default)s)")
    parser.add_argument("--num-envs", type=cli.positive, help="environments (default: 8192 on a GPU, 256 on a CPU)")
    parser.add_argument(
        "--num-devices", type=cli.positive, default=1, help="GPUs to spread the environments over (default: %(default)s)"
    )
    parser.add_argument(
        "--num-timesteps",
        type=cli.positive,
        help="env steps in all (default: on a GPU 100 M to lift, 60 M to reach; on a CPU 10 M and 2 M, in 10 minutes at most)",
    )
    parser.add_seed(0, several=True)
    parser.add_impl()
    parser.add_argument("--out", type=cli.path(), help="run folder (default: runs/<env>_<time>)")
    parser.add_argument("--restore", type=cli.path(), help="run folder or checkpoint to go on from, or a policy to start from")
    parser.add_argument(
        "--trust", action="store_true", help="read files that the config of --restore names outside of that folder"
    )
    parser.add_argument("--resume", choices=("auto",), help="go on with the run in --out, or start it if there is none yet")
    parser.add_argument("--eval-every", type=cli.positive, default=0, help="env steps between evaluations (default: 12 a run)")
    parser.add_argument(
        "--checkpoint-every", type=cli.positive, default=0, help="env steps between checkpoints (default: 5 a run)"
    )
    parser.add_argument(
        "--checkpoint-minutes",
        type=cli.non_negative,
        default=10.0,
        help="the most between checkpoints (default: %(default)s)",
    )
    parser.add_argument(
        "--max-minutes", type=cli.non_negative, default=0.0, help="stop after so many minutes of training (default: no limit)"
    )
    parser.add_argument("--keep", type=cli.positive, default=3, help="checkpoints to keep beside the best (default: %(default)s)")
    parser.add_argument(
        "--on-nan", choices=("stop", "rewind"), default="stop", help="what to do when training diverges (default: %(default)s)"
    )
    parser.add_argument("--track", choices=("wandb",), default="", help="also tell this service how it goes (the extra track)")
    parser.add_argument("--no-video", dest="video", action="store_false", help="do not render the trained policy")
    parser.add_video()
    return parser
