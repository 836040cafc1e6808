"""Exported policies: what ONNX Runtime makes of them, here and in a program that has numpy and onnxruntime alone."""

import dataclasses
import json
import pathlib
import re
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import onnx
import onnxruntime
import pytest
from flax import struct

import mjx_nero
from mjx_nero import interop
from mjx_nero.interop import onnx as export
from mjx_nero.learn import checkpoint, policy
from mjx_nero.learn.ppo import networks
from mjx_nero.learn.ppo.cfg import ACTIVATIONS, NetworkCfg
from mjx_nero.mdp import actions
from mjx_nero.mdp.terms import Term
from mjx_nero.types import UserError

PAGE = pathlib.Path(__file__).resolve().parents[2] / "docs" / "guides" / "deploy_onnx.md"
# What a robot's computer has not: the program fails if it imports any of these.
ABSENT = ("jax", "brax", "flax", "mujoco", "onnx", "yaml", "lxml")


@struct.dataclass
class Trained:
    """A learner's state, as a checkpoint of PPO names its parts."""

    normalizer: object
    params: object
    iteration: object


def fresh(path, **network):
    """A policy of ``nero_reach`` with drawn weights and statistics, as a file."""
    shipped = policy.load(policy.shipped("nero_reach")).meta
    cfg = NetworkCfg(actor=(32, 16), critic=(8,), **network)
    sizes = {"state": tuple(shipped["observation_size"]["state"])}
    nets = networks.make_networks(sizes, shipped["action_size"], cfg)
    normalizer, params = networks.init_params(nets, sizes, jax.random.PRNGKey(3))
    mean, spread = jax.random.normal(jax.random.PRNGKey(4), (2, *sizes["state"]))
    normalizer = normalizer.replace(mean={"state": mean}, std={"state": jnp.exp(spread)})
    meta = {**shipped, "network": {"actor": [32, 16], "critic": [8], **network}}
    checkpoint.save(path, (normalizer, params), meta)
    return path


@pytest.mark.parametrize("distribution", ["normal", "tanh_normal"])
@pytest.mark.parametrize("activation", ACTIVATIONS)
def test_every_network_agrees_with_jax(tmp_path, activation, distribution):
    network = {"activation": activation, "distribution": distribution, "max_observation": 1.5}
    trained = policy.load(fresh(tmp_path / "p.safetensors", **network))
    made = export.model(trained, mjx_nero.make("nero_reach", impl="native"))
    assert export.check(made, trained)[0] <= 1e-5


def test_an_action_takes_less_than_a_fifth_of_a_millisecond():
    trained = policy.load(policy.shipped("nero_lift"))
    made = export.model(trained, mjx_nero.make("nero_lift", impl="native"))
    # The fastest of some short rounds: what else the machine does only ever adds.
    assert 0 < min(export.check(made, trained, observations=200)[1] for _ in range(30)) < 2e-4


def test_normalisation_and_layers_by_hand(tmp_path):
    """One hidden layer of numpy against the graph."""
    trained = policy.load(fresh(tmp_path / "p.safetensors", activation="tanh", distribution="tanh_normal"))
    made = export.model(trained, mjx_nero.make("nero_reach", impl="native"))
    w = {t.name: onnx.numpy_helper.to_array(t).astype(np.float64) for t in made.graph.initializer}
    obs = np.linspace(-1, 1, 47)[None]
    x = np.tanh((obs - w["mean"]) / w["std"] @ w["kernel_0"] + w["bias_0"])
    x = np.tanh(np.tanh(x @ w["kernel_1"] + w["bias_1"]) @ w["kernel_out"] + w["bias_out"])
    session = onnxruntime.InferenceSession(made.SerializeToString(), providers=["CPUExecutionProvider"])
    np.testing.assert_allclose(session.run(None, {"observations": obs.astype(np.float32)})[0], x, atol=1e-6)


