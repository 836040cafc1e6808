"""What is written is what is read: both forms, in pieces, after kills, on a full disk, and in the wrong folder."""

import contextlib
import dataclasses
import errno
import io
import itertools
import json
import os
import pathlib
import resource
import subprocess
import sys
import types

import numpy as np
import pytest
from lerobots import lerobot_python
from written import episode, schema

from mjx_nero.data import Episode, Schema, encoding, open_dataset, writer
from mjx_nero.data.episode import picture
from mjx_nero.errors import UserError
from mjx_nero.tools.demos import inspection

FORMS = ("lerobot", "arrays")


@pytest.mark.parametrize("form", FORMS)
def test_what_is_written_in_pieces_is_read(form, tmp_path):
    made = [episode(i, 3 + i) for i in range(5)]
    for part in (made[:2], made[2:]):
        with writer(tmp_path / "d", schema(), form) as out:
            out.put(part)
    found = open_dataset(tmp_path / "d")
    assert len(found) == 5 and found.schema == schema()
    assert found.lengths.tolist() == [3, 4, 5, 6, 7] and found.numbers.tolist() == [0, 1, 2, 3, 4]
    assert found.success.tolist() == [False, True, True, False, True]
    for own, back in zip(made, found.episodes(), strict=True):
        for name in own.arrays:
            assert back.arrays[name].dtype == own.arrays[name].dtype
            np.testing.assert_array_equal(back.arrays[name], own.arrays[name])
    with pytest.raises(UserError, match="the data set has no 'pictures': choose from observation.state, action"):
        found.column("pictures")


def test_the_schema_of_lerobot_by_hand(tmp_path):
    """What LeRobot 0.4.4 reads, file by file."""
    from pyarrow import parquet

    with writer(tmp_path, schema()) as out:
        out.put([episode(0, 3), episode(1, 4)])
        out.put([episode(2, 2)])
    info = json.loads((tmp_path / "meta/info.json").read_text())
    assert (info["codebase_version"], info["fps"], info["robot_type"]) == ("v3.0", 50, "nero")
    assert (info["total_episodes"], info["total_frames"], info["total_tasks"]) == (3, 9, 1)
    assert info["splits"] == {"train": "0:3"} and info["video_path"] is None
    assert info["features"]["action"] == {"dtype": "float32", "shape": [2], "names": ["a.pos", "b.pos"]}
    for name, dtype in (("timestamp", "float32"), ("frame_index", "int64"), ("task_index", "int64")):
        assert info["features"][name] == {"dtype": dtype, "shape": [1], "names": None}
    first, second = (parquet.read_table(tmp_path / info["data_path"].format(chunk_index=0, file_index=i)) for i in range(2))
    assert first["index"].to_pylist() == list(range(7)) and second["index"].to_pylist() == [7, 8]
    assert first["frame_index"].to_pylist() == [0, 1, 2, 0, 1, 2, 3] and second["episode_index"].to_pylist() == [2, 2]
    np.testing.assert_allclose(first["timestamp"].to_numpy()[:3], [0, 0.02, 0.04], atol=1e-7)
    assert str(first.schema.field("action").type) == "fixed_size_list<element: float>[2]"
    assert str(first.schema.field("next.reward").type) == "float"
    episodes = parquet.read_table(tmp_path / "meta/episodes/chunk-000/file-001.parquet").to_pylist()[0]
    wanted = {
        "episode_index": 2,
        "tasks": ["Pick up the cube."],
        "length": 2,
        "data/chunk_index": 0,
        "data/file_index": 1,
        "dataset_from_index": 7,
        "dataset_to_index": 9,
        "meta/episodes/file_index": 1,
    }
    assert {name: episodes[name] for name in wanted} == wanted
    tasks = parquet.read_table(tmp_path / "meta/tasks.parquet")
    assert tasks.to_pylist() == [{"task_index": 0, "task": "Pick up the cube."}]
    assert json.loads(tasks.schema.metadata[b"pandas"])["index_columns"] == ["task"]


def test_statistics_equal_numpys(tmp_path):
    made = [episode(i, 40) for i in range(3)]
    with writer(tmp_path, schema()) as out:
        out.put(made)
    found = json.loads((tmp_path / "meta/stats.json").read_text())
    together = np.concatenate([each.arrays["action"] for each in made]).astype(np.float64)
    for name, wanted in {
        "min": together.min(0),
        "max": together.max(0),
        "mean": together.mean(0),
        "std": together.std(0),
        "q01": np.quantile(together, 0.01, axis=0),
        "q10": np.quantile(together, 0.1, axis=0),
        "q99": np.quantile(together, 0.99, axis=0),
    }.items():
        np.testing.assert_allclose(found["action"][name], wanted, rtol=0, atol=1e-9)
    assert found["action"]["count"] == [120] and found["next.done"]["mean"] == pytest.approx([3 / 120])


