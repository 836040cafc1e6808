"""Several seeds in one process: each is the run that it is alone, and one that ends badly costs the others nothing."""

import json
import os
import shutil
import signal

import pytest
from faults_run import STEPS, last, rows

from mjx_nero.runs import cfg as run_cfg
from mjx_nero.runs import loop, track
from mjx_nero.tools import seeds


def test_each_seed_is_the_run_that_it_is_alone(train, tmp_path):
    code, out, err = train("--seeds", "3,5", "--out", "many")
    assert code == 0, err
    assert {p.name for p in (tmp_path / "many").iterdir()} == {"seed_3", "seed_5", "seeds.json"}
    code, _, err = train("--seed", 5, "--out", "one")
    assert code == 0, err
    assert last(tmp_path / "many" / "seed_5") == last(tmp_path / "one") != last(tmp_path / "many" / "seed_3")
    names = {p.name for p in (tmp_path / "one").iterdir()}
    assert {p.name for p in (tmp_path / "many" / "seed_5").iterdir()} == names
    assert json.loads((tmp_path / "many" / "seed_5" / "summary.json").read_text())["seed"] == 5
    found = json.loads((tmp_path / "many" / "seeds.json").read_text())
    assert [(row["seed"], row["env_steps"], row["stopped"]) for row in found["rows"]] == [(s, STEPS, "finished") for s in (3, 5)]
    assert "0 of 2 seeds reached 95% (0% to 66%)" in out  # Wilson: z^2 / (n + z^2)


def test_more_seeds_later_and_one_gone_on_with(train, tmp_path):
    assert train("--seeds", "0", "--out", "many")[0] == 0
    code, _, err = train("--seeds", "0-1", "--out", "many")
    assert code == 2 and "many/seed_0 already holds a run: pass other --seeds" in err and not (tmp_path / "many/seed_1").exists()
    code, out, err = train("--seeds", "1-2", "--out", "many")
    assert code == 0 and "of 3 seeds" in out, err
    assert train("--restore", "many/seed_1", steps=2 * STEPS)[0] == 0
    assert rows(tmp_path / "many" / "seed_1")[-1]["steps"] == 2 * STEPS


def test_a_seed_that_diverges_is_a_row(train, monkeypatch, tmp_path):
    monkeypatch.setattr(
        loop.Loop, "_not_finite", lambda self, *_: "loss" if self.run.seed == 0 and self.tally.steps > 200 else None
    )
    code, out, err = train("--seeds", "0,1", "--out", "many")
    assert code == 0 and "loss is not finite after 256 steps" in err
    first, second = json.loads((tmp_path / "many" / "seeds.json").read_text())["rows"]
    assert (first["stopped"], first["success_rate"], first["seconds_to_95"]) == ("diverged", 0.0, None)
    assert second["stopped"] == "finished" and "diverged" in out


def test_a_signal_ends_them_all_and_says_which_are_left(train, at_row, tmp_path):
    at_row(3, lambda: os.kill(os.getpid(), signal.SIGTERM))
    code, out, err = train("--seeds", "0-2", "--out", "many")
    assert code == 128 + signal.SIGTERM and "seeds 1,2 were not started: --seeds 1,2 --out many trains them" in err
    assert not (tmp_path / "many" / "seed_1").exists() and "interrupted" in out
    assert train("--restore", "many/seed_0")[0] == 0 and train("--seeds", "1,2", "--out", "many")[0] == 0


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--seeds", "0-7", "--restore", "run"], "--seeds starts new runs: to resume one, pass only --restore RUN/seed_N"),
        (["--seeds", "0-7", "--out", "run", "--resume", "auto"], "--seeds starts new runs"),
        (["--seeds", "3-1"], "--seeds takes seeds as in 0-7 or 0,3,5, got '3-1'"),
        (["--seeds", "1,,2"], "--seeds takes seeds as in 0-7 or 0,3,5"),
        (["--seeds", "-1"], "--seeds"),
        (["--seeds", "0-99999999999"], "--seeds takes seeds as in 0-7 or 0,3,5"),
        (["--seeds", "0-2,1"], "--seeds takes each seed once, got '0-2,1'"),
        (["--seed", "1", "--seeds", "2"], "--seeds: not allowed with argument --seed"),
    ],
)
def test_seeds_that_cannot_be_are_one_line(train, tmp_path, flags, message):
    code, _, err = train(*flags)
    assert code == 2 and message in err and err.count("\n") == 1 and not list(tmp_path.iterdir())