def test_metadata_of_the_shipped_policy(call, tmp_path):
    status, out, err = call("mjx_nero", "export", "nero_lift", "--out", "lift.onnx")
    assert (status, err) == (0, "") and "47 observations -> 8 actions every 20 ms" in out
    meta = {p.key: json.loads(p.value) for p in onnx.load(tmp_path / "lift.onnx").metadata_props}
    assert meta["joints"]["names"] == [*(f"joint{i}" for i in range(1, 8)), "gripper_joint1", "gripper_joint2"]
    assert meta["joints"]["units"] == ["rad"] * 7 + ["m"] * 2
    assert meta["joints"]["upper"][0] == pytest.approx(2.70526)  # the vendor's limit of joint 1
    assert meta["joints"]["stiffness"][0] == 200 and meta["joints"]["speed"] == [1.5] * 9
    assert [(t["name"], t["start"], t["size"]) for t in meta["observations"]] == [
        ("joint_pos", 0, 9),
        ("joint_vel", 9, 9),
        ("target_error", 18, 9),
        ("ee_position", 27, 3),
        ("ee_to_object", 30, 3),
        ("object_to_goal", 33, 3),
        ("target_object_position", 36, 3),
        ("actions", 39, 8),
    ]
    assert meta["observations"][1]["units"] == "rad/s, m/s"
    late, arm, gripper, limit = meta["actions"]
    assert (late["steps"], arm["type"], arm["lag"][0]) == ([0, 1], "joint_velocity", 0.5)
    assert (gripper["open"], gripper["close"], gripper["hysteresis"]) == ([0.05, -0.05], [0.0, -0.001], 0.5)
    assert limit == {"name": "speed_limit", "type": "speed_limit", "of": ["gripper_joint1", "gripper_joint2"]}
    assert meta["action_clip"] is None
    assert (meta["control_dt"], meta["robot"], meta["env"]) == (0.02, "nero", "nero_lift")


def test_a_checkpoint_is_exported_as_its_policy_is(call, tmp_path):
    """Of a run: the policy's parameters among the learner's whole state."""
    shipped = policy.load(policy.shipped("nero_reach"))
    tree = Trained(*shipped.params, iteration=jnp.zeros((), jnp.int32))
    checkpoint.save(tmp_path / "000000001000.safetensors", tree, {**shipped.meta, "kind": "checkpoint"})
    for source, out in (("000000001000.safetensors", "a.onnx"), ("nero_reach", "b.onnx")):
        status, _, err = call("mjx_nero", "export", source, "--out", out)
        assert (status, err) == (0, "")
    weights = [{t.name: t.raw_data for t in onnx.load(tmp_path / name).graph.initializer} for name in ("a.onnx", "b.onnx")]
    assert weights[0] == weights[1]


def test_velocities_and_delays_are_told():
    late, arm = mjx_nero.make("nero_reach", impl="native").actions.describe()
    assert late == {"name": "delay", "type": "delay", "steps": [0, 1]}
    assert arm.pop("lag") == pytest.approx([0.2, 0.2, 0.2, 0.1, 0.1, 0.1, 0.1])  # damping over stiffness
    joints = [f"joint{i}" for i in range(1, 8)]
    assert arm == {"name": "arm", "type": "joint_velocity", "joints": joints, "time": 0.15, "ahead": 0.1}


def test_positions_and_speed_limits_are_told():
    env = mjx_nero.make("nero_push", impl="native")
    arm, limit = env.actions.describe()
    assert (arm["scale"], arm["offset"]) == (0.5, [0, 0, 0, 2, 0, 0, 0])
    assert limit == {"name": "speed_limit", "type": "speed_limit", "of": list(env.cfg.robot.joints)}


def test_a_gripper_that_lets_go_at_once_is_told():
    *_, back, _ = mjx_nero.make("nero_stack", impl="native").actions.describe()
    assert back == {"name": "anti_windup", "type": "anti_windup", "of": ["gripper_joint1", "gripper_joint2"], "ahead": 0.1}


def test_a_continuous_gripper_is_told():
    env = mjx_nero.make("nero_stack", impl="native")
    _, _, hand, *_ = env.actions.describe()
    fingers = {"joints": ["gripper_joint1", "gripper_joint2"], "open": [0.05, -0.05], "close": [0.0, -0.001]}
    assert hand == {"name": "gripper", "type": "continuous", **fingers}
    assert [bound[-1] for bound in env.actions.bounds()] == [-1.0, 1.0]
    half = jnp.array([*env.cfg.robot.arm.home, 0.025, -0.0255])
    assert env.actions.invert(half, half)[-1] == pytest.approx(0.0, abs=1e-6)