@pytest.mark.parametrize("form", FORMS)
def test_folders_of_something_else_are_refused(form, tmp_path):
    with writer(tmp_path / "d", schema(), form) as out:
        out.put([episode(0)])
    with pytest.raises(UserError, match="holds other demonstrations .env was 'nero_lift', here it is 'nero_stack'.: pass anoth"):
        with writer(tmp_path / "d", schema(env="nero_stack"), form):
            pass
    other = next(name for name in FORMS if name != form)
    with pytest.raises(UserError, match=f"holds a data set in the form '{form}': pass --form {form}, or another folder"):
        with writer(tmp_path / "d", schema(), other):
            pass
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("")
    with pytest.raises(UserError, match="is not empty and holds no demonstrations: pass another folder"):
        with writer(tmp_path / "full", schema(), form):
            pass
    assert os.listdir(tmp_path / "full") == ["thesis.tex"]
    with pytest.raises(UserError, match="holds no demonstrations of mjx_nero: give a folder that 'demos --out' wrote"):
        open_dataset(tmp_path / "full")
    with writer(tmp_path / "d", schema(), form), pytest.raises(UserError, match="is in use by process"):
        with writer(tmp_path / "d", schema(), form):
            pass


@pytest.mark.parametrize("form", FORMS)
def test_a_data_set_without_an_episode_does_not_stay(form, tmp_path):
    """Nobody succeeded: the same folder is free for another agent, also if the process was killed then."""
    with pytest.raises(UserError, match="nobody"), writer(tmp_path / "d", schema(), form):
        raise UserError("nobody succeeded")
    assert not (tmp_path / "d").exists()
    (tmp_path / "d" / "meta").mkdir(parents=True)
    (tmp_path / "d" / "meta" / "mjx_nero.json").write_text(json.dumps(schema().to_json()))  # what a killed one leaves
    with writer(tmp_path / "d", schema(env="nero_stack"), form) as out:
        out.put([episode(0)])
    assert open_dataset(tmp_path / "d").schema.about["env"] == "nero_stack"


@contextlib.contextmanager
def full_disk(size: int):
    """No file grows beyond ``size`` bytes, as if the disk were full: the kernel refuses, however a library writes."""
    usual = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, usual[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, usual)


@pytest.mark.parametrize("films", [False, True])
@pytest.mark.parametrize("form", FORMS)
def test_a_full_disk_is_one_line_and_leaves_what_was_whole(form, films, tmp_path):
    make, about = (filmed, with_camera()) if films else (episode, schema())
    with writer(tmp_path, about, form) as out:
        out.put([make(0)])
    with pytest.raises(UserError, match="File too large.*; everything written before is intact: make room, and repeat"):
        with writer(tmp_path, about, form) as out, full_disk(40_000):
            out.put([make(i, 1200) for i in range(1, 3)])
    found = open_dataset(tmp_path)
    assert found.numbers.tolist() == [0] and len(found.column("action")) == len(make(0))
    assert not list(tmp_path.rglob("*.part*"))
    with writer(tmp_path, about, form) as out:
        out.put([make(1)])
    assert open_dataset(tmp_path).numbers.tolist() == [0, 1]


@pytest.mark.parametrize("form", FORMS)
def test_what_is_damaged_is_told(form, tmp_path):
    with writer(tmp_path, schema(), form) as out:
        out.put([episode(0)])
    data = next((tmp_path / "data").rglob("*.*"))
    data.write_bytes(data.read_bytes()[:100])
    with pytest.raises(UserError, match=r"is damaged \(its steps of action cannot be read\): write the data set again"):
        open_dataset(tmp_path).column("action")
    (tmp_path / "meta/mjx_nero.json").write_text('{"fps": 50}')
    with pytest.raises(UserError, match="does not describe demonstrations of mjx_nero, or it is damaged"):
        open_dataset(tmp_path)


_ENDLESS = """
import sys, pathlib
sys.path[:0] = [{here!r}, {package!r}]
from written import episode, schema
from mjx_nero.data import writer
with writer(pathlib.Path({out!r}), schema(), {form!r}) as out:
    while True:
        first = int(out.numbers[-1]) + 1 if len(out.numbers) else 0
        out.put([episode(first + i) for i in range(4)])
        print(len(out.numbers), flush=True)
"""


@pytest.mark.parametrize("form", FORMS)
def test_ten_kills_lose_nothing_that_was_said_to_be_written(form, tmp_path):
    """Twenty in all. Each killed process had said how many episodes there were; the next goes on from those."""
    here = pathlib.Path(__file__).parent
    program = _ENDLESS.format(here=str(here), package=str(here.parents[1]), out=str(tmp_path / "d"), form=form)
    said, rng = 0, np.random.default_rng(1)
    for _ in range(10):
        with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE, text=True) as process:
            for _ in range(int(rng.integers(1, 6))):
                said = int(process.stdout.readline())
            process.kill()
            said = int((process.stdout.read().split() or [said])[-1])
        found = open_dataset(tmp_path / "d")
        assert len(found) >= said
        assert found.numbers.tolist() == list(range(len(found)))
        for back in found.episodes()[-8:]:
            np.testing.assert_array_equal(back.arrays["action"], episode(back.number).arrays["action"])


