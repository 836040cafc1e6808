"""Gymnasium's API over the environments: what it returns is what the environments themselves make."""

import pathlib
import re
import subprocess
import sys
import warnings

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import mjx_nero
from mjx_nero.interop.gymnasium import Env, VectorEnv
from mjx_nero.types import UserError

N = 8
SHORT = {"episode_length_s": 1.0}  # 30 steps of nero_reach


@pytest.fixture(scope="module")
def reach():
    return mjx_nero.make("nero_reach", impl="native", corruption=False, num_envs=N, **SHORT)


@pytest.fixture(scope="module")
def vector(reach):
    return VectorEnv(reach, N, arrays="jax")


def test_a_registered_environment_passes_gymnasiums_check():
    env = gymnasium.make("mjx_nero/nero_reach-v0", impl="native", **SHORT)
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*infinity.*")  # observations have no bounds
        warnings.filterwarnings("ignore", message=".*symmetric and normalized.*")  # the joints' limits are neither
        check_env(env.unwrapped, skip_render_check=True)
    assert env.action_space.shape == (7,) and env.observation_space.shape == (47,)


@pytest.mark.slow
def test_ids_without_an_import_of_ones_own():
    code = "import gymnasium as g; print(g.make('mjx_nero.interop.gymnasium:mjx_nero/so100_reach-v0', impl='native').spec.id)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert done.stdout.strip() == "mjx_nero/so100_reach-v0", done.stderr
    done.check_returncode()
    ids = {name for name in gymnasium.registry if name.startswith("mjx_nero/")}
    assert {f"mjx_nero/{name}-v0" for name in mjx_nero.list_envs()} <= ids


def test_make_vec_takes_the_compiled_batch():
    env = gymnasium.make_vec("mjx_nero/nero_reach-v0", N, vectorization_mode="vector_entry_point", impl="native", **SHORT)
    obs, info = env.reset(seed=0)
    assert isinstance(env, VectorEnv) and obs.shape == (N, 47) and obs.dtype == np.float32 and info == {}
    assert env.observation_space.contains(obs)


def test_actions_end_where_the_joints_do(vector):
    """Home plus half a radian an action: joint 4 is at home at 2.0 and goes from -1.01 to 2.14. Velocities: +-1."""
    box = Env("nero_lift", preset="isaac", impl="native").action_space
    assert box.low[3] == pytest.approx((-1.01 - 2.0) / 0.5) and box.high[3] == pytest.approx((2.14 - 2.0) / 0.5)
    assert (vector.single_action_space.low == -1).all() and (vector.single_action_space.high == 1).all()
    assert (box.low[-1], box.high[-1]) == (-1, 1)  # the gripper
    drives = Env("nero_pick_place", impl="native")
    assert drives.action_space.high[3] == pytest.approx(2.14)  # targets themselves


def test_steps_are_the_environments_own_until_the_episode_ends(reach, vector):
    """Against ``ManipulationEnv.step`` on the same states, one after another."""
    step = jax.jit(jax.vmap(reach.step))
    obs, _ = vector.reset(seed=5)
    state = vector._state
    assert reach.episode_length == 30
    for t in range(30):
        action = 0.3 * jax.random.normal(jax.random.PRNGKey(t), (N, 7))
        state = step(state, action)
        obs, reward, terminated, truncated, info = vector.step(action)
        np.testing.assert_allclose(reward, state.reward, atol=1e-6)
        np.testing.assert_allclose(info["final_obs"], state.obs["state"], atol=1e-5)
        assert not terminated.any() and bool(truncated.all()) == (t == 29) == bool(info["_final_obs"].all())
    # The flags and the reward are the ended episode's, the observation is the next one's.
    np.testing.assert_array_equal(info["final_info"]["final_distance"], state.metrics["final_distance"])
    assert (np.asarray(info["final_info"]["final_distance"]) > 0).all()
    assert np.abs(np.asarray(obs) - np.asarray(info["final_obs"])).max() > 0.01
    np.testing.assert_array_equal(vector._state.info["carry"].step, np.zeros(N))
    np.testing.assert_array_equal(vector._state.info["count"], np.full(N, 30))  # curricula go on
    assert len(np.unique(np.asarray(vector._state.info["carry"].command)[:, 0])) == N  # each with a goal of its own
    obs2, *_ = vector.step(jnp.zeros((N, 7)))
    np.testing.assert_array_equal(vector._state.info["carry"].step, np.ones(N))


