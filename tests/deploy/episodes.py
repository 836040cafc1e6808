"""An exported policy and its scene."""

import mujoco
import onnx

import mjx_nero
from mjx_nero.interop import onnx as export
from mjx_nero.learn import policy
from mjx_nero.sim import scene


def exported(folder, name, preset="sim2real"):
    """Writes ``policy.onnx`` and ``scene.mjb`` of an environment; its config."""
    env = mjx_nero.make(name, preset=preset, impl="native")
    trained = policy.load_for(env, name, policy.shipped(name, preset))
    onnx.save(export.model(trained, env), str(folder / "policy.onnx"))
    mujoco.mj_saveModel(scene.build(env.cfg.robot, env.cfg.scene, env.cfg.sim, visuals=False), str(folder / "scene.mjb"), None)
    return env.cfg
