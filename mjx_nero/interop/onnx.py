"""Converts a policy to ONNX: normalization and network as a graph, and everything a runtime needs about the robot as metadata."""

import inspect
import json
import re
import time
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_nero.config.bounds import unwrapped
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.interop import description, need
from mjx_nero.interop.graph import Graph
from mjx_nero.learn import learner
from mjx_nero.learn.machines import versions
from mjx_nero.learn.policy import Policy
from mjx_nero.sim import team
from mjx_nero.types import UserError

OPSET = 17  # from 2021, which embedded runtimes also support
IR_VERSION = 8  # belongs to that opset


def model(policy: Policy, env: ManipulationEnv) -> Any:
    """Converts a policy to an ``onnx.ModelProto``: ``observations`` [n, state] -> ``actions`` [n, action_size], deterministic.

    A policy with cameras also has the inputs ``picture_<camera>`` [n, height, width, channels].

    Args:
        env: the policy's environment, whose robot and terms the metadata describe.

    Raises:
        UserError: the extra ``onnx`` is not installed, or the policy's observation terms stay apart.
    """
    onnx = need("onnx")
    if isinstance(policy.meta["observation_size"]["state"], dict):
        raise UserError(
            "only a policy that reads one vector can be exported, and this one's terms stay apart: train another preset"
        )
    helper, floats = onnx.helper, onnx.TensorProto.FLOAT
    drawn, own = Graph(onnx), _own(policy.meta)
    seen = own.pictures(policy.meta) if own else {}
    (own.build if own else _build)(policy, drawn)
    (size,) = policy.meta["observation_size"]["state"]
    inputs = [helper.make_tensor_value_info("observations", floats, ["n", size])]
    for name, (shape, whole) in seen.items():
        inputs.append(helper.make_tensor_value_info(name, onnx.TensorProto.UINT8 if whole else floats, ["n", *shape]))
    outputs = [helper.make_tensor_value_info("actions", floats, ["n", policy.meta["action_size"]])]
    graph = helper.make_graph(drawn.nodes, f"{policy.meta['env']} policy", inputs, outputs, drawn.weights)
    made = helper.make_model(
        graph, producer_name="mjx_nero", opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION
    )
    helper.set_model_props(made, {name: json.dumps(value) for name, value in metadata(policy, env).items()})
    onnx.checker.check_model(made)
    return made


def _own(meta: Mapping[str, Any]) -> Any:
    """Returns the module that builds the graphs of a learner's policies; None: they are PPO's layers."""
    return learner.find(meta.get("learner", "ppo")).graph


def _build(policy: Policy, graph: Graph) -> None:
    """Adds normalization, then the layers."""
    network, x = policy.meta["network"], graph.normalized(policy.params[0])
    if bound := network.get("max_observation"):
        x = graph.apply("Clip", x, graph.constant("least", -bound), graph.constant("most", bound))
    *hidden, last = _layers(policy.params[1].policy["params"])
    for i, (kernel, bias) in enumerate(hidden):
        x = graph.apply("Gemm", x, graph.constant(f"kernel_{i}", kernel), graph.constant(f"bias_{i}", bias))
        # ONNX has no operator for swish, x * sigmoid(x), before opset 24.
        swish = network["activation"] == "swish"
        x = graph.apply("Mul", x, graph.apply("Sigmoid", x)) if swish else graph.apply(_OPS[network["activation"]], x)
    n = policy.meta["action_size"]  # further outputs of the last layer are the deviation of tanh_normal
    x = graph.apply("Gemm", x, graph.constant("kernel_out", last[0][:, :n]), graph.constant("bias_out", last[1][:n]))
    graph.apply("Tanh" if network["distribution"] == "tanh_normal" else "Identity", x)
    graph.name_output("actions")


_OPS = {"elu": "Elu", "relu": "Relu", "tanh": "Tanh"}


