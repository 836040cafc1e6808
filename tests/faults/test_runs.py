"""Runs that something goes wrong with: what is lost, what is said, and that the same command goes on."""

import errno
import json
import os
import resource
import shutil
import signal

import pytest
from faults_run import CHUNK, STEPS, last, rows
from waiting import wait

from mjx_nero import files
from mjx_nero.learn import checkpoint
from mjx_nero.runs import compiled, loop
from mjx_nero.runs import folder as run_folder

# --- nothing goes wrong


def test_what_a_run_leaves(train, tmp_path):
    code, out, err = train("--out", "run", "--keep", 2)
    run = tmp_path / "run"
    assert code == 0, err
    saved = sorted(p.name for p in (run / "checkpoints").iterdir())
    best = json.loads((run / "summary.json").read_text())
    newest = {f"{steps:012d}.safetensors" for steps in (512, 640)}
    assert newest <= set(saved) and len(saved) <= 3 and best["env_steps"] == STEPS
    assert best["best"]["success_rate"] >= best["evaluation"]["success_rate"] and best["best"]["env_steps"] <= STEPS
    names = {"best.safetensors", "checkpoints", "config.json", "curve.png", "metrics.jsonl", "policy.safetensors", "summary.json"}
    assert {p.name for p in run.iterdir()} == names | {"tensorboard"}
    assert [row["steps"] for row in rows(run)] == list(range(0, STEPS + 1, CHUNK))
    assert all(b["wall_s"] >= a["wall_s"] for a, b in zip(rows(run), rows(run)[1:], strict=False))


@pytest.mark.parametrize("draws", [False, True])
def test_training_begins_before_its_first_evaluation(train, monkeypatch, tmp_path, undisturbed, draws):
    """Unless it draws pictures. What comes of it is the same."""
    order = []

    def noted(name, call):
        return lambda state: (order.append(name), call(state))[1]

    def compile(*given, original=compiled.compile):
        made = original(*given)
        own = {name: noted(name, getattr(made, name)) for name in ("advance", "evaluate")}
        return compiled.dataclasses.replace(made, **own)

    monkeypatch.setattr(compiled, "compile", compile)
    monkeypatch.setattr(loop.Loop, "_draws", property(lambda self: draws))
    code, _, err = train("--out", "run")
    assert code == 0, err
    assert order[:3] == (["evaluate", "advance", "advance"] if draws else ["advance", "evaluate", "advance"])
    assert last(tmp_path / "run") == undisturbed


# --- logs are expendable


def test_logs_that_cannot_be_written(train, at_row, tmp_path):
    def spoil():
        (tmp_path / "run" / "metrics.jsonl").unlink()
        (tmp_path / "run" / "metrics.jsonl").mkdir()

    at_row(2, spoil)
    code, out, err = train("--out", "run")
    assert code == 0 and err.count("warning: cannot write metrics.jsonl in run (Is a directory): training continues") == 1
    lost = json.loads((tmp_path / "run" / "summary.json").read_text())["lost"]
    assert lost["metrics.jsonl"] == 9 and "9 x metrics.jsonl" in out


def test_tensorboard_that_cannot_be_written(train, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "tensorboard").write_text("in the way")
    code, _, err = train("--out", "run")
    assert code == 0 and err.count("warning") == 1 and "cannot write tensorboard" in err
    assert len(rows(tmp_path / "run")) == 11 and (tmp_path / "run" / "curve.png").exists()


def test_a_folder_that_is_removed(train, at_row, tmp_path):
    def remove():
        while (tmp_path / "run").exists():  # a checkpoint may be on its way into it
            shutil.rmtree(tmp_path / "run", ignore_errors=True)

    at_row(3, remove)
    code, _, err = train("--out", "run")
    assert code == 0, err
    assert (tmp_path / "run" / "policy.safetensors").exists() and (tmp_path / "run" / "summary.json").exists()


# --- checkpoints are not