def test_one_that_ends_early_restarts_alone():
    env = VectorEnv("nero_lift", 2, impl="native", corruption=False)
    env.reset(seed=0)
    sim = env._state.pipeline_state
    qpos = sim.qpos.at[0, -7:-4].set(jnp.array([0.3, 0.0, -0.2]))  # the first environment's cube has fallen
    env._state = env._state.replace(pipeline_state=sim.replace(qpos=qpos))
    obs, reward, terminated, truncated, info = env.step(np.zeros((2, 8), np.float32))
    assert terminated.tolist() == [True, False] and truncated.tolist() == [False, False]
    assert info["_final_obs"].tolist() == info["_final_info"].tolist() == [True, False]
    assert info["final_info"]["dropped"].tolist() == [1, 0]
    assert np.asarray(env._state.info["carry"].step).tolist() == [0, 1]
    np.testing.assert_array_equal(info["final_obs"][1], obs[1])  # goes on
    assert np.abs(info["final_obs"][0] - obs[0]).max() > 0.1


def test_on_a_gpu_a_step_has_no_branch_and_gives_the_same(reach, vector, monkeypatch):
    """A branch would make the host wait for the device in the middle of a step."""

    def play(env):
        env.reset(seed=4)
        return [jax.tree.map(np.asarray, env.step(jnp.full((N, 7), 0.2))) for _ in range(35)]  # over an autoreset

    def branches(env):
        return env._step.lower(env._state, env._key, jnp.zeros((N, 7))).as_text().count("stablehlo.case")

    expected = play(vector)
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    straight = VectorEnv(reach, N, arrays="jax")
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-4), play(straight), expected)
    assert branches(straight) == 0
    monkeypatch.undo()
    assert branches(vector) == 1


def test_results_may_travel_in_one_array(reach, vector):
    """As they do to torch."""
    packed = VectorEnv(reach, N, arrays="jax")
    packed._packed = True
    for env in (packed, vector):
        env.reset(seed=3)
    infos = [env.step(jnp.full((N, 7), 0.1))[4]["final_info"] for env in (packed, vector)]
    assert list(infos[0]) == list(infos[1]) == ["success", "final_distance", "dropped", "nan"]
    jax.tree.map(lambda a, b: np.testing.assert_allclose(a, b, atol=1e-6), *infos)


def test_a_seed_repeats_everything(vector):
    def play(seed):
        first, _ = vector.reset(seed=seed)
        seen = [first]
        for _ in range(35):  # over an autoreset
            seen.append(vector.step(jnp.full((N, 7), 0.2))[0])
        return np.stack(seen)

    a, b, c = play(1), play(1), play(2)
    np.testing.assert_array_equal(a, b)
    assert np.abs(a - c).max() > 0.1
    vector.reset(seed=1)
    assert np.abs(np.asarray(vector.reset()[0]) - a[0]).max() > 0.01  # without a seed: other episodes


def test_groups():
    env = Env("nero_lift", group=None, impl="native")
    assert {name: box.shape for name, box in env.observation_space.items()} == {"state": (47,), "privileged_state": (57,)}
    obs, _ = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    with pytest.raises(UserError, match="no observation group 'pixels': choose one of"):
        Env("nero_lift", group="pixels", impl="native")


