"""What training needs of memory: the estimate against the compiled program, and the message where it does not fit."""

import dataclasses

import jax
import pytest
from kinematic import Kinematic
from test_ppo import KEY, SMALL

from mjx_nero import UserError, make
from mjx_nero.envs import wrappers
from mjx_nero.learn import device_memory
from mjx_nero.learn.ppo.cfg import NetworkCfg
from mjx_nero.learn.ppo.learner import Learner
from mjx_nero.runs import cfg, compiled
from mjx_nero.runs.programs import Programs
from mjx_nero.sim.physics import Footprint


def learner(num_envs=512, **fields):
    env = make("nero_lift", impl="native", num_envs=num_envs)
    env.physics = Kinematic()
    return Learner(wrappers.for_training(env), dataclasses.replace(SMALL, num_envs=num_envs, **fields))


def needed(learner):
    fixed, per_env = learner.footprint()
    return fixed + per_env * learner.num_envs


@pytest.mark.parametrize(
    "fields",
    [
        {"network": NetworkCfg(actor=(128, 64), critic=(128, 64)), "num_minibatches": 1},  # the update takes most
        {"network": NetworkCfg(actor=(16,), critic=(16,)), "num_minibatches": 8, "unroll_length": 48},  # the rollout
    ],
    ids=["update", "rollout"],
)
def test_estimate_is_near_what_xla_takes(fields):
    big = learner(**fields)
    state = jax.eval_shape(big.init, KEY)
    program = jax.jit(big.run, static_argnums=1, donate_argnums=0).lower(state, 1).compile()
    used = device_memory.program_bytes(program)
    assert used / 1.5 < needed(big) < used * 1.5


def test_a_group_of_several_axes_takes_the_product_of_its_sides():
    """Sixteen steps of a picture of 10 x 20 more, kept and copied: 16 x 200 x 4 bytes, ten per cent and the minibatch."""
    vector, picture = (learner(unroll_length=16, num_minibatches=1) for _ in range(2))
    picture.sizes = {**vector.sizes, "picture": (10, 20)}
    more = picture.footprint()[1] - vector.footprint()[1]
    assert more == pytest.approx((1.1 + 1.0) * 16 * 200 * 4)


def test_too_many_environments_are_told_how_many_fit(monkeypatch):
    small = learner()
    fixed, per_env = small.footprint()
    monkeypatch.setattr(device_memory, "_limit", lambda _: fixed + 101.5 * per_env)
    with pytest.raises(UserError, match=r"^512 environments need about 0.0 GB .* pass --num-envs 100 or fewer$"):
        device_memory.check(small)
    device_memory.check(learner(num_envs=100))
    with pytest.raises(UserError, match="pass --num-envs 100 or fewer"):
        device_memory.check(learner(num_envs=104))
    monkeypatch.setattr(device_memory, "_limit", lambda _: fixed)
    with pytest.raises(UserError, match="too little even for 4"):
        device_memory.check(small)


def test_what_lies_outside_of_jax_counts_too(monkeypatch):
    small = learner()
    env = small.env.unwrapped
    monkeypatch.setattr(env, "footprint", lambda num_devices: Footprint(outside=8e6, free=1e9))
    device_memory.check(small)
    with pytest.raises(UserError, match=r"^512 environments need about 5.1 GB .* has 1.0 GB: pass --num-envs 100 or fewer$"):
        device_memory.check_outside(small)
    with pytest.raises(UserError, match="pass --num-envs 100 or fewer"):  # beside the programs, which are compiled meanwhile
        run = cfg.resolve("nero_lift", "default", None, {}, {"num_envs": 512}, impl="native")
        compiled.compile(dataclasses.replace(run, eval_episodes=2), small, 1, lambda: small.init(KEY), Programs(run, small))


def test_figures_of_the_message(monkeypatch):
    monkeypatch.setattr(device_memory, "_limit", lambda _: 8e9)
    with pytest.raises(
        UserError, match=r"1000000 environments need about 20.1 GB of memory .* which has 8.0 GB: pass --num-envs 395"
    ):
        device_memory.Pool(8e9, 1e8, 2e4).check(learner(num_envs=1_000_000))


def test_the_compiled_program_has_the_last_word(monkeypatch):
    class Program:
        def memory_analysis(self):
            sizes = {"argument": 200, "output": 200, "temp": 700, "alias": 100}  # MB: a thousand in all
            return type("Use", (), {f"{name}_size_in_bytes": size * 10**6 for name, size in sizes.items()})

    small = learner()
    assert device_memory.program_bytes(Program()) == 10**9
    monkeypatch.setattr(device_memory, "_limit", lambda _: 1e9)
    device_memory.check_compiled(small, [Program()])
    monkeypatch.setattr(device_memory, "_limit", lambda _: 0.5e9)
    with pytest.raises(UserError, match=r"512 environments need about 1.0 GB .* pass --num-envs 2[45]\d or fewer"):
        device_memory.check_compiled(small, [Program()])


def test_this_machine_has_memory():
    assert 1e8 < device_memory._free_of_machine() < 1e14


def test_running_out_of_memory_is_one_line():
    small = learner()
    with (
        pytest.raises(UserError, match="^out of memory with 512 environments: pass a smaller --num-envs$"),
        device_memory.out_of_memory_as_user_error(small),
    ):
        raise RuntimeError("RESOURCE_EXHAUSTED: Failed to allocate request for 3.00GiB on device ordinal 0")
    with pytest.raises(RuntimeError, match="^something else$"), device_memory.out_of_memory_as_user_error(small):
        raise RuntimeError("something else")
