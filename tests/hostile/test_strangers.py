"""Inputs of strangers: a few of each kind in the suite, a thousand by ``strangers.py``; and numbers that once got through."""

import dataclasses
import json
import os
import random
import re
import subprocess
import sys

import bad_meshes
import folders
import fuzz
import pytest
import strangers
import sweep
import worlds
import yaml

import mjx_nero
from mjx_nero import UserError
from mjx_nero.envs import identified
from mjx_nero.identify import log
from mjx_nero.tools import cli

QUICK = (
    "run",
    "summary",
    "seeds",
    "results",
    "public_robots",
    "identified",
    "log",
    "gains",
    "descriptor",
    "flow",
    "policy",
    "yaml",
)


@pytest.fixture(autouse=True)
def _elsewhere(tmp_path, monkeypatch):
    """The judge looks at what is left in the working folder."""
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")


@pytest.mark.parametrize("reader", QUICK)
def test_numbers_of_a_file(reader):
    """Twelve of them; ``strangers.py --kind files`` tries more, of every reader."""
    assert set(QUICK) < set(sweep.WORDS) < set(fuzz.READERS)
    assert fuzz.judge(reader, sweep.inner(reader)[1](sweep.inner(reader)[0]))  # as it is
    tried = [fuzz.judge(reader, content) for _, content in sweep.files(reader, 12, seed=1)]
    assert len(tried) == 12 and not all(tried)


def test_a_sweep_is_of_every_number():
    text, packed = sweep.inner("gains")
    assert len(sweep.places(text)) == 6 and sweep.count("gains") == 6 * len(sweep.YAML)
    made = [content for _, content in sweep.files("gains")]
    assert len(set(made)) == len(made) == sweep.count("gains") and b"stiffness: .nan," in made[0]
    assert [c for _, c in sweep.files("gains", 5, 3)] == [c for _, c in sweep.files("gains", 5, 3)]


@pytest.mark.parametrize("kind", [folders.entries, folders.config, folders.names, worlds.urdf, bad_meshes.mesh])
def test_the_same_seed_makes_the_same_input(kind, tmp_path):
    said = []
    for seed, name in ((1, "a"), (1, "b"), (2, "c")):
        for part in ("work", "home", "mine"):
            (tmp_path / name / part).mkdir(parents=True)
        (tmp_path / name / "mine" / "keys.yaml").write_text("x")
        (tmp_path / name / "mine" / "000000000512.safetensors").write_text("x")
        what, _ = kind(random.Random(f"{kind} {seed}"), tmp_path / name)
        said.append(what.replace(str(tmp_path / name), ""))
    assert said[0] == said[1] != said[2]


def test_what_gets_through_is_found(tmp_path):
    """The judge of forked inputs tells a traceback, a hang of the exit status, an effect outside and told secrets."""
    good = {"killed": "", "code": 0, "seconds": 1.0, "memory": 1e8}

    def fault(stderr="", stdout="", outside="", **outcome):
        for name, text in (("stderr", stderr), ("stdout", stdout), ("outside", outside)):
            (tmp_path / name).write_text(text)
        (tmp_path / "mine").mkdir(exist_ok=True)
        return strangers.fault({**good, **outcome}, tmp_path, strangers.owned(tmp_path))

    assert fault() == fault("error: a line\n", code=2) == fault("warning: x\nerror: a line\n", code=2) == ""
    for found in (
        fault("Traceback (most recent call last)", code=2),
        fault(code=2),
        fault("error: a\nerror: b\n", code=2),
        fault("error: a\x1b[2J\n", code=2),
        fault(code=70),
        fault(killed="time"),
        fault(outside="open /x"),
        fault("error: secret_key\n", code=2),
    ):
        assert found
    before = strangers.owned(tmp_path)
    (tmp_path / "mine" / "new").write_text("x")
    for name in ("stderr", "stdout", "outside"):
        (tmp_path / name).write_text("")
    assert "effect outside" in strangers.fault(good, tmp_path, before)


@pytest.mark.slow
def test_a_hundred_inputs(tmp_path):
    """Of every kind but signals, in processes of their own; another day other ones."""
    command = [sys.executable, strangers.HERE / "strangers.py", "--count=100", f"--seed={strangers.today()}", "--finds=finds.txt"]
    command += [f"--kind={kind}" for kind in strangers.SHARES]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=os.environ)
    assert done.returncode == 0 and "; 0 got through" in done.stdout, f"{done.stdout}{(tmp_path / 'finds.txt').read_text()}"


def test_a_cell_beyond_reason(tmp_path):
    """Python's own reader of tables takes 131,072 characters; a log's cell is a number of any length, or none."""
    good = fuzz.a_log().decode()
    for cell in ("1" * 200_000, "x" * 200_000, '"' * 200_001, "0." + "1" * 200_000):
        (tmp_path / "a.csv").write_text(good.replace("0.1020", cell, 1))
        if cell.startswith("0."):
            log.read(tmp_path / "a.csv", ("joint1", "joint2"))
            continue
        with pytest.raises(UserError, match=r"takes a number up to 10000, got|has values for some joints") as error:
            log.read(tmp_path / "a.csv", ("joint1", "joint2"))
        assert len(str(error.value)) < 500


@pytest.mark.parametrize("seconds", [1e6, 1e5, 100.0, 1e25, float("inf"), float("nan")])
def test_a_delay_beyond_reason(tmp_path, seconds):
    """In a file of ``identify``, before any buffer of that length is made."""
    found = json.loads(fuzz.an_identified())
    found["delay"] = {"value": seconds, "low": 0.0, "high": seconds}
    (tmp_path / "a.yaml").write_text(yaml.safe_dump(found))
    with pytest.raises(UserError, match=r"delay") as error:
        identified.applied(dataclasses.replace(mjx_nero.env_cfg("nero_reach"), identified=str(tmp_path / "a.yaml")))
    assert len(str(error.value)) < 500


@pytest.mark.parametrize("steps", ["(0,1000000)", "(1e6,1e6)", "(-1,1)", "(2,1)", "(0,257)", "(0,nan)", "(0,0.5)"])
def test_a_delay_flag_beyond_reason(call, steps):
    command = ("eval", "--env", "nero_reach", "--episodes", 1, "--env.actions.delay.params.steps", steps)
    code, _, err = call(*command)
    assert (
        code == 2
        and re.fullmatch(r"error: actions\.delay\.params\.steps\S* (must|takes|is a range) .*\n", err)
        and len(err) < 500
    )


@pytest.mark.parametrize("seed", ["-1", str(2**32), str(2**64), "0.5", "nan", "1e30", "x", "9" * 400])
def test_seeds_beyond_what_generators_take(call, seed):
    """One line, and no seed that would repeat another's draws."""
    code, _, err = call("eval", "--env", "nero_reach", "--episodes", 1, "--seed", seed)
    assert code == 2 and re.fullmatch(r"error: --seed .*\n", err) and len(err) < 500
    code, _, err = call("train", "--env", "nero_reach", "--seeds", f"0,{seed}")
    assert code == 2 and re.fullmatch(r"error: .*--seeds .*\n", err) and len(err) < 500


def test_seeds_up_to_the_end_are_taken():
    last = 2**32 - 1
    assert cli.seed(str(last)) == last and cli.seed("1e6") == 10**6 and cli.seeds(f"{last - 5}-{last}")[-1] == last
