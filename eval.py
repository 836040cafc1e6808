"""Plays and measures a policy: python eval.py --env nero_lift. See --help."""

import pathlib

from mjx_nero import cli, evaluation, registry
from mjx_nero.physics import IMPLS


def main(argv):
    parser = cli.Parser(prog="eval.py", description="Plays episodes with a policy and reports success.")
    parser.add_argument(
        "--env", default="nero_lift", help=f"environment: {', '.join(registry.list_envs())} (default: %(default)s)"
    )
    parser.add_argument("--preset", default="default", help="default or isaac")
    parser.add_argument("--agent", choices=evaluation.AGENTS, default="policy", help="who acts (default: %(default)s)")
    parser.add_argument("--policy", type=pathlib.Path, help="policy file (default: the one that ships for the environment)")
    parser.add_argument("--episodes", type=cli.positive, default=64, help="played side by side (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="random seed (default: %(default)s)")
    parser.add_argument(
        "--backend",
        choices=evaluation.BACKENDS,
        default="auto",
        help="mjx, or mujoco: the C library (default: mjx on a GPU, else mujoco)",
    )
    parser.add_argument(
        "--impl", choices=IMPLS, default="auto", help="MJX physics (default: warp where there is a GPU for it, else jax)"
    )
    parser.add_argument("--video", type=pathlib.Path, help="write an MP4 of up to three of the episodes")
    parser.add_argument("--json", type=pathlib.Path, help="write the result as JSON")
    if "-h" in argv or "--help" in argv:
        parser.epilog = cli.fields_help({"env": registry.env_cfg("nero_lift")})
    args, dotted = parser.parse(argv, prefixes=("env",))
    cli.setup_jax()
    evaluation.evaluate(
        args.env,
        preset=args.preset,
        agent_name=args.agent,
        policy_path=args.policy,
        episodes=args.episodes,
        seed=args.seed,
        backend=args.backend,
        impl=args.impl,
        video=args.video,
        out=args.json,
        overrides=dotted["env"],
    )


if __name__ == "__main__":
    cli.run(main)
