"""Several runs at the same moment, each a process of its own."""

import json
import subprocess

import kill_many
import pytest

SEEDS = 3


@pytest.mark.slow
def test_seeds_of_the_same_second(tmp_path):
    """``for s in 0 1 2; do python train.py --seed $s & done``: as many good runs, each in a folder of its own."""
    argv = [kill_many.sys.executable, "-c", kill_many.KINEMATIC + kill_many.MAIN, "--env", "nero_reach", "--impl", "native"]
    argv += ["--num-timesteps", "640", *kill_many.SIZES]
    env = kill_many.surroundings() | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path / "cache")}  # shared, and empty
    runs = [
        subprocess.Popen([*argv, "--seed", str(seed)], cwd=tmp_path, env=env, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
        for seed in range(SEEDS)
    ]
    for run in runs:
        said, _ = run.communicate(timeout=900)
        assert run.returncode == 0, said.decode()
    folders = list((tmp_path / "runs").iterdir())
    seeds = sorted(json.loads((folder / "config.json").read_text())["seed"] for folder in folders)
    assert seeds == list(range(SEEDS))
    policies = set()
    for folder in folders:
        assert json.loads((folder / "summary.json").read_text())["env_steps"] == 640
        policies.add((folder / "policy.safetensors").read_bytes())
    assert len(policies) == SEEDS
