"""train.py and eval.py as a user calls them: results, files, and mistakes that end in one line."""

import json
import os
import shutil
import signal

import imageio.v3 as imageio
import jax
import mujoco
import numpy as np
import pytest

from mjx_nero import list_envs
from mjx_nero.learn import checkpoint, policy
from mjx_nero.learn.play import rollout
from mjx_nero.runs import evaluation, logs, training, videos
from mjx_nero.sim import render
from mjx_nero.sim.physics import host
from mjx_nero.sim.physics.native import NativePhysics
from mjx_nero.tools import cli, train_run
from mjx_nero.types import UserError


def can_draw():
    model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><camera name='front'/></worldbody></mujoco>")
    try:
        with render.Renderer(model, 16, 16):
            return True
    except UserError:
        return False


MISTAKES = [
    (
        "train",
        ["--env", "nero_lfit"],
        f"unknown env 'nero_lfit' (did you mean 'nero_lift'?): choose one of {len(list_envs())}, such as nero_lift",
    ),
    ("train", ["--preset", "isac"], "unknown preset of nero_lift 'isac' (did you mean 'isaac'?): choose one of default, isaac"),
    ("train", ["--env.sim.td", "0.01"], "no field 'sim.td': 'td' is not one of dt, decimation"),
    ("train", ["--env.rewards.reaching_object.params.sdt=1"], "(did you mean 'std'?)"),
    ("train", ["--env.sim.dt", "fast"], "sim.dt takes a finite number, got 'fast'"),
    ("train", ["--env.sim.dt"], "--env.sim.dt needs a value"),
    ("train", ["--ppo.num_epoch", "3"], "(did you mean 'num_epochs'?)"),
    ("train", ["--numenvs", "3"], "unknown argument '--numenvs' (did you mean '--num-envs'?)"),
    ("train", ["--num-envs", "many"], "--num-envs takes a whole number, got 'many'"),
    ("train", ["--num-timesteps", "0"], "at least 1, got '0'"),
    ("train", ["--num-envs", "100"], "num_envs (100) must be a multiple of ppo.num_minibatches (8)"),
    ("train", ["--ppo.network.distribution", "tanh_normal"], "pass --ppo.desired_kl 0"),
    ("train", ["--num-devices", "99"], "num_devices is 99, but JAX finds"),
    ("train", ["--restore", "nowhere"], "no such file: nowhere"),
    ("train", ["--restore", "."], "holds no checkpoint to restore"),
    ("train", ["--out", "/proc/run"], "cannot write to /proc/run"),
    ("eval", ["--env", "nero"], "unknown env 'nero'"),
    ("mjx_nero", ["export", "nero_lfit", "--out", "x.onnx"], "no bundled policy 'nero_lfit' (did you mean 'nero_lift'?)"),
    ("eval", ["--policy", "nowhere.safetensors"], "no such file: nowhere.safetensors"),
    ("eval", ["--policy", "README.md"], "is not a policy or checkpoint of mjx_nero, or it is damaged"),
    ("eval", ["--preset", "isaac"], "was trained on other observations (preset default): pass --preset default"),
    ("eval", ["--agent", "expret"], "'expret' cannot play nero_lift: choose one of policy, expert, pick_up"),
    ("eval", ["--json", "nowhere/result.json"], "cannot write nowhere/result.json"),
    ("eval", ["--json", "."], "--json takes a name that ends in .json, got '.'"),
    ("eval", ["--failures"], "--failures selects the episodes of a video: pass --video FILE.mp4, too"),
    ("eval", ["--video", "v.zzz"], "--video takes a name that ends in .mp4, got 'v.zzz'"),
    ("eval", ["--episodes", "1e12"], "--episodes must be at least 1 and at most 1000000, got '1e12'"),
    ("eval", ["--seed", "18446744073709551616"], "--seed takes a whole number, got '18446744073709551616'"),
    ("eval", ["--seed", "-1"], "--seed must be at least 0 and at most 4294967295, got '-1'"),
    ("train", ["--max-minutes", "nan"], "--max-minutes takes a finite number, got 'nan'"),
    ("train", ["--max-minutes", "inf"], "--max-minutes takes a finite number, got 'inf'"),
    ("train", ["--num-timesteps", "1e999"], "--num-timesteps takes a whole number, got '1e999'"),
    ("train", ["--out", "x" * 300], "--out takes a path with names of at most 255 bytes"),
    ("train", ["--out", "a\0b"], "--out takes a path with names of at most 255 bytes"),
    ("train", ["--env.sim.dt", "1e999"], "sim.dt takes a finite number, got '1e999'"),
    ("train", ["--env.sim.decimation", "1_0"], "sim.decimation takes a whole number, got '1_0'"),
    ("train", ["--ppo.num_epochs", "9" * 400], "num_epochs takes a whole number, got '999"),
    ("eval", ["--backend", "mjx", "--impl", "native"], "--backend mjx cannot play with --impl native: pass only one of them"),
    ("eval", ["--backend", "mujoco", "--impl", "jax"], "--backend mujoco cannot play with --impl jax: pass only one of them"),
]


