"""The plug-in for LeRobot, where LeRobot is: see ``lerobots``."""

import importlib.util
import json
import os
import pathlib
import subprocess

import mujoco
import numpy as np
import pytest
from lerobots import lerobot_python

from mjx_nero.sim import render
from mjx_nero.types import UserError

HERE = pathlib.Path(__file__).parent


@pytest.mark.slow
def test_lerobot_makes_and_steps_an_environment():
    python, root = lerobot_python(), HERE.parents[1]
    if not python:
        pytest.skip("lerobot is not installed: name a Python that has it in MJX_NERO_LEROBOT_PYTHON")
    paths = os.pathsep.join(map(str, (root, root / "plugins" / "lerobot_env_mjx_nero")))
    usual = {name: value for name, value in os.environ.items() if name != "XLA_FLAGS"}  # for this Python's JAX
    env = {**usual, "PYTHONPATH": paths, "JAX_PLATFORMS": "cpu"}
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
    seen = {"observation.state": [9], "observation.environment_state": [7]}  # who sees is told the goal alone
    seen |= {f"observation.images.{name}": [3, 32, 32] for name in ("front", "wrist")}
    assert told["asked"] == {"action": [9], **seen}
    assert told["pictures"] == {name: [1, *shape] for name, shape in seen.items()}


def test_an_evaluation_is_filmed_without_opengl(monkeypatch):
    """``lerobot-eval`` films every evaluation: without OpenGL it gets what the first camera sees, or one line."""
    path = HERE.parents[1] / "plugins" / "lerobot_env_mjx_nero" / "lerobot_env_mjx_nero" / "env.py"
    spec = importlib.util.spec_from_file_location("plugin_env", path)
    plugin = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(plugin)

    asked = []

    class Absent:
        def __init__(self, *_):
            asked.append(1)
            raise ImportError("no GL")

    env = plugin.Env("nero_reach", cameras="front+side", size=(24, 16))
    seen, _ = env.reset(seed=1)
    (picture,) = seen["pixels"].values()
    assert env.render().shape == (480, 640, 3)
    env.close()
    monkeypatch.setattr(render, "_lost", False)
    monkeypatch.setattr(mujoco, "Renderer", Absent)
    np.testing.assert_array_equal(env.render(), picture)
    assert picture.shape == (16, 48, 3) and picture.std() > 5
    seen, *_ = env.step(env.action_space.sample())
    np.testing.assert_array_equal(env.render(), next(iter(seen["pixels"].values())))
    assert len(asked) == 1  # not for each frame
    blind = plugin.Env("nero_reach")
    blind.reset(seed=1)
    with pytest.raises(UserError, match="no offscreen OpenGL"):
        blind.render()
