"""Products whose sides are rounded up: the same numbers, in shapes that arms share."""

import functools
import math
import re

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from brax.training.acme import running_statistics, specs
from brax.training.agents.ppo.losses import PPONetworkParams
from flax import linen

from mjx_nero.learn import products
from mjx_nero.learn.ppo.cfg import NetworkCfg
from mjx_nero.learn.ppo.networks import make_networks

KEY = jax.random.PRNGKey(0)
INPUTS, ACTIONS, ROWS = 43, 7, 32


def seen(size):
    """Statistics of observations of which none were seen: they stay as they are."""
    return running_statistics.init_state({"state": specs.Array((size,), jnp.dtype("float32"))})


class Pool(linen.Module):
    """A layer of another kind, whose kernel has two axes, too."""

    @linen.compact
    def __call__(self, x):
        kernel = self.param("kernel", linen.initializers.normal(), (x.shape[-1], 3))
        return linen.Dense(3, dtype=jnp.bfloat16)(x) + x @ kernel


@pytest.fixture(scope="module")
def problem():
    """An update of actor, critic and another network, its parameters, the optimizer's memory, and what it is scanned over."""
    nets = make_networks({"state": (INPUTS,)}, ACTIONS, NetworkCfg(actor=(32, 16), critic=(24,)))
    pool, optimizer = Pool(), optax.flatten(optax.chain(optax.clip_by_global_norm(1.0), optax.adam(1e-2)))
    k_actor, k_critic, k_pool, k_obs = jax.random.split(KEY, 4)
    obs = jax.random.normal(k_obs, (5, ROWS, INPUTS))
    policy = {**nets.policy_network.init(k_actor), "encoders": pool.init(k_pool, obs[0])}
    params = PPONetworkParams(policy=policy, value=nets.value_network.init(k_critic))

    def loss(params, obs):
        own = {"params": params.policy["params"]}
        mean, std = nets.policy_network.apply(seen(INPUTS), own, {"state": obs})
        value = nets.value_network.apply(seen(INPUTS), params.value, {"state": obs})
        assert mean.shape == (ROWS, ACTIONS) and value.shape == (ROWS,)
        other = pool.apply(params.policy["encoders"], obs)
        return jnp.mean(jnp.square(mean - 1)) + jnp.mean(std) + jnp.mean(jnp.square(value - 2)) + jnp.mean(jnp.square(other))

    def update(carry, obs):
        params, memory = carry
        found, grads = jax.value_and_grad(loss)(params, obs)
        updates, memory = optimizer.update(grads, memory)
        return (optax.apply_updates(params, updates), memory), found

    return update, params, optimizer.init(params), obs


def test_learning_is_the_same_with_wider_kernels(problem, monkeypatch):
    update, params, memory, obs = problem
    (as_it_is, own), losses = jax.lax.scan(update, (params, memory), obs)
    met = []

    def watched(carry, obs):
        met.append(jax.tree.map(jnp.shape, carry))
        return update(carry, obs)

    monkeypatch.setattr(products.jax, "default_backend", lambda: "gpu")
    (wide, its), found = products.scan(watched, params, memory, obs)
    shapes, memories = met[0]
    assert shapes.policy["params"]["MLP_0"]["hidden_0"]["kernel"] == (48, 32)
    assert shapes.policy["params"]["Dense_0"] == {"kernel": (16, 16), "bias": (ACTIONS,)}
    assert shapes.value["params"]["hidden_0"]["kernel"] == (48, 32)  # of 24 columns
    assert shapes.value["params"]["hidden_1"]["kernel"] == (32, 1)
    assert shapes.policy["encoders"]["params"]["kernel"] == (INPUTS, 3)  # no plain dense layer
    wide_size = sum(math.prod(x) for x in jax.tree.leaves(shapes, is_leaf=lambda x: isinstance(x, tuple)))
    assert memories[1][0].mu == memories[1][0].nu == (wide_size,)
    np.testing.assert_allclose(found, losses, rtol=1e-5)
    assert losses[-1] < losses[0]
    for mine, other in ((wide, as_it_is), (its, own)):
        assert jax.tree.map(jnp.shape, mine) == jax.tree.map(jnp.shape, other)
        jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6), mine, other)


def test_what_is_added_stays_zero(problem, monkeypatch):
    """Otherwise a policy would have learnt what is cut off in the end."""
    update, params, memory, obs = problem
    ends = []
    monkeypatch.setattr(products.jax, "default_backend", lambda: "gpu")
    narrow = products._Sides.narrow
    monkeypatch.setattr(products._Sides, "narrow", lambda self, *made: (ends.append(made), narrow(self, *made))[1])
    products.scan(update, params, memory, obs)
    ((wide, _),) = ends
    first, last = wide.policy["params"]["MLP_0"]["hidden_0"]["kernel"], wide.policy["params"]["Dense_0"]["kernel"]
    assert not first[INPUTS:].any() and first[:INPUTS].all() and not last[:, ACTIONS:].any() and last[:, :ACTIONS].all()


def test_arms_with_few_other_numbers_share_all_products(monkeypatch):
    monkeypatch.setattr(products.jax, "default_backend", lambda: "gpu")

    def shapes(inputs, actions):
        nets = make_networks({"state": (inputs,)}, actions, NetworkCfg(actor=(32, 16), critic=(32,)))
        params = PPONetworkParams(policy=nets.policy_network.init(KEY), value=nets.value_network.init(KEY))
        optimizer = optax.flatten(optax.adam(1e-3))

        def loss(params, obs):
            mean, _ = nets.policy_network.apply(seen(inputs), params.policy, {"state": obs})
            return jnp.mean(jnp.square(mean)) + jnp.mean(nets.value_network.apply(seen(inputs), params.value, {"state": obs}))

        def update(carry, obs):
            updates, memory = optimizer.update(jax.grad(loss)(carry[0], obs), carry[1])
            return (optax.apply_updates(carry[0], updates), memory), None

        run = functools.partial(products.scan, update)
        text = jax.jit(run).lower(params, optimizer.init(params), jnp.ones((2, ROWS, inputs))).as_text()
        return sorted(re.findall(r"dot_general .*: (\(.*\) -> .*)", text))

    own = shapes(47, 8)
    assert len(own) > 8 and own == shapes(43, 7) and own != shapes(49, 7)


def test_on_a_cpu_nothing_is_added(problem):
    update, params, memory, obs = problem
    own, found = (
        str(jax.make_jaxpr(functools.partial(run, update))(*args))
        for run, args in (
            (lambda f, *carry: jax.lax.scan(f, carry[:2], carry[2]), (params, memory, obs)),
            (products.scan, (params, memory, obs)),
        )
    )
    assert own == found
