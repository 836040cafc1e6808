"""The benchmark as a user calls it: rows, files, mistakes, and what is left when it is interrupted or memory ends."""

import json
import os
import signal
import types
from importlib import metadata

import imageio.v3 as imageio
import jax
import jax.numpy as jnp
import mujoco
import pytest

import mjx_nero
from mjx_nero.runs import compiled
from mjx_nero.sim.physics.warp.mujoco_warp import WarpPhysics
from mjx_nero.tools.benchmark import command, drawing, learning, machine, plot, throughput
from mjx_nero.tools.benchmark.program import Program, spread, warp_mb

MISTAKES = [
    (["--impl", "cuda"], "unknown impl cuda: choose from auto, warp, jax, native"),
    (["--what", "everything"], "unknown what everything: choose from physics, step"),
    (["--what", ","], "unknown what (none)"),
    (["--num-envs", "8,x"], "--num-envs takes a whole number, got 'x'"),
    (["--num-envs", "0"], "--num-envs must be at least 1, got '0'"),
    (["--batch", "10,"], "--batch takes a whole number, got ''"),
    (["--repeats", "none"], "--repeats takes a whole number, got 'none'"),
    (["--target", "95"], "--target must be above 0 and at most 1, got '95'"),
    (["--target", "most"], "--target takes a finite number, got 'most'"),
    (["--seeds", "-1"], "--seeds must be at least 1, got '-1'"),
    (["--env", "nero_lft"], "unknown env 'nero_lft' (did you mean 'nero_lift'?)"),
    (["--env", "reach"], "reach is for any robot: pass one (--robot"),
    (["--env", "nero_push", "--what", "control"], "'expert' cannot play nero_push: choose policy, it has no expert"),
    (["--what", "step,ppo", "--num-envs", "8,12"], "num_envs (12) must be a multiple of ppo.num_minibatches (8)"),
    (["--what", "learning", "--num-envs", "12"], "num_envs (12) must be a multiple of ppo.num_minibatches (8)"),
    (["--what", "ppo", "--num-envs", "8", "--num-devices", "99"], "num_devices is 99, but JAX finds"),
    (["--json", "nowhere/rows.json"], "cannot write nowhere/rows.json"),
    (["--plot", "nowhere/rows.png"], "cannot write nowhere/rows.png"),
    (["--plot", "rows.jpeg"], "--plot takes a name that ends in .png, got 'rows.jpeg'"),
    (["--plot", "ik.png", "--what", "ik"], "--plot draws only physics, step, ppo, control, reset: name one of them in --what"),
    (["--faster"], "unknown argument '--faster'"),
    (["--what", "learning", "--ppo.learning_rte", "1"], "learning_rte"),
    (["--what", "ppo", "--ppo.max_learning_rate", "2"], "max_learning_rate"),
    (["--env.sim.dtt", "0.1"], "sim.dtt"),
]


@pytest.mark.parametrize(("argv", "message"), MISTAKES, ids=[" ".join(argv) for argv, _ in MISTAKES])
def test_a_mistake_is_one_line(call, tmp_path, argv, message):
    code, out, err = call("benchmark", *argv)
    assert (code, out) == (2, "")
    assert err.startswith("error: ") and err.count("\n") == 1
    assert message in err
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_rows_json_and_plot(call, tmp_path):
    sizes = ["--num-envs", "8", "--impl", "native", "--steps", 4, "--repeats", 3]
    files = ["--json", tmp_path / "rows.json", "--plot", "rows.png"]
    code, out, err = call("benchmark", "--what", "physics,step,reset", *sizes, *files)
    assert code == 0 and "env_steps_per_s" in out and "resets_per_s" in out
    assert [line.split("  ")[0] for line in err.splitlines()] == ["what physics", "what step", "what reset"]
    report = json.loads((tmp_path / "rows.json").read_text())
    for row in report["rows"]:
        rate = "resets_per_s" if row["what"] == "reset" else "env_steps_per_s"
        assert (row["env"], row["impl"], row["num_envs"]) == ("nero_lift", "native", 8)
        assert 0 < row[f"{rate}_min"] <= row[rate] <= row[f"{rate}_max"]
        assert row["compile_s"] > 0 and row["memory_mb"] >= 0 and row["warp_mb"] is None
    physics, step, _ = report["rows"]
    assert step["nan_count"] == step["overflow_count"] == physics["overflow_count"] == 0
    assert abs(step["physics_steps_per_s"] - 2 * step["env_steps_per_s"]) <= 1  # two physics steps a control step; both rounded
    assert report["complete"] is True
    assert report["command"].endswith("--repeats 3 --json rows.json --plot rows.png")
    assert report["machine"].keys() == {"device", "devices", "platform", "cpu", "cores", "memory_gb", "os"}
    assert report["machine"]["device"] == jax.devices()[0].device_kind and report["machine"]["memory_gb"] > 0
    assert {"python", "jax", "jaxlib", "mujoco", "mujoco-mjx", "brax", "numpy", "mjx-nero"} <= report["versions"].keys()
    assert report["versions"]["mujoco"] == mujoco.__version__ and report["versions"]["jax"] == jax.__version__
    assert str(tmp_path) not in (tmp_path / "rows.json").read_text()
    assert imageio.imread(tmp_path / "rows.png").std() > 5
    assert len(list(tmp_path.iterdir())) == 2


