"""Trains nero_reach with Stable-Baselines3 on the CPU: python examples/stable_baselines3_reach.py [env steps]"""

import sys

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize
from torch.nn import ELU

from mjx_nero.interop.stable_baselines3 import VecEnv

STEPS, NUM_ENVS, ROLLOUT = int(float(sys.argv[1])) if len(sys.argv) > 1 else 1_500_000, 256, 24

envs = VecNormalize(VecMonitor(VecEnv("nero_reach", NUM_ENVS, impl="native")), gamma=0.98)
learner = PPO(
    "MlpPolicy",
    envs,
    n_steps=ROLLOUT,
    batch_size=NUM_ENVS * ROLLOUT // 8,
    n_epochs=4,
    learning_rate=lambda left: 1e-3 * left,
    gamma=0.98,
    ent_coef=0.002,
    policy_kwargs={"net_arch": [64, 64], "activation_fn": ELU},
    device="cpu",
    seed=0,
    verbose=1,
)
learner.learn(STEPS, log_interval=20)

envs.training = False  # the statistics stay as they are
obs, successes = envs.reset(), []
while len(successes) < NUM_ENVS:
    obs, _, dones, infos = envs.step(learner.predict(obs, deterministic=True)[0])
    successes += [infos[i]["is_success"] for i in np.flatnonzero(dones)]
print(f"success rate: {np.mean(successes):.1%} of {len(successes)} episodes")