def _layers(params: dict[str, Any]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yields (kernel, bias) of each layer, from input to output."""
    hidden = params.get("MLP_0", params)  # with a separate deviation the network is nested
    dense = [hidden[name] for name in sorted(hidden, key=lambda name: int(name.rpartition("_")[2]))]
    for layer in dense + ([params["Dense_0"]] if "Dense_0" in params else []):
        yield np.asarray(layer["kernel"]), np.asarray(layer["bias"])


def metadata(policy: Policy, env: ManipulationEnv) -> dict[str, Any]:
    """Collects everything that a runtime needs besides the graph; docs/guides/deploy_onnx.md explains every field."""
    team.alone(env.cfg.scene.robots, "an exported policy")
    robot, own = env.cfg.robot, _own(policy.meta)
    return {
        "env": policy.meta["env"],
        "preset": policy.meta["preset"],
        "robot": robot.name,
        "robot_fingerprint": policy.meta.get("fingerprint"),
        "control_dt": env.dt,
        "physics_dt": env.cfg.sim.dt,
        **description.robot(robot),
        "command": {"term": env.cfg.command.name, **_plain(env.cfg.command.params)},
        "objects": {name: list(item.size) for name, item in env.cfg.scene.objects.items()},
        "observations": _observations(env),
        "cameras": own.cameras(policy.meta, env.cfg) if own else {},
        "actions": env.actions.describe(),
        "action_clip": env.cfg.action_clip or None,
        "versions": versions(),
        "env_steps": policy.meta.get("env_steps"),
    }


def _observations(env: ManipulationEnv) -> list[dict[str, Any]]:
    """Describes the terms of the group ``state``, in the order of the input."""
    sizes = jax.eval_shape(lambda key: env.named_observations(env.reset(key))["state"], jax.random.PRNGKey(0))
    terms, out, start = env.cfg.observations["state"].terms, [], 0
    for name, term in terms.items():
        says = (inspect.getdoc(unwrapped(term.func)) or "").partition("\n")[0]
        size = int(np.prod(sizes[name].shape)) * term.history
        unit = re.search(r"\[(.+?)\]", says)
        late = {"history": term.history, "delay_steps": list(term.delay)}
        term_of = {"term": term.name, "params": _plain(term.params)}
        out.append({"name": name, "start": start, "size": size, "units": unit and unit[1], "what": says, **term_of, **late})
        start += size
    return out


def _plain(params: Mapping[str, Any]) -> dict[str, Any]:
    """Converts a term's parameters to JSON; values of other types become text."""
    return json.loads(json.dumps(dict(params), default=str))


def tries(meta: Mapping[str, Any]) -> int:
    """Returns the number of observations of a check, which is smaller with pictures."""
    own = _own(meta)
    return own.TRIES if own else 10_000


def check(made: Any, policy: Policy, observations: int = 0) -> tuple[float, float]:
    """Runs the model with ONNX Runtime on one core, on observations drawn from the normalizer's statistics.

    Returns:
        the largest difference to JAX, and the 99th percentile of the core's time for one observation [s].

    Raises:
        UserError: the extra ``onnx`` is not installed.
    """
    runtime, observations = need("onnxruntime"), observations or tries(policy.meta)
    options = runtime.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    session = runtime.InferenceSession(made.SerializeToString(), options, providers=["CPUExecutionProvider"])
    normalizer, rng = policy.params[0], np.random.default_rng(0)
    mean, std = np.asarray(normalizer.mean["state"]), np.asarray(normalizer.std["state"])
    obs = (mean + std * rng.standard_normal((observations, len(mean)))).astype(np.float32)
    own = _own(policy.meta)
    seen, act = (own.random_pictures(policy.meta, observations, rng), own.exact(policy)) if own else ({}, policy.act)
    given: dict[str, Any] = {"state": jnp.asarray(obs), "pictures": {k.removeprefix("picture_"): v for k, v in seen.items()}}
    ours = np.asarray(act(given))
    theirs, times = np.empty_like(ours), []
    for i in range(observations):
        started = time.thread_time()
        (theirs[i],) = session.run(None, {name: each[i : i + 1] for name, each in {"observations": obs, **seen}.items()})[0]
        times.append(time.thread_time() - started)
    return float(np.abs(ours - theirs).max()), float(np.percentile(times, 99))
