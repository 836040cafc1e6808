"""Run folders from strangers: no link is followed, nothing outside changes, files named elsewhere are asked about."""

import json
import os
import pathlib

import pytest

from mjx_nero import config, files
from mjx_nero.errors import UserError
from mjx_nero.runs import cfg as run_cfg
from mjx_nero.runs import checkpoints, logs, resume, training, trust
from mjx_nero.runs import folder as run_folder
from mjx_nero.tools import seeds
from mjx_nero.tools.view import agents

NAMES = (".lock", "config.json", "summary.json", "metrics.jsonl", "policy.safetensors", "best.safetensors", "curve.png")
NAMES += ("video.mp4", "seeds.json", "checkpoints", "tensorboard", "wandb", "wandb/id", "wandb/run-1", "tensorboard/events.out.1")
NAMES += ("checkpoints/000000001024.safetensors", ".config.part.json", "checkpoints/.000000001024.part.safetensors")
KINDS = ("link to a file", "link to nothing", "link to a folder", "pipe", "device")


@pytest.fixture
def theirs(tmp_path):
    """A folder to be restored, and beside it what is the user's."""
    (tmp_path / "run").mkdir()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").write_text("precious")
    (tmp_path / "mine" / "000000000512.safetensors").write_text("precious")
    return tmp_path


def listing(folder: pathlib.Path) -> dict[str, str]:
    return {str(path): path.read_text() if path.is_file() else "" for path in sorted(folder.rglob("*"))}


def put(path: pathlib.Path, kind: str, mine: pathlib.Path) -> None:
    path.parent.mkdir(exist_ok=True)
    if kind == "pipe":
        os.mkfifo(path)
    else:
        to = {"link to a file": mine / "file", "link to nothing": mine / "new", "link to a folder": mine, "device": "/dev/zero"}
        path.symlink_to(to[kind])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("name", NAMES)
def test_nothing_outside_is_reached(theirs, name, kind):
    run, mine = theirs / "run", theirs / "mine"
    put(run / name, kind, mine)
    before = listing(mine)
    with pytest.raises(UserError, match="is (a link|not a regular file) and will not be read or written") as error:
        with run_folder.claim(run, "x", goes_on=True):
            pass
    assert "\n" not in str(error.value)
    assert listing(mine) == before and (name == ".lock" or not (run / ".lock").exists())


@pytest.mark.parametrize("name", [".lock", "metrics.jsonl"])
def test_a_second_name_of_a_file_is_written_apart_from_it(theirs, name):
    """A hard link looks like any file; what is written in place gets a copy of its own."""
    run, mine = theirs / "run", theirs / "mine" / "file"
    os.link(mine, run / name)
    with run_folder.claim(run, "x", goes_on=True):
        logs.Logs(run, print).write({"steps": 1})
    assert mine.read_text() == "precious" and mine.stat().st_nlink == 1


def test_links_that_wandb_makes_anew_are_no_fault(theirs):
    wandb = theirs / "run" / "wandb"
    wandb.mkdir()
    (wandb / "latest-run").symlink_to("run-1")
    (wandb / "debug.log").symlink_to("run-1/logs/debug.log")
    with run_folder.claim(theirs / "run", "x", goes_on=True):
        pass


@pytest.mark.parametrize("kind", KINDS)
def test_reading_a_folder_follows_nothing_either(theirs, kind):
    run, mine = theirs / "run", theirs / "mine"
    put(run / "config.json", kind, mine)
    put(run / "policy.safetensors", kind, mine)
    put(run / "checkpoints", kind, mine)
    asked = run_cfg.resolve("nero_reach", "default", None, {}, {})
    for read in (lambda: resume.same_run(run, asked, (), {}), lambda: checkpoints.saved(run), lambda: agents.newest(run)):
        with pytest.raises(UserError, match="is (a link|not a regular file)"):
            read()


def test_what_a_run_has_not_named_is_left_alone(tmp_path):
    folder = tmp_path / "checkpoints"
    folder.mkdir()
    own = ("0-good.safetensors", "000000000000 (copy).safetensors", "1.safetensors", "notes.txt", "0000000000001.safetensors")
    for name in own:
        (folder / name).write_text("mine")
    writer = checkpoints.Checkpoints(tmp_path, keep=1)
    for steps in (10, 20, 30):
        writer.save({"x": 1.0}, {"y": 2.0}, {}, steps, best=10)
    writer.wait()
    writer.close()
    assert [path.stem for path in checkpoints.saved(tmp_path)] == ["000000000030", "000000000010"]
    assert all((folder / name).read_text() == "mine" for name in own)


JSONS = {
    "deep": "[" * 100_000,
    "a list": "[]",
    "nothing": "null",
    "a number": "3",
    "cut": '{"env_name": "nero',
    "twice": '{"asked": 1, "asked": 2}',
    "infinite": '{"asked": 1e999}',
    "long": '{"asked": ' + "9" * 5000 + "}",
    "large": "[" + "1," * 2_500_000 + "1]",
}


@pytest.fixture(scope="module")
def stored():
    """The config of a run."""
    run = run_cfg.resolve("nero_reach", "default", None, {}, {})
    return {**json.loads(json.dumps(config.to_dict(run), default=str)), "versions": {"mjx-nero": "0.5.0"}}