@pytest.mark.parametrize(("program", "argv", "message"), MISTAKES, ids=[" ".join([p, *a]) for p, a, _ in MISTAKES])
def test_a_mistake_is_one_line(call, tmp_path, program, argv, message):
    (tmp_path / "README.md").write_text("no policy")
    code, out, err = call(program, *argv)
    assert (code, out) == (2, "")
    assert err.startswith("error: ") and err.count("\n") == 1
    assert message in err
    assert [p.name for p in tmp_path.iterdir()] == ["README.md"]


@pytest.mark.parametrize("program", ["train", "eval", "benchmark"])
def test_warp_needs_a_gpu(call, program):
    if jax.default_backend() == "gpu":
        pytest.skip("there is one")
    argv = ["--impl", "warp"] + (["--backend", "mjx"] if program == "eval" else [])
    code, _, err = call(program, *argv)
    assert code == 2 and "impl 'warp' needs an NVIDIA GPU" in err and err.count("\n") == 1


def test_policy_of_another_env(call, tmp_path):
    meta = checkpoint.load_meta(policy.shipped("nero_lift"))
    shipped = policy.load(policy.shipped("nero_lift"))
    checkpoint.save(tmp_path / "other.safetensors", shipped.params, {**meta, "env": "cobotta_lift"})
    code, _, err = call("eval", "--policy", "other.safetensors")
    assert code == 2 and "is a policy of cobotta_lift, not of nero_lift: pass --env cobotta_lift" in err


def test_help_is_complete(call):
    code, out, _ = call("train", "--help")
    assert code == 0
    flags = ("--env", "--preset", "--num-envs", "--num-timesteps", "--seed", "--impl", "--out", "--restore", "--eval-every")
    fields = ("--env.rewards.reaching_object.params.std 0.1", "--env.robot.arm.effort (25.0, ", "--ppo.discounting 0.98")
    assert all(text in out for text in (*flags, *fields))


def test_shared_flags_read_alike_in_every_command(call):
    for program in (["train"], ["eval"], ["benchmark"], ["mjx_nero", "view"]):
        code, out, _ = call(*program, "--help")
        said = " ".join(out.split())
        assert code == 0 and "--load FILE_OR_MODULE Python code that registers its own environments" in said
        assert "--env ENV environment; list-envs lists them all (default: nero_lift)" in said
        assert "--preset PRESET preset of the environment (default: default)" in said
        assert "--robot ROBOT name of another robot, or folder of an imported one (default: the environment's own)" in said


