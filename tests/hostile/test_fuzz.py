"""Mutations of good and bad files, for the readers of text: five minutes, or half of ``MJX_NERO_FUZZ_MINUTES``.

``test_fuzz_models.py`` has the other readers and the other half, for another process of the tests. The long test comes first, so
that what the other process could do does not wait behind it.
"""

import fuzz
import pytest

TEXT = ("yaml", "loaded", "gains", "descriptor", "flow", "policy", "xacro", "expression", "eval")
TEXT += ("run", "summary", "seeds", "metrics", "results", "robustness", "public_robots", "identified", "log", "onnx")


@pytest.mark.slow
def test_readers_of_text(campaign):
    campaign(TEXT)


def test_every_reader_is_tried():
    from test_fuzz_models import MODELS

    assert sorted((*TEXT, *MODELS)) == sorted(fuzz.READERS)


@pytest.fixture
def reader():
    """``reader(function)`` puts a reader of that function among the others."""
    yield lambda function: fuzz.READERS.update(made=function)
    fuzz.READERS.pop("made", None)


def test_finds_are_found(reader):
    """The judge tells a reader that fails from one that refuses."""
    reader(lambda folder, content: (content or b"?")[0] // (len(content) - 3))
    assert fuzz.judge("made", b"1234")
    with pytest.raises(ZeroDivisionError):
        fuzz.judge("made", b"123")


def test_what_a_reader_does_is_seen(reader, tmp_path):
    """A program that it runs, a file that it opens, one that it leaves behind."""
    import subprocess

    (tmp_path / "secret").write_text("x")
    reader(lambda folder, content: subprocess.run(["true"]))
    with pytest.raises(AssertionError, match="subprocess.Popen"):
        fuzz.judge("made", b"")
    reader(lambda folder, content: (tmp_path / "secret").read_text())
    with pytest.raises(AssertionError, match="secret"):
        fuzz.judge("made", b"")


def test_a_run_can_be_repeated(reader, tmp_path):
    """The same seed tries the same files, and another others."""
    tried = []
    reader(lambda folder, content: tried.append(content))
    runs = []
    for seed in (1, 1, 2):
        tried.clear()
        fuzz.fuzz("made", seed, [b"a: 1, b"])
        runs.append(tuple(tried))
    assert runs[0] == runs[1] != runs[2] and len(runs[0]) >= fuzz.BATCH / 2


def test_edits():
    assert fuzz.edited(b"a: 12, b", [("number", 0.0, 0.0, b"nan")]) == b"a: nan, b"
    assert fuzz.edited(b"abcd", [("cut", 0.5, 0.0, b"")]) == b"abd"
    assert fuzz.edited(b"abcd", [("put", 0.0, 0.0, b"x")]) == b"xabcd"