@pytest.mark.parametrize("moment", [1, 2, 4, 6, 8, 10])
def test_a_full_disk(train, at_row, undisturbed, tmp_path, moment):
    """A limit on the size of files: rows of metrics are lost, checkpoints are not written, and it ends in a line."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill():
        if moment > 1:  # the first checkpoint is written beside the training
            wait(lambda: any((tmp_path / "run" / "checkpoints").glob("*.safetensors")))
        resource.setrlimit(resource.RLIMIT_FSIZE, (6000, hard))

    at_row(moment, fill)
    try:
        code, _, err = train("--out", "run")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    *_, line = err.splitlines()
    assert code == 2 and line.startswith("error: cannot write run/") and "File too large: stopped at" in line
    if moment > 1:
        assert "the last good checkpoint is run/checkpoints/0000" in line
        assert line.endswith("Make room and resume with: python train.py --restore run")
    else:
        assert line.endswith("without a checkpoint. Make room, remove run and start again")
    assert not list((tmp_path / "run").rglob("*.part*"))
    code, _, err = train("--out", "run", "--resume", "auto")
    assert code == 0, err
    assert last(tmp_path / "run") == undisturbed


def test_a_disk_too_small_for_a_first_checkpoint(train, tmp_path):
    """The settings fit, and no checkpoint does: nothing can be resumed, and the line does not say so."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, hard))
    try:
        code, _, err = train("--out", "run")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    *_, line = err.splitlines()
    assert code == 2 and line.startswith("error: cannot write run/checkpoints/") and "--restore" not in line
    assert line.endswith("without a checkpoint. Make room, remove run and start again")
    assert not list((tmp_path / "run" / "checkpoints").iterdir())