def test_a_checkout_that_is_not_installed_has_a_version(monkeypatch):
    def version(name):
        if name == "mjx-nero":
            raise metadata.PackageNotFoundError(name)
        return "1.0"

    monkeypatch.setattr(metadata, "version", version)
    assert machine.versions()["mjx-nero"] == mjx_nero.__version__


def test_the_command_names_no_folder():
    argv = ["--robot", "/home/somebody/my_arm/", "--json=/tmp/x/rows.json", "--plot", "./a.png", "--num-envs", "8,16"]
    expected = "python -m mjx_nero benchmark --robot my_arm --json=rows.json --plot a.png --num-envs 8,16"
    assert command.command(argv) == expected


@pytest.fixture
def scripted(monkeypatch):
    """Makes each measurement of throughput what a function of (what, num_envs) says: a rate, or an error to raise."""

    def use(script):
        def measure(what, env, make, repeats):
            found = script(what, env.num_envs)
            if isinstance(found, BaseException):
                raise found
            row = {"what": what, "impl": env.impl, "num_envs": env.num_envs, "memory_mb": env.num_envs / 64}
            return row | spread("env_steps_per_s", [found - 10.0, found + 0.0, found + 20.0])

        monkeypatch.setattr(throughput, "measure", measure)

    return use


@pytest.mark.parametrize(("error", "code"), [(KeyboardInterrupt(), 130), (ZeroDivisionError("a bug"), 1)])
def test_what_was_measured_survives(call, tmp_path, scripted, error, code):
    scripted(lambda what, n: error if n == 32 else 1000 * n)
    argv = ["--num-envs", "8,16,32,64", "--impl", "jax", "--json", "rows.json", "--plot", "rows.png"]
    if code == 1:  # a bug ends in its traceback, after the files
        with pytest.raises(ZeroDivisionError):
            call("benchmark", *argv)
    else:
        status, out, err = call("benchmark", *argv)
        assert status == code and "stopped after 2 rows, which are kept" in err
        assert "8,000 (7,990 to 8,020)" in out and "16,000" in out
    report = json.loads((tmp_path / "rows.json").read_text())
    assert report["complete"] is False
    assert [(row["num_envs"], row["env_steps_per_s"]) for row in report["rows"]] == [(8, 8000), (16, 16000)]
    assert sorted(p.name for p in tmp_path.iterdir()) == ["rows.json", "rows.png"]


def test_stopped_before_the_first_row(call, tmp_path, scripted):
    scripted(lambda what, n: KeyboardInterrupt())
    code, out, err = call("benchmark", "--impl", "jax", "--json", "rows.json", "--plot", "rows.png")
    assert (code, out) == (130, "") and "stopped after 0 rows\n" in err
    assert not list(tmp_path.iterdir())


def test_out_of_memory_is_a_row(call, tmp_path, scripted):
    full = RuntimeError("RESOURCE_EXHAUSTED: Out of memory while trying to allocate 1 byte.\nmore")
    scripted(lambda what, n: full if what == "physics" and n >= 16 else 1000 * n)
    code, out, _ = call("benchmark", "--what", "physics,step", "--num-envs", "32,16,8", "--impl", "jax", "--json", "rows.json")
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert code == 0 and "out of memory" in out
    assert [(row["what"], row["num_envs"], row.get("note", "")[:15]) for row in rows] == [
        *(("physics", 32, "out of memory: "), ("physics", 16, "out of memory: "), ("physics", 8, "")),
        *(("step", 32, ""), ("step", 16, ""), ("step", 8, "")),
    ]
    assert rows[0]["note"] == "out of memory: RESOURCE_EXHAUSTED: Out of memory while trying to allocate 1 byte."
    call("benchmark", "--what", "physics", "--num-envs", "8,16,32", "--impl", "jax", "--json", "rows.json")
    notes = [row.get("note") for row in json.loads((tmp_path / "rows.json").read_text())["rows"]]
    assert notes[0] is None and notes[1].startswith("out of memory: ") and notes[2] == "not run: out of memory at 16"


