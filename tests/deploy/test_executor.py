"""The action chain in numpy against the terms in JAX, step for step."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import mjx_nero
from mjx_nero.deploy.executor import PARTS, Executor, Joints
from mjx_nero.mdp import actions
from mjx_nero.mdp.terms import Term
from mjx_nero.tasks import registry, seeing

STEPS = 60


def group(joints, seed, lag=0.2):
    rng = np.random.default_rng(seed)
    n = len(joints)
    low, high = -rng.uniform(0.5, 2.0, n), rng.uniform(0.5, 2.0, n)
    home, open, close = (low + rng.uniform(0.2, 0.8, n) * (high - low) for _ in range(3))
    arrays = (np.asarray(x, np.float32) for x in (home, low, high, rng.uniform(0.5, 3.0, n), open, close, np.full(n, lag)))
    return actions.Drives(*arrays, dt=0.02, joints=joints)


GROUPS = {"arm": group(("a", "b", "c"), 0), "gripper": group(("f", "g"), 1)}
JOINTS = Joints(
    names=("a", "b", "c", "f", "g"),
    **{
        name: np.concatenate([getattr(drives, field) for drives in GROUPS.values()]).astype(float)
        for name, field in (("home", "home"), ("lower", "low"), ("upper", "high"), ("speed", "speed"))
    },
    dt=0.02,
)
CHAINS = {
    "positions": {"arm": Term(actions.JointPosition, params={"scale": 0.7}), "gripper": Term(actions.BinaryGripper)},
    "velocities": {
        "late": Term(actions.Delay, params={"steps": (0, 0)}),
        "arm": Term(actions.JointVelocity),
        "gripper": Term(actions.BinaryGripper, params={"hysteresis": 0.5}),
        "limit": Term(actions.SpeedLimit, params={"group": "gripper"}),
    },
    "continuous": {
        "arm": Term(actions.JointVelocity, params={"time": 0.3, "ahead": 0.02}),
        "gripper": Term(actions.ContinuousGripper),
        "back": Term(actions.AntiWindup, params={"ahead": 0.05}),
        "limit": Term(actions.SpeedLimit),
    },
    "smooth": {
        "smooth": Term(actions.LowPass, params={"time": 0.1, "dt": 0.02}),
        "arm": Term(actions.JointPosition, params={"scale": 0.5}),
        "gripper": Term(actions.ContinuousGripper),
        "noise": Term(actions.Noise, params={"amount": 0.0}),
    },
    "targets": {"drives": Term(actions.DriveTargets), "limit": Term(actions.SpeedLimit)},
}


def played(chain, values, positions):
    """The targets of the terms in JAX."""
    memory, ctrl, out = chain.init(jax.random.PRNGKey(0), jnp.asarray(positions[0])), jnp.asarray(positions[0]), []
    step = jax.jit(chain.step)
    for value, position in zip(values, positions, strict=True):
        memory, ctrl = step(memory, jnp.asarray(value), jnp.asarray(position), ctrl)
        out.append(np.asarray(ctrl))
    return np.stack(out)


@pytest.mark.parametrize("name", CHAINS)
@pytest.mark.parametrize("seed", [0, 1])
def test_every_type_does_what_its_term_does(name, seed):
    chain, rng = actions.Chain(CHAINS[name], GROUPS), np.random.default_rng(seed)
    # Slow enough to pass through everything between the limits, wide enough to reach them.
    values = np.cumsum(rng.normal(0, 0.4, (STEPS, len(chain.home))), axis=0).astype(np.float32)
    positions = (JOINTS.home + np.cumsum(rng.normal(0, 0.03, (STEPS, 5)), axis=0)).astype(np.float32)
    executor = Executor(JOINTS, chain.describe(), positions[0])
    ours = np.stack([executor(*row) for row in zip(values, positions, strict=True)])
    np.testing.assert_allclose(ours, played(chain, values, positions), atol=1e-5)
    np.testing.assert_allclose(executor.home_action, chain.home, atol=1e-6)
    assert np.ptp(ours[:, :3], axis=0).min() > 0.02  # the arm moves


def test_every_type_is_tried():
    tried = {part["type"] for terms in CHAINS.values() for part in actions.Chain(terms, GROUPS).describe()}
    assert tried == set(PARTS)


@pytest.mark.parametrize("name", ["positions", "continuous", "targets"])
def test_an_inverted_action_gives_its_targets(name):
    chain = actions.Chain({key: term for key, term in CHAINS[name].items() if key in ("arm", "gripper", "drives")}, GROUPS)
    grip, share = GROUPS["gripper"], 0.0 if name == "positions" else 0.3
    wanted = np.concatenate([GROUPS["arm"].home + 0.1, grip.close + share * (grip.open - grip.close)])
    if name == "continuous":  # velocities get there in time
        wanted[:3] = GROUPS["arm"].home
    action = chain.invert(jnp.asarray(wanted), jnp.asarray(JOINTS.home, jnp.float32))
    got = played(chain, [np.asarray(action)], [JOINTS.home.astype(np.float32)])[0]
    np.testing.assert_allclose(got, np.clip(wanted, JOINTS.lower, JOINTS.upper), atol=1e-5)


def test_velocities_lead_to_the_targets_and_stay():
    chain = actions.Chain({"arm": Term(actions.JointVelocity), "gripper": Term(actions.BinaryGripper)}, GROUPS)
    wanted, at = np.concatenate([GROUPS["arm"].home + 0.2, GROUPS["gripper"].open]), JOINTS.home.copy()
    executor = Executor(JOINTS, chain.describe(), at)
    for _ in range(150):
        at = executor(np.asarray(chain.invert(jnp.asarray(wanted), jnp.asarray(at))), at)  # joints that follow at once
    np.testing.assert_allclose(at[:3], wanted[:3], atol=5e-3)


def test_actions_are_clipped_first():
    parts = actions.Chain(CHAINS["positions"], GROUPS).describe()
    free, clipped = Executor(JOINTS, parts, JOINTS.home), Executor(JOINTS, parts, JOINTS.home, clip=0.1)
    action = np.array([0.05, 9.0, -9.0, 1.0])
    bounded = np.array([0.05, 0.1, -0.1, 1.0])
    np.testing.assert_allclose(clipped(action, JOINTS.home), free(bounded, JOINTS.home))


def test_an_unknown_type_is_said():
    with pytest.raises(ValueError, match="unknown type of action 'levitate': not one of joint_position, "):
        Executor(JOINTS, [{"name": "x", "type": "levitate"}], JOINTS.home)


@pytest.mark.parametrize("env_name", registry.list_envs())
def test_every_environment_describes_its_actions(env_name):
    anyone = {} if registry.robot_of(env_name) else {"robot": "piper"}
    for preset in registry.list_presets(env_name):
        if preset in seeing.PRESETS[1:]:
            continue  # acts as the first of them
        env = mjx_nero.make(env_name, preset=preset, impl="native", **anyone)
        low, high = env.actions.bounds()
        assert low.shape == high.shape == (env.action_size,) and (low < high).all()
        assert all(part["type"] in PARTS for part in env.actions.describe())
