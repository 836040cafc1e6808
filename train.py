"""Trains a policy: python train.py --env nero_lift. See --help."""

import pathlib
import sys

from mjx_nero import cli, registry, training
from mjx_nero.physics import IMPLS


def main(argv):
    parser = cli.Parser(
        prog="train.py", description="Trains a policy with PPO on thousands of environments in one compiled step."
    )
    parser.add_argument(
        "--env", default="nero_lift", help=f"environment: {', '.join(registry.list_envs())} (default: %(default)s)"
    )
    parser.add_argument("--preset", default="default", help="of the environment's presets (default: %(default)s)")
    parser.add_argument("--robot", help="another robot: a name or an imported robot's folder (default: the environment's own)")
    parser.add_argument("--num-envs", type=cli.positive, help="environments (default: 8192 on a GPU, 256 on a CPU)")
    parser.add_argument(
        "--num-devices", type=cli.positive, default=1, help="GPUs to spread the environments over (default: %(default)s)"
    )
    parser.add_argument(
        "--num-timesteps",
        type=cli.positive,
        help="env steps in all (default: on a GPU 100 M to lift, 60 M to reach; on a CPU 10 M and 2 M, in 10 minutes at most)",
    )
    parser.add_argument("--seed", type=int, default=0, help="random seed (default: %(default)s)")
    parser.add_argument(
        "--impl",
        choices=IMPLS,
        default="auto",
        help="physics (default: the first of warp, jax and native that suits the machine)",
    )
    parser.add_argument("--out", type=pathlib.Path, help="run folder (default: runs/<env>_<time>)")
    parser.add_argument("--restore", type=pathlib.Path, help="run folder or checkpoint to go on from, or a policy to start from")
    parser.add_argument("--eval-every", type=cli.positive, default=0, help="env steps between evaluations (default: 12 a run)")
    parser.add_argument(
        "--checkpoint-every", type=cli.positive, default=0, help="env steps between checkpoints (default: 5 a run)"
    )
    parser.add_argument(
        "--max-minutes", type=float, default=0.0, help="stop after so many minutes of training (default: no limit)"
    )
    parser.add_argument("--no-video", dest="video", action="store_false", help="do not render the trained policy")
    if "-h" in argv or "--help" in argv:
        chosen, _ = parser.parse([a for a in argv if a not in ("-h", "--help")], prefixes=("env", "ppo"))
        cfg = registry.env_cfg(chosen.env, chosen.preset, chosen.robot)
        parser.epilog = cli.fields_help({"env": cfg, "ppo": training.learner_cfg(cfg, chosen.preset)})
    args, dotted = parser.parse(argv, prefixes=("env", "ppo"))
    sizes = {k: v for k, v in (("num_envs", args.num_envs), ("num_timesteps", args.num_timesteps)) if v}
    run = training.resolve(
        args.env,
        args.preset,
        args.robot,
        dotted["env"],
        {**sizes, **dotted["ppo"]},
        impl=args.impl,
        seed=args.seed,
        out=args.out,
        restore=args.restore,
        eval_every=args.eval_every,
        checkpoint_every=args.checkpoint_every,
        max_minutes=args.max_minutes,
        video=args.video,
        num_devices=args.num_devices,
    )
    cli.setup_jax()
    summary = training.train(run, command=training.command_line(argv))
    result = summary["evaluation"]
    pace = f"{summary['env_steps']:,} env steps in {summary['train_s']:.0f} s ({summary['steps_per_s']:,} steps/s)"
    print(f"{pace}, success {result['success_rate']:.1%}")
    print(f"{summary['folder']}: policy.safetensors, curve.png, metrics.jsonl, checkpoints/")
    if summary["nan_count"] or summary["overflow_count"]:
        print(
            f"physics: {summary['nan_count']} environments reset after NaN, {summary['overflow_count']} steps with lost contacts"
        )
    if summary["stopped"] == "interrupted":
        sys.exit(130)


if __name__ == "__main__":
    cli.run(main)
