"""Plays and measures a policy or a controller: python eval.py --env nero_lift. See --help."""

import pathlib

from mjx_nero import cli, control, evaluation, registry
from mjx_nero.physics import IMPLS


def main(argv):
    parser = cli.Parser(prog="eval.py", description="Plays episodes with a policy or a controller and reports success.")
    parser.add_argument(
        "--env", default="nero_lift", help=f"environment: {', '.join(registry.list_envs())} (default: %(default)s)"
    )
    parser.add_argument("--preset", default="default", help="of the environment's presets (default: %(default)s)")
    parser.add_argument("--robot", help="another robot: a name or an imported robot's folder (default: the environment's own)")
    parser.add_argument("--agent", choices=evaluation.AGENTS, help="who acts (default: the task's controller, else the policy)")
    parser.add_argument("--controller", choices=tuple(control.CONTROLLERS), help="a controller instead of an agent")
    parser.add_argument("--policy", type=pathlib.Path, help="policy file (default: the one that ships for the environment)")
    parser.add_argument("--episodes", type=cli.positive, default=64, help="played side by side (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="random seed (default: %(default)s)")
    parser.add_argument(
        "--backend",
        choices=evaluation.BACKENDS,
        default="auto",
        help="mjx, or mujoco: the C library (default: what --impl says)",
    )
    parser.add_argument(
        "--impl",
        choices=IMPLS,
        default="auto",
        help="physics: warp or jax, which are MJX, or native, MuJoCo's C library (default: warp on a GPU, native without one)",
    )
    parser.add_argument("--video", type=pathlib.Path, help="write an MP4 of up to three of the episodes")
    parser.add_argument("--json", type=pathlib.Path, help="write the result as JSON")
    if "-h" in argv or "--help" in argv:
        chosen, _ = parser.parse([a for a in argv if a not in ("-h", "--help")], prefixes=("env", "control"))
        parser.epilog = cli.fields_help(
            {"env": registry.env_cfg(chosen.env, chosen.preset, chosen.robot)}
            | ({"control": control.CONTROLLERS[chosen.controller][1]} if chosen.controller else {})
        )
    args, dotted = parser.parse(argv, prefixes=("env", "control"))
    cli.setup_jax()
    evaluation.evaluate(
        args.env,
        preset=args.preset,
        robot=args.robot,
        agent_name=args.agent,
        policy_path=args.policy,
        episodes=args.episodes,
        seed=args.seed,
        backend=args.backend,
        impl=args.impl,
        video=args.video,
        out=args.json,
        overrides=dotted["env"],
        controller_name=args.controller,
        control_overrides=dotted["control"],
    )


if __name__ == "__main__":
    cli.run(main)