def filmed(number: int, steps: int = 6) -> Episode:
    """An episode with pictures: a bright square that moves over a dark, coloured ground."""

    def frames():
        for i in range(steps):
            frame = np.full((32, 48, 3), (20, 60, 90), np.uint8)
            frame[8:24, 4 * (i % 8) : 4 * (i % 8) + 16] = (230, 180, 40 + 10 * number)
            yield frame

    return dataclasses.replace(episode(number, steps), pictures={"observation.images.front": frames})


def with_camera(**about) -> Schema:
    made = schema(**about)
    return dataclasses.replace(made, features={**made.features, "observation.images.front": picture(32, 48)})


@pytest.mark.parametrize("form", FORMS)
def test_pictures_come_back(form, tmp_path):
    """As arrays they are the same; a video changes a colour by less than 4 of 255 on average."""
    made = [filmed(i) for i in range(3)]
    for part in (made[:2], made[2:]):
        with writer(tmp_path / "d", with_camera(), form) as out:
            out.put(part)
    found = open_dataset(tmp_path / "d")
    back = found.column("observation.images.front")
    np.testing.assert_array_equal(back, list(found.frames("observation.images.front")))
    drawn = inspection.sheet(tmp_path, found)
    assert drawn.shape == (3 * 32, 3 * 48, 3)  # a row an episode: its beginning, middle and end
    np.testing.assert_array_equal(drawn[32:64, 48:96], back[9])
    wanted = np.concatenate([list(each.pictures["observation.images.front"]()) for each in made])
    assert back.shape == (18, 32, 48, 3) and back.dtype == np.uint8
    off = np.abs(back.astype(int) - wanted)
    assert off.mean() < (4 if form == "lerobot" else 1e-9)
    if form == "lerobot":
        info, stats = (json.loads((tmp_path / "d" / "meta" / name).read_text()) for name in ("info.json", "stats.json"))
        told = info["features"]["observation.images.front"]
        assert told["dtype"] == "video" and told["shape"] == [32, 48, 3] and told["info"]["video.fps"] == 50
        assert info["video_path"] == "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        colours = wanted.reshape(-1, 3) / 255
        for what, values in (("mean", colours.mean(0)), ("std", colours.std(0)), ("max", colours.max(0))):
            np.testing.assert_allclose(np.ravel(stats["observation.images.front"][what]), values, atol=1e-6)


def test_a_film_that_breaks_off_and_a_process_that_dies_spoil_no_other(tmp_path):
    """Either is an error, nothing is written, and the next piece is as if it had not been."""
    name, good = "observation.images.front", [filmed(i) for i in range(3)]

    def broken():
        yield from itertools.islice(good[0].pictures[name](), 2)
        raise OSError(errno.ENOSPC, "full")

    with writer(tmp_path / "d", with_camera()) as out:
        with pytest.raises(UserError, match="No space left"):
            out.put([dataclasses.replace(good[0], pictures={name: broken})])
        out.put(good[:1])
        encoding.close()
        encoding._free.put(dead := encoding.Encoder())
        dead._process.kill()
        dead._process.wait()
        with pytest.raises(UserError, match="a process that encodes videos died, .*: free some, and repeat the command"):
            out.put(good[1:2])
        out.put(good[1:])
    with writer(tmp_path / "e", with_camera()) as out:
        out.put(good[:1])
        out.put(good[1:])
    for path in sorted((tmp_path / "e").rglob("*.*")):
        if path.is_file():
            assert (tmp_path / "d" / path.relative_to(tmp_path / "e")).read_bytes() == path.read_bytes(), path


def test_an_answer_that_is_cut_off_is_an_error():
    """Its last packet would be half a picture."""
    encoder = encoding.Encoder()
    process = encoder._process
    answer = io.BytesIO(b'{"packets": [[9, true, 0, 0, 1]], "stats": {}}\nshort')
    encoder._process = types.SimpleNamespace(stdin=io.BytesIO(), stdout=answer)
    with pytest.raises(UserError, match="a process that encodes videos died"):
        encoder._handed(0)
    encoder._process = process
    encoder.close()


@pytest.mark.slow
def test_lerobot_opens_it(tmp_path):
    python = lerobot_python()
    if not python:
        pytest.skip("lerobot is not installed: name a Python that has it in MJX_NERO_LEROBOT_PYTHON")
    made = [filmed(i, 10 + i) for i in range(20)]
    with writer(tmp_path, with_camera()) as out:
        out.put(made[:12])
        out.put(made[12:])
    np.savez(
        tmp_path / "recorded.npz", **{n: np.concatenate([e.arrays[n] for e in made]) for n in ("observation.state", "action")}
    )
    check = pathlib.Path(__file__).with_name("lerobot_check.py")
    done = subprocess.run([python, str(check), str(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]
    told = json.loads(done.stdout.splitlines()[-1])
    assert (told["episodes"], told["steps"], told["read_back"]) == (20, 390, 50) and told["worst"] < 1e-5
    assert told["task"] == "Pick up the cube."
