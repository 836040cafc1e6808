"""Steps an environment as LeRobot's commands make it: python plugin_check.py. Needs lerobot, this package and its plug-in.

It prints what there is to see, how far the arm comes where it is told to stay, and whether ends come with their success.
"""

import json

import lerobot_env_mjx_nero
import numpy as np
from lerobot.envs.factory import make_env
from lerobot.envs.utils import env_to_policy_features, preprocess_observation


def main() -> None:
    """Plays two episodes at home."""
    cfg = lerobot_env_mjx_nero.MjxNeroEnv(task="nero_lift")
    envs = make_env(cfg, n_envs=2)["mjx_nero"][0]
    seen, _ = envs.reset(seed=[1, 2])
    again, _ = envs.reset(seed=[1, 2])
    assert all(np.array_equal(seen[name], again[name]) for name in seen)
    home, moved, steps = seen["agent_pos"].copy(), 0.0, 0
    while True:
        last = seen
        seen, _, terminated, truncated, info = envs.step(home)
        steps += 1
        if (terminated | truncated).any():
            break
        moved = max(moved, float(np.abs(seen["agent_pos"] - home).max()))
    features = {name: list(feature.shape) for name, feature in env_to_policy_features(cfg).items()}
    shapes = {name: list(x.shape) for name, x in preprocess_observation(last).items()}
    success = info["final_info"]["is_success"].tolist()
    seeing = lerobot_env_mjx_nero.MjxNeroEnv(task="nero_lift", preset="rgb", cameras="front,wrist", width=32, height=32)
    env = make_env(seeing, n_envs=1)["mjx_nero"][0]
    pictures = {name: list(x.shape) for name, x in preprocess_observation(env.reset(seed=[1])[0]).items()}
    asked = {name: list(feature.shape) for name, feature in env_to_policy_features(seeing).items()}
    print(
        json.dumps(
            {
                "fps": cfg.fps,
                "steps": steps,
                "moved": moved,
                "success": success,
                "features": features,
                "shapes": shapes,
                "pictures": pictures,
                "asked": asked,
            }
        )
    )


if __name__ == "__main__":
    main()