def test_what_a_run_came_to_is_said_before_its_video_is_drawn(call, monkeypatch):
    summary = {"env_steps": 1000, "train_s": 2.0, "steps_per_s": 500, "evaluation": {"success_rate": 0.75}, "folder": "run"}
    summary |= {"nan_count": 0, "overflow_count": 0, "lost": {}, "code": 0}
    monkeypatch.setattr(training, "train", lambda run, command, expert: summary)
    monkeypatch.setattr(training, "film", lambda run, folder, video: print(f"film of {folder}"))
    code, out, _ = call("train", "--out", "run")
    assert code == 0
    first, second, third = out.splitlines()
    assert first == "1,000 env steps in 2 s (500 steps/s), success 75.0%"
    assert second.startswith("run: policy.safetensors, ") and second.endswith("video.mp4 (drawn next)")
    assert third == "film of run"


def test_a_run_tells_what_its_physics_lost(capsys):
    """A thing that is thrown too fast is no NaN, but ends the episode in the same way."""
    summary = {"env_steps": 1000, "train_s": 2.0, "steps_per_s": 500, "evaluation": {"success_rate": 0.75}, "folder": "run"}
    train_run.report({**summary, "nan_count": 1, "overflow_count": 2, "lost": {}}, films=False)
    says = "physics: 1 episodes diverged and ended (NaN, or faster than 1,000 rad/s or m/s), 2 steps with lost contacts"
    assert capsys.readouterr().out.splitlines()[-1] == says


@pytest.mark.parametrize(("best", "says"), [(0.875, True), (0.75, False)])
def test_a_run_that_ends_below_its_best_says_so(best, says, capsys):
    summary = {"env_steps": 1000, "train_s": 2.0, "steps_per_s": 500, "evaluation": {"success_rate": 0.75}, "folder": "run"}
    summary |= {"nan_count": 0, "overflow_count": 0, "lost": {}, "best": {"success_rate": best, "env_steps": 400}}
    train_run.report(summary, films=False)
    assert ("best.safetensors did better: 87.5%, after 400 env steps" in capsys.readouterr().out.splitlines()) == says


def test_eval_of_the_shipped_policy(call, tmp_path):
    code, out, _ = call("eval", "--episodes", 64, "--backend", "mujoco", "--json", "result.json")
    assert code == 0 and "success rate" in out
    result = json.loads((tmp_path / "result.json").read_text())
    assert (result["env"], result["episodes"], result["seed"], result["backend"]) == ("nero_lift", 64, 1, "mujoco")
    assert result["success_rate"] >= 0.9
    assert result["final_distance_median"] < 0.01  # the mean rests on the rare lost cube
    assert result["nan_count"] == 0
    assert result["return_mean"] == pytest.approx(sum(result["return_by_term"].values()), rel=1e-3)


@pytest.mark.parametrize("agent", ["zero", "random"])
def test_agents_that_do_not_know_the_task(call, tmp_path, agent):
    code, _, _ = call("eval", "--agent", agent, "--episodes", 8, "--backend", "mujoco", "--json", "result.json")
    result = json.loads((tmp_path / "result.json").read_text())
    assert code == 0 and result["agent"] == agent and result["success_rate"] == 0.0


def test_video_has_real_frames(call, tmp_path):
    if not can_draw() and not os.environ.get("CI"):
        pytest.skip("no offscreen OpenGL")
    code, out, _ = call(
        "eval", "--episodes", 1, "--backend", "mujoco", "--video", "lift.mp4", "--video-size", "640x360", "--video-fps", 10
    )
    assert code == 0 and "video: lift.mp4" in out
    frames = imageio.imread(tmp_path / "lift.mp4")
    assert frames.shape == (50, 360, 640, 3)  # every fifth of 250 steps
    assert frames[0].std() > 20  # a picture, not a blank
    assert abs(frames[0].astype(int) - frames[20]).max() > 100  # and things move in it


