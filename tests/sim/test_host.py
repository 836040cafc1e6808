"""Python functions in compiled CPU programs."""

import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero.sim.physics import host

# Prints how many of its programs JAX found in its cache, and what one with a function of ours computes.
PROGRAM = """
import jax, jax.numpy as jnp, numpy as np
from mjx_nero.sim.physics import host
hits = []
jax.monitoring.register_event_listener(lambda name, **_: hits.append(name) if name.endswith("cache_hits") else None)
def double(x, y):
    y[:] = 2 * x
host.offer(7, double)
f = jax.jit(lambda x: host.call(7, jax.ShapeDtypeStruct(x.shape, np.float32), x) + 1)
print(float(f(jnp.ones(3))[0]), len(hits))
"""

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="of CPU programs")


def sums(x, y):
    y[..., 0] = x.sum(axis=-1)


def call(x, key=1, work=sums):
    host.offer(key, work)
    return host.call(key, jax.ShapeDtypeStruct((*x.shape[:-1], 1), jnp.float32), x)


def test_jit_and_vmap():
    x = jnp.arange(24.0).reshape(2, 3, 4)
    expected = x.sum(axis=-1, keepdims=True)
    np.testing.assert_array_equal(jax.jit(call)(x), expected)
    np.testing.assert_array_equal(jax.jit(jax.vmap(jax.vmap(call)))(x), expected)
    assert call(jnp.ones((0, 4))).shape == (0, 1)


def test_in_a_loop():
    def body(x, _):
        return x + call(x, 2, lambda x, y: y.fill(1.0)), None

    assert jax.jit(lambda x: jax.lax.scan(body, x, length=50)[0])(jnp.zeros((3, 1))).tolist() == [[50.0]] * 3


@pytest.mark.parametrize(("key", "error"), [(3, ValueError("the arm fell off")), (4, KeyboardInterrupt())])
def test_what_it_raises_ends_the_program(key, error):
    def fail(x, y):
        raise error

    with pytest.raises(jax.errors.JaxRuntimeError, match=f"{type(error).__name__}: {error}"):
        jax.block_until_ready(jax.jit(lambda x: call(x, key, fail))(jnp.ones(2)))


def test_programs_are_kept_between_runs(tmp_path):
    env = os.environ | {"JAX_COMPILATION_CACHE_DIR": str(tmp_path), "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0"}
    runs = [subprocess.run([sys.executable, "-c", PROGRAM], env=env, capture_output=True, text=True) for _ in range(2)]
    (first, hits), (second, hits_again) = [run.stdout.split() for run in runs]
    assert first == second == "3.0"
    assert int(hits_again) > int(hits)
