"""An exported policy and its scene, made once."""

import mujoco
import onnx
import pytest

import mjx_nero
from mjx_nero.deploy.loop import Brain
from mjx_nero.interop import onnx as export
from mjx_nero.learn import policy
from mjx_nero.sim import scene


@pytest.fixture(scope="session")
def lift(tmp_path_factory):
    """``so101_lift`` in ``sim2real``: a folder with ``policy.onnx`` and ``scene.mjb``."""
    folder = tmp_path_factory.mktemp("lift")
    env = mjx_nero.make("so101_lift", preset="sim2real", impl="native")
    trained = policy.load_for(env, "so101_lift", policy.shipped("so101_lift", "sim2real"))
    onnx.save(export.model(trained, env), str(folder / "policy.onnx"))
    model = scene.build(env.cfg.robot, env.cfg.scene, env.cfg.sim, visuals=False)
    mujoco.mj_saveModel(model, str(folder / "scene.mjb"), None)
    return folder


@pytest.fixture(scope="session")
def told(lift):
    """The policy's metadata."""
    return Brain(lift / "policy.onnx").metadata