def test_a_video_of_failures_shows_them_alone(call, tmp_path, monkeypatch):
    """Of the episodes that play, the second and the fourth fail."""
    drawn = []
    monkeypatch.setattr(videos, "write_episodes", lambda path, model, qpos, scenery, *_: drawn.append((qpos, scenery.goal_pos_w)))
    played = evaluation.play
    succeeds = np.array([True, False, True, False])
    monkeypatch.setattr(rollout.Episodes, "success", property(lambda self: succeeds))

    def play(cfg):
        result = played(cfg)
        drawn.append((result.episodes.qpos, result.episodes.scenery.goal_pos_w))
        return result

    monkeypatch.setattr(evaluation, "play", play)
    flags = ["--agent", "zero", "--backend", "mujoco", "--video", "lift.mp4", "--failures"]
    code, out, _ = call("eval", "--episodes", 4, *flags)
    assert code == 0 and "video: lift.mp4" in out
    for played_ones, shown in zip(*drawn, strict=True):
        assert played_ones.shape[1] == 4
        np.testing.assert_array_equal(shown, played_ones[:, [1, 3]])
    drawn.clear()
    succeeds = np.ones(4, bool)
    code, out, _ = call("eval", "--episodes", 4, *flags)
    assert code == 0 and out.rstrip().endswith("no video: no episode failed") and len(drawn) == 1


def test_without_opengl_all_but_the_video(call, tmp_path, without_opengl):
    code, out, err = call(
        "eval", "--agent", "zero", "--episodes", 1, "--backend", "mujoco", "--video", "lift.mp4", "--json", "r.json"
    )
    assert code == 2 and "success rate" in out and "install libegl1" in err
    assert [p.name for p in tmp_path.iterdir()] == ["r.json"]