def test_plot_has_a_line_for_each(tmp_path, monkeypatch):
    from matplotlib.figure import Figure

    figures = []
    monkeypatch.setattr(Figure, "savefig", lambda self, *_, **__: figures.append(self))
    kinds = (("step", "jax", 10.0), ("step", "native", 100.0), ("ppo", "native", 20.0))
    sizes = [{"what": a, "impl": b, "num_envs": n, "memory_mb": n / 8, "k": n * k} for a, b, k in kinds for n in (64, 8)]
    rows = [row | spread("env_steps_per_s", [row["k"], 2 * row["k"], 4 * row["k"]]) for row in sizes]
    rows += [{"what": "step", "impl": "jax", "num_envs": 512, "note": "out of memory"}, {"what": "ik", "batch": 5}]
    plot.plot(rows, "a machine", tmp_path / "rows.png")
    (figure,) = figures
    speed, memory = figure.axes
    assert figure.get_suptitle() == "a machine"
    assert (speed.get_xscale(), speed.get_yscale()) == ("log", "log")
    assert [text.get_text() for text in speed.get_legend().get_texts()] == ["step, jax", "step, native", "ppo, native"]
    line, _, (bars,) = speed.containers[1]
    assert line.get_xydata().tolist() == [[8, 1600], [64, 12800]]
    assert [[y for _, y in segment.vertices] for segment in bars.get_paths()] == [[800, 3200], [6400, 25600]]
    assert memory.lines[0].get_xydata().tolist() == [[8, 1], [64, 8]]


