"""A policy that sees, as ONNX."""

import functools

import jax
import numpy as np
import pytest

from mjx_nero import make
from mjx_nero.imitation.distill.cfg import StudentCfg
from mjx_nero.interop import onnx
from mjx_nero.learn import policy
from mjx_nero.learn.pixels import graph as student
from mjx_nero.learn.pixels import networks


@pytest.mark.parametrize("preset", ["rgb_fixed", "rgbd_fixed"])
def test_a_student_acts_in_onnx_as_in_jax(preset):
    pytest.importorskip("onnxruntime")
    sizes = {f"scene.cameras.{name}.size": (20, 12) for name in ("front", "wrist")}
    env = make("nero_lift", preset, impl="native", **sizes)
    cfg = StudentCfg(channels=(8, 16, 16), features=24, layers=(32, 16))
    net = networks.Student(cfg, env.action_size, 3)
    normalizer, params = networks.init_params(net, env.observation_size, jax.random.PRNGKey(0))
    params = jax.tree.map(lambda x: x + 0.05 * jax.random.normal(jax.random.PRNGKey(x.size), x.shape), params)  # biases, too
    said = {"layers": (32, 16), "channels": (8, 16, 16), "features": 24}
    meta = policy.describe(env, "nero_lift", preset, "distill", {"student": said})
    _, act = networks.from_meta(meta)
    trained = policy.Policy(meta, (normalizer, params), functools.partial(act, (normalizer, params)))
    made = onnx.model(trained, env)
    assert [each.name for each in made.graph.input] == ["observations", "picture_front", "picture_wrist"]
    assert [d.dim_value for d in made.graph.input[1].type.tensor_type.shape.dim][1:] == [
        12,
        20,
        3 if preset == "rgb_fixed" else 4,
    ]
    difference, _ = onnx.check(made, trained, observations=20)
    assert difference < 1e-4
    seen = {k.removeprefix("picture_"): v for k, v in student.random_pictures(meta, 4, np.random.default_rng(0)).items()}
    obs = {"state": np.zeros((4, *env.observation_size["state"]), np.float32), "pictures": seen}
    np.testing.assert_allclose(trained.act(obs), student.exact(trained)(obs), atol=0.05)  # bfloat16 beside float32