def test_histories_and_filters_are_told():
    late = {"observations.state.joint_pos.history": 3, "observations.state.joint_vel.delay": (1, 2), "action_clip": 2.0}
    env = mjx_nero.make("nero_reach", impl="native", **late)
    first, second = export.metadata(policy.load(policy.shipped("nero_reach")), env)["observations"][:2]
    assert (first["history"], first["size"], first["delay_steps"]) == (3, 27, [0, 0])
    assert (second["start"], second["size"], second["delay_steps"]) == (27, 9, [1, 2])
    smooth = {**env.cfg.actions, "smooth": Term(actions.LowPass, params={"time": 0.1, "dt": env.dt})}
    filtered = mjx_nero.ManipulationEnv(dataclasses.replace(env.cfg, actions=smooth), impl="native")
    assert filtered.actions.describe()[-1] == {"name": "smooth", "type": "low_pass", "time": 0.1, "dt": env.dt}
    own = {**env.cfg.actions, "own": Term(actions.Plain)}
    guest = mjx_nero.ManipulationEnv(dataclasses.replace(env.cfg, actions=own), impl="native")
    with pytest.raises(UserError, match=r"the action term own \(Plain\) does not describe itself"):
        guest.actions.describe()


@pytest.mark.parametrize("env_name", ["nero_lift", "so100_reach", "nero_push", "nero_place", "cobotta_stack", "nero_stack"])
def test_the_page_program_moves_the_arm_as_the_environment_does(call, tmp_path, env_name):
    """The page's program, word for word, without JAX or MuJoCo: its joint targets are the environment's."""
    punctual = {"actions.delay.params.steps": (0, 0)} if env_name != "nero_push" else {}
    env = mjx_nero.make(env_name, impl="native", corruption=False, **punctual)
    trained = policy.load_for(env, env_name, policy.shipped(env_name))
    reset, step, targets, view = (jax.jit(f) for f in (env.reset, env.step, env.targets, env.view))
    named = jax.jit(lambda state: env.named_observations(state)["state"])
    state, terms, want = reset(jax.random.PRNGKey(1)), [], []
    positions = []  # a reach episode starts anywhere
    for _ in range(30):
        action = trained.act(state.obs)
        terms.append({name: np.asarray(value) for name, value in named(state).items()})
        positions.append(np.asarray(view(state).joint_pos))
        want.append(np.asarray(targets(state, action)))
        state = step(state, action)
    assert np.ptp(np.stack(want), axis=0).max() > 0.05  # the arm moves
    named_terms = {f"{i}/{name}": value for i, row in enumerate(terms) for name, value in row.items()}
    np.savez(tmp_path / "terms.npz", positions=positions, **named_terms)

    (program,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(), re.DOTALL)
    assert call("mjx_nero", "export", env_name, "--out", "policy.onnx")[0] == 0
    (tmp_path / "run_policy.py").write_text(program)
    drive = f"""
import sys
sys.modules.update(dict.fromkeys({ABSENT}))  # None: their import fails
import numpy as np, runpy
run = runpy.run_path(sys.argv[0])
data = np.load("terms.npz")
rows = [{{k.split("/", 1)[1]: data[k] for k in data if k.startswith(f"{{i}}/")}} for i in range({len(terms)})]
out, policy = [], run["policy"]
targets = policy.executor(data["positions"][0])
for row, position in zip(rows, data["positions"]):
    out.append(targets(policy.act(row), position))
np.save("targets.npy", out)
"""
    argv = f"import sys; sys.argv = ['run_policy.py', 'policy.onnx']\n{drive}"
    done = subprocess.run([sys.executable, "-c", argv], cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert env.cfg.robot.joints[0] in done.stdout  # what the page prints
    np.testing.assert_allclose(np.load(tmp_path / "targets.npy"), np.stack(want), atol=2e-5)


@pytest.mark.parametrize(
    ("argv", "message"),
    [
        (["nowhere.safetensors", "--out", "p.onnx"], "no policy file and no bundled policy 'nowhere.safetensors'"),
        (["nero_lift", "--out", "nowhere/p.onnx"], "cannot write nowhere/p.onnx"),
        (["nero_lift", "--out", "p.onnx", "--env.rewards", "1"], "rewards takes a"),
        (["nero_lift"], "the following arguments are required: --out"),
    ],
)
def test_mistakes_are_one_line(call, tmp_path, argv, message):
    status, out, err = call("mjx_nero", "export", *argv)
    assert (status, out) == (2, "") and message in err and err.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_without_the_extra(call, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "onnx", None)
    status, _, err = call("mjx_nero", "export", "nero_lift", "--out", "p.onnx")
    assert status == 2 and err == "error: this needs onnx, of the extra 'onnx': pip install 'mjx-nero[onnx]'\n"
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(UserError, match="of the extra 'torch'"):
        interop.need("torch")