class Runs:
    """A learner of ten steps an iteration that only counts, and an evaluator that reads its success from a list a seed."""

    steps_per_iteration = 10
    num_devices = 2  # programs of several devices are not kept
    env = types.SimpleNamespace(unwrapped=types.SimpleNamespace(impl="native"))

    def __init__(self, success):
        self.success = success

    def init(self, key):
        return {"seed": key[-1], "iteration": jnp.zeros((), jnp.int32)}  # a raw key ends with its seed

    def run(self, state, iterations):
        nans = jnp.where(state["iteration"] == 0, 0.5, 0.0)  # a mean over the iterations
        return {**state, "iteration": state["iteration"] + iterations}, {"sum/nan": nans, "sum/overflow": jnp.zeros(())}

    @staticmethod
    def compiled(run, runs, chunk, start, programs, trace):
        return compiled.Compiled(runs, chunk, lambda state: runs.run(state, chunk), start(), runs.evaluate, 0.0)

    def evaluate(self, state):
        return {"success_rate": self.success[int(state["seed"])][int(state["iteration"]) // 2]}


def test_learning_of_several_seeds(call, tmp_path, monkeypatch):
    """Evaluations come every 20 steps; of three seeds one succeeds at the second, one at the first, one never."""
    runs = Runs([[0.0, 0.5, 0.95, 1.0, 1.0], [0.2, 1.0, 0.0, 0.0, 0.0], [0.0, 0.1, 0.2, 0.9, 0.94]])
    asked = []
    monkeypatch.setattr(compiled, "make_learner", lambda run: asked.append(run) or runs)
    monkeypatch.setattr(compiled.Fresh, "placed", lambda self, seed: runs.init(jax.random.PRNGKey(seed)))
    monkeypatch.setattr(compiled, "compile", Runs.compiled)
    argv = ["--what", "learning", "--num-envs", 8, "--impl", "native", "--seeds", 3, "--num-timesteps", 70, "--eval-every", 29]
    fields = ["--ppo.max_learning_rate", "5e-4", "--env.episode_length_s", "2"]
    code, out, _ = call("benchmark", *argv, *fields, "--json", "rows.json")
    assert asked[0].hyperparameters.max_learning_rate == 5e-4 and asked[0].env.episode_length_s == 2
    *seeds, summary = json.loads((tmp_path / "rows.json").read_text())["rows"]
    assert code == 0 and "2 of 3" in out and "median 40, worst never" in out
    found = [(r["seed"], r["reached"], r["env_steps"], r["success_rate"], r["nan_count"]) for r in seeds]
    assert found == [(0, True, 40, 0.95, 1), (1, True, 20, 1.0, 1), (2, False, 80, 0.94, 1)]
    assert all(0 <= r["evaluation_s"] <= r["seconds"] for r in seeds)
    assert (summary["seed"], summary["seeds"], summary["reached"], summary["target"]) == ("all", 3, 2, 0.95)
    assert (summary["env_steps_median"], summary["env_steps_worst"]) == (40, None)  # of 20, 40 and never
    assert summary["seconds_worst"] is None


def test_learning_goes_on_with_the_seeds_that_are_missing(call, tmp_path, monkeypatch):
    """A kill in seed 1 keeps seed 0; the same command trains the others, another command all."""
    runs, begun = Runs([[0.0, 1.0]] * 3), []
    monkeypatch.setattr(compiled, "make_learner", lambda run: runs)
    monkeypatch.setattr(compiled.Fresh, "placed", lambda self, seed: begun.append(seed) or runs.init(jax.random.PRNGKey(seed)))
    monkeypatch.setattr(compiled, "compile", Runs.compiled)
    argv = [
        "--what",
        "learning",
        "--num-envs",
        8,
        "--impl",
        "native",
        "--num-timesteps",
        70,
        "--eval-every",
        29,
        "--json",
        "r.json",
    ]
    whole, evaluate = Runs.evaluate, lambda self, state: os.kill(os.getpid(), signal.SIGTERM) or {"success_rate": 0.0}
    monkeypatch.setattr(Runs, "evaluate", lambda self, state: (evaluate if int(state["seed"]) == 1 else whole)(self, state))
    code, _, err = call("benchmark", *argv, "--seeds", 3)
    assert code == 128 + signal.SIGTERM and "stopped after 1 rows, which are kept" in err and "Traceback" not in err
    assert [row["seed"] for row in json.loads((tmp_path / "r.json").read_text())["rows"]] == [0]
    monkeypatch.setattr(Runs, "evaluate", whole)
    begun.clear()
    code, out, _ = call("benchmark", *argv, "--seeds", 3)
    assert code == 0 and begun[1:] == [1, 2] and "3 of 3" in out  # the first state is the one to compile with
    assert [row["seed"] for row in json.loads((tmp_path / "r.json").read_text())["rows"]] == [0, 1, 2, "all"]
    begun.clear()
    assert call("benchmark", *argv, "--seeds", 2)[0] == 0 and begun[1:] == [0, 1]


def test_summary_of_seeds():
    rows = [{"reached": True, "seconds": s, "env_steps": n} for s, n in ((3.0, 30), (1.0, 20), (2.0, 50), (8.0, 40))]
    expected = {"seconds_median": 2.5, "seconds_worst": 8.0, "env_steps_median": 35, "env_steps_worst": 50}
    assert learning.summary(rows) == {"seed": "all", "seeds": 4, "reached": 4, **expected}


def test_render_without_opengl(env, without_opengl):
    row = drawing.measure_render(env, 2, 2)
    assert row["note"].startswith("no offscreen OpenGL here") and "frames_per_s" not in row


def test_a_program_counts_and_goes_on():
    program = Program.compiled(lambda state, key: (state + 1, {"nan": state}), lambda: jnp.zeros(()), work=6)
    assert program.counts == {} and program.compile_s > 0  # the first call, with state 0, does not count
    rates = program.rates(3)
    assert len(rates) == 3 and min(rates) > 0
    assert program.counts == {"nan": 1.0 + 2.0 + 3.0}


def test_memory_of_warp(env):
    physics = object.__new__(WarpPhysics)  # making one needs Warp
    physics._bytes = 2**18
    assert warp_mb(types.SimpleNamespace(footprint=physics.footprint, num_envs=12)) == 3.0
    assert warp_mb(env) is None


@pytest.mark.slow
def test_the_stages_of_a_start(call, tmp_path):
    argv = [
        "--what",
        "start",
        "--env",
        "nero_reach",
        "--num-envs",
        "8",
        "--impl",
        "native",
        "--json",
        str(tmp_path / "rows.json"),
    ]
    assert call("benchmark", *argv)[0] == 0
    rows = json.loads((tmp_path / "rows.json").read_text())["rows"]
    stages = {caches: {row["stage"]: row for row in rows if row["caches"] == caches} for caches in ("empty", "filled")}
    assert set(stages["empty"]) == set(stages["filled"])
    for found in stages.values():
        assert (
            found["until the first training step"]["seconds"]
            == found["first iterations"]["begins_s"]
            > found["imports"]["seconds"]
        )
    compiled = {caches: found["until the first training step"]["compiled"] for caches, found in stages.items()}
    assert compiled["empty"] > 3 and compiled["filled"] == 0
