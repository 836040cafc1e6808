"""The plug-in for LeRobot, where LeRobot is: see ``lerobots``."""

import json
import os
import pathlib
import subprocess

import pytest
from lerobots import lerobot_python

HERE = pathlib.Path(__file__).parent


@pytest.mark.slow
def test_lerobot_makes_and_steps_an_environment():
    python, root = lerobot_python(), HERE.parents[1]
    if not python:
        pytest.skip("lerobot is not installed: name a Python that has it in MJX_NERO_LEROBOT_PYTHON")
    paths = os.pathsep.join(map(str, (root, root / "plugins" / "lerobot_env_mjx_nero")))
    env = {**os.environ, "PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"}
    done = subprocess.run([python, HERE / "plugin_check.py"], capture_output=True, text=True, env=env)
    if "No module named 'jax'" in done.stderr:
        pytest.skip("lerobot's Python lacks what this package needs: pip install -e '.[demos,gym]' there")
    assert done.returncode == 0, done.stderr[-2000:]
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["fps"] == 50 and told["steps"] == 250 and told["success"] == [False, False]
    assert 0 < told["moved"] < 0.3  # the arm sinks by its weight [rad]
    shapes = {"observation.state": [9], "observation.environment_state": [21]}
    assert told["features"] == {"action": [9], **shapes}
    assert told["shapes"] == {name: [2, *shape] for name, shape in shapes.items()}