def test_intervals_by_hand():
    def row(success, seconds):
        return {"success_rate": success, "seconds_to_95": seconds}

    found = seeds.summary([row(0.94, 4.0), row(0.95, 5.0), row(0.96, 6.0)])
    half = 4.302653 / 3**0.5  # Student's t with two degrees of freedom, from a table; the deviation is 1
    assert found["seconds_to_95_interval"] == pytest.approx((5 - half, 5 + half), abs=1e-5)
    assert found["success_rate_interval"] == pytest.approx((0.95 - half / 100, 0.95 + half / 100), abs=1e-7)
    assert found["reached_95_interval"] == pytest.approx((3 / (3 + 1.96**2), 1.0))
    found = seeds.summary([row(0.97, 1.0), row(0.5, None)])
    assert found["seconds_to_95_median"] == 1.0 and found["seconds_to_95_interval"] is None
    assert seeds.mean_interval([1.0]) is None and seeds.mean_interval([0.5, 1.0], most=1.0) == (0.0, 1.0)


# --- trackers


def test_wandb_offline_gets_every_row(train, tmp_path, monkeypatch):
    pytest.importorskip("wandb", reason="the extra track is not installed")
    monkeypatch.setenv("WANDB_MODE", "offline")
    code, _, err = train("--out", "run", "--track", "wandb")
    assert code == 0 and "warning" not in err, err
    (stored,) = (tmp_path / "run" / "wandb").glob("offline-run-*/run-*.wandb")
    data = stored.read_bytes()
    assert all(name in data for name in (b"eval/success_rate", b"train/return", b"nero_lift"))
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["lost"] == {}


@pytest.mark.parametrize("broken", ["__init__", "write", "close"])
def test_a_tracker_that_fails_costs_nothing_else(train, tmp_path, monkeypatch, broken):
    class Tracker:
        def __init__(self, run, folder):
            pass

        def write(self, row):
            pass

        def close(self):
            pass

    def fail(*_):
        raise ConnectionError("no\nnetwork")

    setattr(Tracker, broken, fail)
    monkeypatch.setitem(track.TRACKERS, "wandb", Tracker)
    monkeypatch.setattr(track, "check", lambda name: None)
    code, out, err = train("--out", "run", "--track", "wandb")
    assert code == 0 and err.count("warning: cannot write track in run (no network): training continues") == 1
    assert len(rows(tmp_path / "run")) == 11 and "x track" in out


def test_a_tracker_that_is_not_installed_is_one_line(train, tmp_path, monkeypatch):
    monkeypatch.setattr(track.importlib.util, "find_spec", lambda name: None)
    code, _, err = train("--out", "run", "--track", "wandb")
    assert (code, list(tmp_path.iterdir())) == (2, [])
    assert err == "error: --track wandb needs the package wandb, of the extra 'track': pip install 'mjx-nero[track]'\n"


def test_who_goes_on_is_tracked_as_the_same_run(tmp_path, monkeypatch):
    wandb = pytest.importorskip("wandb", reason="the extra track is not installed")
    asked = []
    monkeypatch.setattr(wandb, "init", lambda **kwargs: asked.append(kwargs))
    run = run_cfg.resolve("nero_reach", "default", None, {}, {})
    track.Wandb(run, tmp_path), track.Wandb(run, tmp_path)
    assert asked[0]["id"] == asked[1]["id"] and {a["resume"] for a in asked} == {"allow"}
    shutil.rmtree(tmp_path / "wandb")
    track.Wandb(run, tmp_path)
    assert asked[2]["id"] != asked[0]["id"]
