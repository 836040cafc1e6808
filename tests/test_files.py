"""Files are read with limits: what is regular, small and plain, and nothing else."""

import os
import subprocess
import time

import pytest

from mjx_nero import UserError, files


@pytest.mark.parametrize("text", ["1:" * 30_000 + "0.5", "1:" * 30_000 + "1", "1" * 400 + ".0", ":".join(["59"] * 40) + ".5"])
def test_a_yaml_number_beyond_reading_is_one_line_or_a_finite_number(tmp_path, text):
    path = tmp_path / "a.yaml"
    path.write_text(f"a: {text}")
    try:
        assert abs(files.read_yaml(path)["a"]) < 1e300
    except UserError as error:
        assert str(error).startswith(f"{path} is not YAML in line 1: a ")


def test_read_bytes(tmp_path):
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert files.read_bytes(path, 5) == b"12345"
    with pytest.raises(UserError, match="5e-06 MB: more than 4e-06 MB are not read"):
        files.read_bytes(path, 4)
    os.mkfifo(tmp_path / "pipe")
    for name, words in (("pipe", "is not a file"), (".", "is not a file"), ("no", "there is no file"), ("x" * 300, "too long")):
        with pytest.raises(UserError, match=words):
            files.read_bytes(tmp_path / name, 5)
    with pytest.raises(UserError, match="null byte"):
        files.read_bytes(tmp_path / "a\0b", 5)
    (tmp_path / "endless").symlink_to("/dev/zero")
    with pytest.raises(UserError, match="is not a file"):
        files.read_bytes(tmp_path / "endless", 5)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("", None),
        ("a: 1\n2: [x, 2.5, true, ~]", {"a": 1, "2": ["x", 2.5, True, None]}),
        ("on: {yes: no}", {"on": {"yes": False}}),  # keys are names, as written
        ("when: 2024-99-99", {"when": "2024-99-99"}),
        ("a: &a {b: 1}\nc: *a", {"a": {"b": 1}, "c": {"b": 1}}),
        ("a: !!float 1", {"a": 1.0}),
    ],
)
def test_read_yaml(tmp_path, text, value):
    (tmp_path / "a.yaml").write_text(text)
    assert files.read_yaml(tmp_path / "a.yaml") == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a: 1\nb: 2\na: 3", "is not YAML in line 3: key 'a' occurs twice"),
        ("? [1]\n: 2", "a key that is not a string"),
        ("[" * 20, "deeper than 12 levels"),
        ("[" + "1," * 30_000 + "]", "more than 20000 values"),
        ("a: &a [*a]", "an alias inside its own anchor"),
        ("a: !!int b", "invalid literal"),
        ("a: 9223372036854775808", "more than 64 bits"),
        ("!!python/name:os.system", "the tag 'tag:yaml.org,2002:python/name:os.system' is not supported"),
    ],
)
def test_no_yaml(tmp_path, text, message):
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(UserError) as error:
        files.read_yaml(tmp_path / "a.yaml")
    assert message in str(error.value)


def test_ten_aliases_of_ten(tmp_path):
    """What an alias stands for counts as often as it is named: 10 to the power of 5 values in 200 bytes."""
    lines = ["a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]" for i in range(1, 5)]
    (tmp_path / "a.yaml").write_text("\n".join(lines))
    with pytest.raises(UserError, match="more than 20000 values"):
        files.read_yaml(tmp_path / "a.yaml")


def test_messages_are_one_short_line():
    message = str(UserError("a\nb\t\x1b[2J \u202e" + "x" * 1000 + " change it"))
    assert message.startswith("a b \\x1b[2J \\u202exxx") and message.endswith("xxx change it")
    assert message.isprintable() and len(message) <= 480


def test_two_that_write_a_file_at_the_same_time_do_not_mix(tmp_path, monkeypatch):
    """The one that ends last is what stays, whole; what a killed process left of the same file goes away."""
    ours, path = os.getpid(), tmp_path / "a.json"
    with files.whole(path) as mine:
        mine.write_text("mine, first half")
        with monkeypatch.context() as patch:
            patch.setattr(files.os, "getpid", lambda: os.getppid())  # another process that runs
            with files.whole(path) as theirs:
                theirs.write_text("theirs")
            assert theirs != mine and path.read_text() == "theirs"
        mine.write_text("mine, both halves")
    assert path.read_text() == "mine, both halves" and list(tmp_path.iterdir()) == [path]
    dead = subprocess.Popen(["true"])
    dead.wait()
    here = files._here()
    lefts = [tmp_path / f".a.{pid}-{here}.part.json" for pid in (dead.pid, ours, 99999999999)]
    for left in lefts:
        left.write_text("half")
    files.write(path, b"{}")
    assert set(tmp_path.iterdir()) == {path, lefts[2]}


def test_another_machine_that_writes_to_the_same_disk_is_left_to_write(tmp_path, monkeypatch):
    """Its processes are not ours, whatever their numbers. What one of them left a day ago goes away."""
    path, dead = tmp_path / "a.json", subprocess.Popen(["true"])
    dead.wait()
    with monkeypatch.context() as there:
        there.setattr(files, "_here", lambda: "0123abcd")
        there.setattr(files.os, "getpid", lambda: dead.pid)
        with files.whole(path) as theirs:
            theirs.write_text("theirs, first half")
            there.undo()
            files.write(path, b"ours")
            assert theirs.read_text() == "theirs, first half"
            os.utime(theirs, (time.time() - 2 * files.SILENT,) * 2)
            files.write(path, b"ours")
            assert list(tmp_path.iterdir()) == [path]
            theirs.write_text("theirs")
    assert path.read_text() == "theirs" and list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("nowhere/a.json", "cannot write .*nowhere/a.json: the folder .*nowhere does not exist"),
        ("file/a.json", "cannot write .*file/a.json: .*file is a file"),
        ("folder", "cannot write .*folder: it is a folder, give a file name"),
        ("/proc/a.json", "cannot write /proc/a.json: No such file or directory"),  # a folder, and root may write to it
    ],
)
def test_what_cannot_be_written_is_told_before_the_work(tmp_path, name, message):
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match=message):
        files.check_writable(tmp_path / name)


def test_what_can_be_written_can_have_the_longest_name(tmp_path):
    path = tmp_path / f"{'x' * 250}.json"
    files.check_writable(path)
    files.write_json(path, {})
    assert list(tmp_path.iterdir()) == [path]