def test_mistakes(reach):
    with pytest.raises(UserError, match="unknown arrays 'cupy': choose one of numpy, jax, torch"):
        VectorEnv(reach, N, arrays="cupy")
    with pytest.raises(gymnasium.error.ResetNeeded):
        VectorEnv(reach, N).step(np.zeros((N, 7)))


def test_misuse_is_refused_in_gymnasiums_words(reach):
    for env, shape in ((Env(reach), (7,)), (VectorEnv(reach, N), (N, 7))):
        with pytest.raises(gymnasium.error.ResetNeeded, match="call reset before render"):
            env.render()
        for seed in ([1, 2], -1, 2**32, "x", 0.5):
            with pytest.raises(gymnasium.error.Error, match="^seed "):
                env.reset(seed=seed)
        with pytest.raises(gymnasium.error.Error, match="no options here, got reset_mask"):
            env.reset(options={"reset_mask": np.ones(N, bool)})
        env.reset(seed=2**32 - 1, options={})
        for wrong in ((), (6,), (N + 1, 7)):
            with pytest.raises(gymnasium.error.InvalidAction, match="^actions take the shape"):
                env.step(np.zeros(wrong, np.float32))
        assert env.step(np.zeros(shape, np.float32))[0].shape[-1] == 47
        env.close(), env.close()
    for count in (0, -1, 2**25, "x"):
        with pytest.raises(UserError, match="^num_envs "):
            VectorEnv(reach, count)


def test_frames(reach):
    env = VectorEnv(reach, N, render_mode="rgb_array", num_rendered=2)
    env.reset(seed=0)
    a, b = env.render()
    assert a.shape == (480, 640, 3) and a.std() > 20 and (a != b).any()
    env.close()


@pytest.mark.slow
def test_the_pages_snippets_run():
    page = (pathlib.Path(__file__).resolve().parents[2] / "docs" / "guides" / "gymnasium.md").read_text()
    names = {}
    for snippet in re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL):
        exec(snippet, names)
    assert names["obs"].shape == (64, 47) and names["env"].unwrapped.env.cfg.scene.objects["cube"].mass == 0.05


@pytest.mark.slow
def test_stable_baselines_trains(tmp_path):
    """The example's program at a small size: it runs to its end and tells a rate; what it learns takes millions of steps."""
    pytest.importorskip("stable_baselines3", reason="the extra torch is not installed")
    program = pathlib.Path(__file__).resolve().parents[2] / "examples" / "stable_baselines3_reach.py"
    assert len(program.read_text().splitlines()) <= 40
    done = subprocess.run([sys.executable, program, "6144"], cwd=tmp_path, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr
    assert re.search(r"success rate: [\d.]+% of \d+ episodes", done.stdout) and "rollout/" in done.stdout


def test_torch_shares_memory(reach):
    torch = pytest.importorskip("torch", reason="the extra torch is not installed")
    env = VectorEnv(reach, N, arrays="torch")
    obs, _ = env.reset(seed=0)
    assert isinstance(obs, torch.Tensor) and obs.data_ptr() == env._state.obs["state"].unsafe_buffer_pointer()
    obs, reward, terminated, truncated, info = env.step(torch.zeros(N, 7))
    assert terminated.dtype == truncated.dtype == torch.bool and info["final_obs"].shape == (N, 47)
    env.reset(seed=0)
    same = VectorEnv(reach, N)
    same.reset(seed=0)
    action = torch.linspace(-1, 1, N * 7).reshape(N, 7)
    np.testing.assert_array_equal(env.step(action)[0].numpy(), same.step(action.numpy())[0])


@pytest.mark.slow
def test_the_example_tells_a_rate(tmp_path):
    program = pathlib.Path(__file__).resolve().parents[2] / "examples" / "gymnasium_rate.py"
    command = [sys.executable, program, "--env", "nero_reach", "--num-envs", "4", "--steps", "3"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    assert re.search(r"4 x nero_reach, jax: [\d,]+ env steps/s", done.stdout)