def test_compiled_code_is_kept_in_the_users_cache(monkeypatch, tmp_path):
    names = ("jax_default_matmul_precision", "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "kept"))
    monkeypatch.delenv("JAX_COMPILATION_CACHE_DIR", raising=False)
    monkeypatch.setenv("WARP_CACHE_PATH", "to be put back")
    monkeypatch.delenv("WARP_CACHE_PATH")
    try:
        cli.setup_jax()
        assert jax.config.jax_compilation_cache_dir == str(tmp_path / "kept/mjx_nero/jax")
        assert os.environ["WARP_CACHE_PATH"] == str(tmp_path / "kept/mjx_nero/warp")
        monkeypatch.setenv("WARP_CACHE_PATH", "/of/the/user")
        monkeypatch.setenv("JAX_COMPILATION_CACHE_DIR", "/of/the/user")
        jax.config.update("jax_compilation_cache_dir", "/of/the/user")
        cli.setup_jax()
        assert jax.config.jax_compilation_cache_dir == os.environ["WARP_CACHE_PATH"] == "/of/the/user"
    finally:
        for name, value in before.items():
            jax.config.update(name, value)


def test_too_many_environments_leave_nothing_behind(call, tmp_path):
    code, out, err = call("train", "--num-envs", 8_388_608, "--out", "run")
    assert (code, out, list(tmp_path.iterdir())) == (2, "", [])
    assert err.startswith("error: 8388608 environments need about ") and err.count("\n") == 1
    assert "or fewer" in err


@pytest.mark.skipif(jax.default_backend() != "cpu", reason="a machine without an accelerator")
def test_what_a_machine_without_a_gpu_trains():
    def fitted(name, fields=None, **rest):
        run, note = training.fit_machine(training.resolve(name, "default", None, {}, fields or {}, **rest))
        return run.num_envs, run.num_timesteps, run.max_minutes, note

    assert fitted("nero_lift")[:3] == (256, 10_000_000, 10)
    assert fitted("nero_reach", max_minutes=3.0)[:3] == (256, 2_000_000, 3)
    assert "256 environments for 2 M steps, at most 3 minutes" in fitted("nero_reach", max_minutes=3.0)[3]
    assert fitted("nero_lift", {"num_envs": 64, "num_timesteps": 5}) == (64, 5, 0, "")
    assert fitted("nero_push")[:3] == (256, 10_000_000, 10)  # its own 300 M steps are for a GPU
    assert fitted("nero_push", {"num_timesteps": 400_000_000})[1:] == (400_000_000, 0, "")


def test_a_gpu_trains_for_as_long_as_the_task_needs(monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    for name, steps in (("nero_lift", 100_000_000), ("nero_reach", 60_000_000), ("nero_push", 150_000_000)):
        run, note = training.fit_machine(training.resolve(name, "default", None, {}, {}))
        assert (run.num_envs, run.num_timesteps, run.max_minutes, note) == (8192, steps, 0, "")


def test_ctrl_c_while_native_physics_runs(call, tmp_path, monkeypatch):
    """JAX wraps what happens in a callback in an error of its own. One signal: a second would come when the program has ended."""
    sent = []

    def step(self, packed, result):
        if not sent:
            sent.append(signal.SIGINT)
            os.kill(os.getpid(), signal.SIGINT)
        result.fill(0.0)

    monkeypatch.setattr(NativePhysics, "_step", step)
    monkeypatch.setattr(host, "_known", {})  # the physics of tests before
    code, out, err = call("eval", "--agent", "zero", "--episodes", 8, "--impl", "native", "--json", "result.json")
    assert (code, out, list(tmp_path.iterdir())) == (130, "", [])
    assert err.endswith("interrupted\n") and "Traceback" not in err


@pytest.mark.slow
def test_a_run_from_start_over_ctrl_c_to_its_end(call, tmp_path, monkeypatch):
    write, rows = logs.Logs.write, []

    def write_and_interrupt(self, row):
        write(self, row)
        rows.append(row)
        if len(rows) == 2:
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(logs.Logs, "write", write_and_interrupt)
    sizes = ["--num-envs", 64, "--no-video"]
    code, out, err = call("train", *sizes, "--num-timesteps", 100_000, "--seed", 3, "--out", "run")
    run = tmp_path / "run"
    assert code == 130
    assert "resume with: python train.py --restore run" in err
    config = json.loads((run / "config.json").read_text())
    assert (config["env_name"], config["seed"], config["hyperparameters"]["num_envs"]) == ("nero_lift", 3, 64)
    saved = sorted((run / "checkpoints").iterdir())
    assert saved and not list(run.rglob("*.part"))

    code, _, err = call("train", *sizes, "--out", "run")
    assert code == 2 and "run already holds a run: pass another --out, or --restore run" in err

    stopped = int(rows[-1]["steps"])
    code, out, _ = call("train", *sizes, "--num-timesteps", stopped + 3072, "--seed", 3, "--restore", "run")
    assert code == 0 and f"{stopped + 3072:,} env steps" in out
    history = [json.loads(line) for line in (run / "metrics.jsonl").read_text().splitlines()]
    steps = [row["steps"] for row in history]
    assert steps == sorted(set(steps)) and steps[0] == 0 and steps[-1] == stopped + 3072
    assert {"train/return", "reward/reaching_object", "nan_count", "steps_per_s"} <= history[-1].keys()
    assert imageio.imread(run / "curve.png").std() > 5
    assert list((run / "tensorboard").glob("events*"))
    summary = json.loads((run / "summary.json").read_text())
    assert summary["nan_count"] == 0 and summary["evaluation"]["episode_length_mean"] == 250

    code, out, _ = call("eval", "--policy", "run/policy.safetensors", "--episodes", 4, "--backend", "mujoco")
    assert code == 0 and "success rate" in out

    code, _, err = call("train", *sizes, "--num-timesteps", stopped, "--restore", "run")
    assert code == 2 and "has already made its" in err and "pass a larger --num-timesteps" in err
    code, _, err = call("train", "--num-envs", 32, "--restore", "run", "--out", "other")
    assert code == 2 and "does not fit" in err and not (tmp_path / "other").exists()
    shutil.rmtree(run)