def refused(run: pathlib.Path, text: str, trusted: bool = False) -> str:
    (run / "config.json").write_text(text)
    asked = run_cfg.resolve("nero_reach", "default", None, {}, {})
    with pytest.raises(UserError) as error:
        resume.same_run(run, asked, (), {}, trusted)
    assert "\n" not in str(error.value) and len(str(error.value)) < 600
    return str(error.value)


@pytest.mark.parametrize("name", JSONS)
def test_a_config_that_is_none_is_one_line(theirs, name):
    refused(theirs / "run", JSONS[name])


FIELDS = ("env_name", "preset", "learner", "asked", "env", "hyperparameters", "versions", "seed", "eval_episodes", "num_devices")
FIELDS += ("keep", "on_nan", "impl", "max_minutes", "checkpoint_minutes", "eval_every")
WRONG = ({}, {"a": {"b": []}}, None, [1, [2]], -1, 0.5, "x" * 300, True)


@pytest.mark.parametrize("field", FIELDS)
def test_a_field_of_another_type_is_one_line_or_taken_for_what_it_is(theirs, stored, field):
    tried = 0
    for value in (*WRONG, "missing"):
        changed = {**stored, field: value}
        if value == "missing":
            del changed[field]
        (theirs / "run" / "config.json").write_text(json.dumps(changed))
        asked = run_cfg.resolve("nero_reach", "default", None, {}, {})
        try:
            resume.same_run(theirs / "run", asked, (), {})
        except UserError as error:
            assert "\n" not in str(error) and len(str(error)) < 600
            tried += 1
    assert tried >= 3


def test_a_run_goes_on_as_it_was(theirs, stored):
    (theirs / "run" / "config.json").write_text(json.dumps({**stored, "seed": 7}))
    asked = run_cfg.resolve("nero_lift", "default", None, {}, {})
    assert resume.same_run(theirs / "run", asked, (), {}).seed == 7


@pytest.mark.parametrize("names", [{"robot": "KEYS"}, {"env": {"identified": "KEYS"}}, {"env": {"robot.folder": "KEYS"}}])
def test_files_elsewhere_are_asked_for_once(theirs, stored, names, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    keys = tmp_path / "keys.yaml"
    keys.write_text("secret_key: 12345\n")
    asked = {"robot": None, "env": {}, "learner": {}} | json.loads(json.dumps(names).replace("KEYS", str(keys)))
    run, text = theirs / "run", json.dumps({**stored, "asked": asked})
    message = refused(run, text)
    assert "pass --trust if you trust whoever made it" in message and "secret" not in message
    for trusted in (True, False):  # the second time without being asked
        try:  # a robot is read at once, and this is none
            resume.same_run(run, run_cfg.resolve("nero_reach", "default", None, {}, {}), (), {}, trusted)
        except UserError as error:
            assert "--trust" not in str(error) and names.get("robot")


def test_a_config_cannot_change_which_files_are_read(theirs, stored):
    changed = {
        **stored,
        "env": {**stored["env"], "identified": "/etc/passwd", "robot": {**stored["env"]["robot"], "folder": "/etc"}},
    }
    (theirs / "run" / "config.json").write_text(json.dumps(changed))
    found = resume.same_run(theirs / "run", run_cfg.resolve("nero_reach", "default", None, {}, {}), (), {})
    assert (found.env.identified, found.env.robot.folder) == ("", "")


def test_ones_own_run_is_not_asked_about(theirs, stored, tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    run = theirs / "run"
    (run / "config.json").write_text(json.dumps(stored))
    trust.mark(run)
    trust.ask(run, ["/some/robot"], trust=False)
    (run / "config.json").write_text(json.dumps({**stored, "seed": 1}))
    with pytest.raises(UserError, match="pass --trust"):
        trust.ask(run, ["/some/robot"], trust=False)


@pytest.mark.parametrize("text", [*JSONS.values(), '{"env_steps": "many"}', '{"evaluation": []}'])
def test_summaries_and_seeds_of_strangers_are_one_line(tmp_path, text):
    (tmp_path / "summary.json").write_text(text)
    (tmp_path / "seeds.json").write_text(text)
    for read in (lambda: training._summary(tmp_path), lambda: seeds._earlier(tmp_path / "seeds.json")):
        with pytest.raises(UserError) as error:
            read()
        assert "\n" not in str(error.value)


def test_rows_of_metrics_that_are_none_are_passed_over(tmp_path):
    rows = ['{"steps": 1, "x": 2.5}', "[" * 50_000, "[]", "null", '{"steps": {}}', '{"steps": 2, "x": "y"}', '{"steps": 3}', "{"]
    (tmp_path / "metrics.jsonl").write_text("\n".join(rows))
    assert [row["steps"] for row in logs.read(tmp_path / "metrics.jsonl")] == [1, 3]


def test_a_link_where_a_file_is_prepared_is_replaced(theirs):
    mine = theirs / "mine" / "file"
    (theirs / "run" / ".a.part.json").symlink_to(mine)
    files.write_json(theirs / "run" / "a.json", {"a": 1})
    assert mine.read_text() == "precious" and json.loads((theirs / "run" / "a.json").read_text()) == {"a": 1}
