"""The command ``export``: writes a policy as ONNX, for machines without this package."""

from collections.abc import Sequence

from mjx_nero import config, files
from mjx_nero.interop import need
from mjx_nero.learn import bundled
from mjx_nero.tasks import registry
from mjx_nero.tools import cli
from mjx_nero.types import UserError

TOLERANCE = 1e-5  # of actions: joint targets then agree to microradians


def main(argv: Sequence[str]) -> None:
    """The command line.

    Raises:
        UserError: the policy does not exist, an argument is wrong, or the file cannot be written.
    """
    parser = cli.Parser(
        "export", "Writes a policy as ONNX: normalization and network as a graph; joints, terms, limits and rates as metadata."
    )
    parser.add_load()
    parser.add_argument("policy", help=f"policy file, or name of a bundled policy ({', '.join(bundled.names())})")
    parser.add_argument("--out", type=cli.output(".onnx"), required=True, metavar="FILE", help="ONNX file to write")
    parser.add_argument("--robot", help="folder of the imported robot that the policy was trained with")
    args, dotted = parser.parse(argv, prefixes=("env",))
    from mjx_nero.envs.env import ManipulationEnv  # with Brax and MJX, which help does without
    from mjx_nero.interop import onnx
    from mjx_nero.learn import policy

    onnx_package = need("onnx")
    cli.setup_jax()
    path = bundled.find(args.policy)
    meta = policy.load(path).meta
    env = ManipulationEnv(config.override(registry.env_cfg(meta["env"], meta["preset"], args.robot), dotted["env"]))
    trained = policy.load_for(env, meta["env"], path)
    made = onnx.model(trained, env)
    difference, p99 = onnx.check(made, trained)
    if difference > TOLERANCE:
        raise UserError(f"ONNX Runtime and JAX differ by {difference:.1e} on {path}: nothing was written; please report this")
    with files.whole(args.out) as part:
        onnx_package.save(made, str(part))
    print(
        f"{args.out}: {meta['env']}, {made.graph.input[0].type.tensor_type.shape.dim[1].dim_value} observations -> "
        f"{meta['action_size']} actions every {1000 * env.dt:.0f} ms\n"
        f"ONNX Runtime and JAX differ by at most {difference:.1e} over {onnx.tries(meta):,} observations; "
        f"{1000 * p99:.3f} ms per observation on one core (99th percentile)"
    )