def test_a_disk_that_is_full_at_the_start(train, tmp_path, monkeypatch):
    def full(_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(files, "sync", full)
    code, _, err = train("--out", "run")
    assert code == 2 and "error: cannot write run/config.json: No space left on device" in err
    assert not (tmp_path / "run").exists()


def test_checkpoints_by_the_minute_and_how_many_stay(train, tmp_path):
    """One after every chunk of 64 steps, where each takes longer than the minutes say; the newest two stay, and the best."""
    code, _, err = train("--out", "run", "--checkpoint-minutes", 1e-9, "--keep", 2)
    assert code == 0, err
    steps = [int(path.stem) for path in sorted((tmp_path / "run" / "checkpoints").glob("*.safetensors"))]
    best = checkpoint.load_meta(tmp_path / "run" / "best.safetensors")["env_steps"]
    assert steps == sorted({STEPS - CHUNK, STEPS, best})


def test_rows_are_thinned(train, monkeypatch, tmp_path):
    """However long a run is, the rows of its metrics are so many, beside those of its evaluations."""
    monkeypatch.setattr(loop, "_ROWS", 2)
    code, _, err = train("--out", "run", "--eval-every", 10 * STEPS)
    assert code == 0, err
    assert [row["steps"] for row in rows(tmp_path / "run")] == [0, STEPS // 2, STEPS]


# --- signals


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP", "SIGUSR1"])
def test_a_signal_saves_and_nothing_is_lost(train, at_row, undisturbed, tmp_path, name):
    number = getattr(signal, name)
    at_row(4, lambda: os.kill(os.getpid(), number))
    code, out, err = train("--out", "run")
    assert code == 128 + number and "resume with: python train.py --restore run" in err
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["stopped"] == "interrupted"
    stopped = rows(tmp_path / "run")
    code, _, err = train("--restore", "run", steps=0)
    assert code == 0, err
    assert last(tmp_path / "run") == undisturbed
    assert rows(tmp_path / "run")[: len(stopped)] == stopped  # appended to
    assert [row["steps"] for row in rows(tmp_path / "run")] == list(range(0, STEPS + 1, CHUNK))


def test_a_signal_before_the_first_update_makes_none(train, at_row, undisturbed, tmp_path):
    at_row(1, lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert train("--out", "run")[0] == 143
    assert [row["steps"] for row in rows(tmp_path / "run")] == [0]
    code, _, err = train("--restore", "run", steps=0)
    assert code == 0 and last(tmp_path / "run") == undisturbed, err


def test_a_signal_is_not_kept_waiting_by_an_evaluation(train, at_row, tmp_path):
    """An evaluation with pictures may take minutes; the next one is due at the end of the run."""
    at_row(2, lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert train("--out", "run", "--eval-every", 10 * STEPS)[0] == 143
    assert [(row["steps"], "eval/success_rate" in row) for row in rows(tmp_path / "run")] == [
        (0, True),
        (CHUNK, False),
        (2 * CHUNK, False),
    ]


def test_a_signal_during_compilation_leaves_nothing(train, monkeypatch, tmp_path):
    def compile(*_):
        os.kill(os.getpid(), signal.SIGTERM)
        raise AssertionError("it went on")

    monkeypatch.setattr(compiled, "compile", compile)
    for flags in (["--out", "run"], []):
        code, out, err = train(*flags)
        assert (code, out, list(tmp_path.iterdir())) == (143, "", []) and err.endswith("interrupted\n")


# --- going on


def test_one_command_starts_goes_on_and_is_done(train, at_row, undisturbed, tmp_path, monkeypatch):
    command = ["--out", "run", "--resume", "auto"]
    run = tmp_path / "run"
    with monkeypatch.context() as patch:  # killed before its first checkpoint: config.json is there, and no more
        patch.setattr(loop.Loop, "__call__", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        assert train(*command)[0] == 130
    assert (run / "config.json").exists() and not (run / "checkpoints").exists()
    with monkeypatch.context() as patch:  # killed half-way
        patch.setattr(loop.Loop, "_save", stopping_at(256, loop.Loop._save))
        assert train(*command)[0] == 130
    code, _, err = train(*command)
    assert code == 0 and last(run) == undisturbed, err
    (run / "summary.json").unlink()  # killed between the last checkpoint and the summary
    for _ in range(2):
        code, out, err = train(*command)
        assert code == 0 and "has already made its 640 steps" in err and "nothing is left to do" in err
        assert "640 env steps" in out
    assert json.loads((run / "summary.json").read_text())["env_steps"] == STEPS
    code, _, err = train("--restore", "run", steps=0)
    assert code == 2 and "has already made its 640 steps: pass a larger --num-timesteps" in err


def stopping_at(steps, save):
    def stopped(self, state):
        save(self, state)
        if self.tally.steps == steps:
            self.checkpoints.wait()
            raise KeyboardInterrupt

    return stopped


def test_damaged_checkpoints_are_passed_over(train, undisturbed, tmp_path):
    assert train("--out", "run", steps=384)[0] == 0
    *older, newest = sorted((tmp_path / "run" / "checkpoints").iterdir())
    newest.write_bytes(newest.read_bytes()[:-100])
    (newest.parent / f".{newest.stem}.part.safetensors").write_text("half of one")
    code, _, err = train("--restore", "run", "--num-timesteps", STEPS, steps=0)
    assert code == 0 and f"warning: run/checkpoints/{newest.name} is damaged: using" in err
    assert "run resumes with num_timesteps 640 instead of 384" in err
    assert last(tmp_path / "run") == undisturbed
    assert not list((tmp_path / "run").rglob("*.part*"))


REFUSED = [
    (
        ["--seed", 4],
        "--seed is 4, but run is a run with 0: leave the flag out to resume that run, or start a new one with",
    ),
    (["--env", "nero_reach"], "--env is nero_reach, but run is a run with nero_lift"),
    (["--num-envs", 16], "--num-envs is 16, but run is a run with 8"),
    (["--ppo.learning_rate", 0.1], "--ppo.learning_rate is 0.1, but run is a run with 0.0003"),
    (["--env.sim.iterations", 7], "--env.sim.iterations is 7, but run is a run with 10"),
]


def test_another_run_is_refused_by_the_name_of_the_flag(call, train, tmp_path):
    assert train("--out", "run", steps=128)[0] == 0
    before = (tmp_path / "run" / "config.json").read_bytes()
    for flags, message in REFUSED:
        code, _, err = call("train", "--restore", "run", *flags)
        assert code == 2 and message in err, err
    assert (tmp_path / "run" / "config.json").read_bytes() == before
    code, _, err = call("train", "--restore", "run", "--seed", 0, "--no-video", "--num-timesteps", 256, "--max-minutes", 5)
    assert code == 0 and "run resumes with num_timesteps 256 instead of 128, max_minutes 5.0 instead of 0.0" in err
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["hyperparameters"]["num_timesteps"] == 256 and config["hyperparameters"]["network"]["actor"] == [8]


def test_minutes_go_on(train, at_row, tmp_path, monkeypatch):
    at_row(4, lambda: os.kill(os.getpid(), signal.SIGTERM))
    assert train("--out", "run")[0] == 143
    (tmp_path / "before").write_text((tmp_path / "run" / "summary.json").read_text())
    before = json.loads((tmp_path / "before").read_text())["train_s"]
    code, _, err = train("--restore", "run", "--max-minutes", 1e-9, steps=0)
    assert code == 2 and "has already used its 1e-09 minutes: pass a larger --max-minutes" in err
    assert train("--restore", "run", steps=0)[0] == 0
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["train_s"] >= before and rows(tmp_path / "run")[-1]["wall_s"] == pytest.approx(summary["train_s"], abs=0.06)


# --- divergence


def diverging(monkeypatch, at, spoil):
    """Spoils what ``advance`` gives at its calls number ``at``."""
    calls = []

    def compile(*given, original=compiled.compile):
        made = original(*given)

        def advance(state):
            calls.append(1)
            state, metrics = made.advance(state)
            return spoil(state, metrics) if len(calls) in at else (state, metrics)

        return compiled.dataclasses.replace(made, advance=advance)

    monkeypatch.setattr(compiled, "compile", compile)


def lost_loss(state, metrics):
    return state, {**metrics, "loss": float("nan")}


def lost_weights(state, metrics):
    return state.replace(params=compiled.jax.tree.map(lambda x: x * float("inf"), state.params)), metrics


@pytest.mark.parametrize(("spoil", "what"), [(lost_loss, "loss"), (lost_weights, "[1].policy")])
def test_divergence_stops_with_a_line(train, monkeypatch, tmp_path, spoil, what):
    diverging(monkeypatch, {5}, spoil)
    code, _, err = train("--out", "run")
    *_, line = err.splitlines()
    assert code == 2 and line.startswith("error: ") and what in line and "is not finite after 320 steps: training stopped" in line
    assert "The last finite checkpoint is at 256 steps" in line and "--on-nan rewind" in line
    assert last(tmp_path / "run")[0] == "000000000256.safetensors"


def test_divergence_goes_back_once(train, monkeypatch, tmp_path):
    diverging(monkeypatch, {5}, lost_weights)
    code, _, err = train("--out", "run", "--on-nan", "rewind")
    assert code == 0 and "after 320 steps: back to 256 steps, with a lower learning rate" in err, err
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["rewound_at"] == 320 and summary["env_steps"] == STEPS
    diverging(monkeypatch, {5, 8}, lost_loss)
    code, _, err = train("--out", "other", "--on-nan", "rewind")
    assert code == 2 and "for the second time, after rewinding from 320 steps" in err


# --- one folder, one owner


def test_a_folder_has_one_owner(tmp_path):
    with run_folder.claim(tmp_path / "run", "x", goes_on=False) as path:
        with pytest.raises(run_folder.UserError, match=f"is in use by process {os.getpid()} on .*: wait until it ends"):
            with run_folder.claim(tmp_path / "run", "x", goes_on=True):
                pass
        assert path.exists()
    assert not (tmp_path / "run").exists()  # nothing was written
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / ".lock").write_text("process 1 on elsewhere\n")  # of one that was killed
    with run_folder.claim(tmp_path / "run", "x", goes_on=False):
        pass
    assert (tmp_path / "run").exists()


def test_runs_of_the_same_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(run_folder.time, "strftime", lambda _: "now")
    with (
        run_folder.claim(None, "x", False) as a,
        run_folder.claim(None, "x", False) as b,
        run_folder.claim(None, "x", False) as c,
    ):
        assert [p.name for p in (a, b, c)] == ["x_now", "x_now_2", "x_now_3"]
    assert not list(tmp_path.iterdir())
