"""Env steps a second through Gymnasium's vector API, with random actions: python examples/gymnasium_rate.py --arrays torch"""

import argparse
import time

from mjx_nero.interop.gymnasium import ARRAYS, VectorEnv


def main() -> None:
    """Steps in blocks, as a learner would, and waits for the device at the end of each."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--env", default="nero_lift")
    parser.add_argument("--num-envs", type=int, default=8192)
    parser.add_argument("--arrays", choices=ARRAYS, default="jax")
    parser.add_argument("--steps", type=int, default=100)
    args = parser.parse_args()
    envs = VectorEnv(args.env, args.num_envs, arrays=args.arrays)
    envs.reset(seed=0)
    actions, rates = drawn(args.arrays, envs), []
    for _ in range(6):
        begun = time.perf_counter()
        for _ in range(args.steps):
            reward = envs.step(actions())[1]
        float(reward.sum())
        rates.append(args.steps * args.num_envs / (time.perf_counter() - begun))
    low, *_, high = rates = sorted(rates[1:])  # the first compiles
    print(f"{args.num_envs} x {args.env}, {args.arrays}: {rates[2]:,.0f} env steps/s ({low:,.0f} to {high:,.0f})")


def drawn(arrays: str, envs: VectorEnv):
    """Draws actions (standard normal) where the arrays live."""
    shape = envs.action_space.shape
    if arrays == "torch":
        import torch

        device = envs.reset()[0].device
        return lambda: torch.randn(shape, device=device)
    if arrays == "numpy":
        return lambda: envs.np_random.standard_normal(shape, "float32")
    import jax

    keys = iter(jax.random.split(jax.random.PRNGKey(0), 100_000))
    draw = jax.jit(lambda key: jax.random.normal(key, shape))
    return lambda: draw(next(keys))


if __name__ == "__main__":
    main()
