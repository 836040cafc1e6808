"""Files: what is saved comes back bit for bit, and whatever else is given is refused with a clear message."""

import json
import os
import shutil

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors.numpy import save_file

from mjx_nero import UserError
from mjx_nero.learn import checkpoint

TREE = {
    "a": jnp.array([[1.0, -0.0, jnp.nan], [jnp.inf, 1e-45, 3.0]]),
    "b": (jnp.array(7, jnp.int32), {"key": jax.random.PRNGKey(3), "flags": jnp.array([True, False])}),
    "empty": jnp.zeros((0, 2)),
}
META = {"kind": "test", "numbers": [1, 2.5], "nested": {"x": None}}
DAMAGED = r"is not a policy or checkpoint of mjx_nero, or it is damaged: train again or copy it again"


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "file.safetensors"
    checkpoint.save(path, TREE, META)
    return path


def test_round_trip_is_bit_equal(path):
    loaded = checkpoint.load(path, jax.eval_shape(lambda: TREE))
    assert jax.tree.structure(loaded) == jax.tree.structure(TREE)
    for old, new in zip(jax.tree.leaves(TREE), jax.tree.leaves(loaded), strict=True):
        assert old.dtype == new.dtype and old.shape == new.shape
        assert np.asarray(old).tobytes() == np.asarray(new).tobytes()
    assert checkpoint.load_meta(path) == META


def test_folders_are_made_and_files_replaced(tmp_path):
    path = tmp_path / "a" / "b" / "file.safetensors"
    for value in (1.0, 2.0):
        checkpoint.save(path, {"x": jnp.array(value)}, {"value": value})
    assert float(checkpoint.load(path, {"x": jnp.zeros(())})["x"]) == 2.0
    assert checkpoint.load_meta(path) == {"value": 2.0}
    assert [p.name for p in path.parent.iterdir()] == ["file.safetensors"]  # nothing left over


def test_a_transposed_array_keeps_its_values(tmp_path):
    path, x = tmp_path / "t.safetensors", np.arange(6.0, dtype=np.float32).reshape(2, 3).T
    checkpoint.save(path, {"x": x}, {})
    np.testing.assert_array_equal(checkpoint.load(path, {"x": x})["x"], x)


def test_failed_write_keeps_the_old_file(path, monkeypatch):
    before = path.read_bytes()

    def full(*_):
        raise OSError("No space left on device")

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(UserError, match=r"^cannot write .*file\.safetensors: No space left on device$"):
        checkpoint.save(path, {"x": jnp.zeros(3)}, {})
    assert path.read_bytes() == before
    assert [p.name for p in path.parent.iterdir()] == [path.name]


@pytest.mark.parametrize(("removals", "written"), [(1, True), (3, True), (100, False)])
def test_a_folder_that_is_removed_meanwhile(tmp_path, monkeypatch, removals, written):
    """It is made anew, and the file written again; not for ever."""
    replace, path, seen = os.replace, tmp_path / "run" / "file.safetensors", []

    def removed(source, to):
        seen.append(source)
        if len(seen) <= removals:
            shutil.rmtree(path.parent)
        replace(source, to)

    monkeypatch.setattr(os, "replace", removed)
    if written:
        checkpoint.save(path, TREE, META)
        assert len(seen) == removals + 1 and checkpoint.load_meta(path)["numbers"] == META["numbers"]
    else:
        with pytest.raises(UserError, match=r"^cannot write .*file\.safetensors: No such file or directory$"):
            checkpoint.save(path, TREE, META)
        assert not path.exists()


def test_unwritable_folder(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(UserError, match="cannot write .*policy.safetensors: "):
        checkpoint.save(tmp_path / "file" / "policy.safetensors", TREE, META)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_write_protected_folder(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(UserError, match="cannot write .*policy.safetensors: "):
        checkpoint.save(tmp_path / "policy.safetensors", TREE, META)


def test_missing_file(tmp_path):
    none = tmp_path / "none.safetensors"
    for path, said in ((none, f"^no such file: {none}$"), (tmp_path, f"^{tmp_path} is a folder: give a policy's file$")):
        with pytest.raises(UserError, match=said):
            checkpoint.load_meta(path)
        with pytest.raises(UserError, match=said):
            checkpoint.load(path, TREE)


def test_a_folder_names_a_file_that_is_in_it(tmp_path):
    for name in ("best.safetensors", "policy.safetensors"):
        checkpoint.save(tmp_path / name, TREE, META)
        with pytest.raises(UserError, match=f"^{tmp_path} is a folder: give a file in it, such as {tmp_path / name}$"):
            checkpoint.load_meta(tmp_path)


def truncated(path):
    path.write_bytes(path.read_bytes()[:-5])


def beheaded(path):
    path.write_bytes(path.read_bytes()[:20])


def emptied(path):
    path.write_bytes(b"")


def randomised(path):
    path.write_bytes(np.random.default_rng(0).bytes(4096))


def without_meta(path):
    save_file({"x": np.zeros(3)}, path)


def with_other_meta(path):
    save_file({"x": np.zeros(3)}, path, metadata={"author": "someone"})


def with_broken_meta(path):
    save_file({"x": np.zeros(3)}, path, metadata={"meta": "{"})


@pytest.mark.parametrize(
    "spoil", [truncated, beheaded, emptied, randomised, without_meta, with_other_meta, with_broken_meta], ids=lambda f: f.__name__
)
def test_damaged_files_are_refused(path, spoil):
    spoil(path)
    for read in (lambda: checkpoint.load_meta(path), lambda: checkpoint.load(path, TREE)):
        with pytest.raises(UserError, match=DAMAGED):
            read()


@pytest.mark.parametrize(
    ("template", "message"),
    [
        ({"a": jnp.zeros((3, 2))}, r"does not fit: \['a'\] is float32\(2, 3\), expected float32\(3, 2\)"),
        ({"a": jnp.zeros((2, 3), jnp.int32)}, r"does not fit: \['a'\] is float32\(2, 3\), expected int32\(2, 3\)"),
        ({"c": jnp.zeros(3)}, "does not fit this environment and these networks, or it is damaged"),
    ],
)
def test_other_shapes_types_and_names_are_refused(path, template, message):
    with pytest.raises(UserError, match=message):
        checkpoint.load(path, template)


def test_bfloat16_is_read_as_float32(path):
    """What a file holds in bfloat16 comes back as float32, and nothing else does."""
    held = {"a": jnp.arange(6.0, dtype=jnp.bfloat16).reshape(2, 3) / 3}
    checkpoint.save(path, held, META)
    read = checkpoint.load(path, {"a": jnp.zeros((2, 3))})["a"]
    assert read.dtype == jnp.float32
    np.testing.assert_array_equal(read, held["a"].astype(jnp.float32))
    for other in (jnp.float16, jnp.int32):
        with pytest.raises(UserError, match=r"is bfloat16\(2, 3\), expected "):
            checkpoint.load(path, {"a": jnp.zeros((2, 3), other)})
    checkpoint.save(path, {"a": jnp.zeros((2, 3), jnp.float16)}, META)
    with pytest.raises(UserError, match=r"is float16\(2, 3\), expected float32"):
        checkpoint.load(path, {"a": jnp.zeros((2, 3))})


def test_a_pickle_runs_no_code(tmp_path):
    """A file that would run code on unpickling is merely no policy."""

    class Bomb:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "exploded"),)

    import pickle

    path = tmp_path / "policy.safetensors"
    path.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(UserError, match=DAMAGED):
        checkpoint.load_meta(path)
    assert not (tmp_path / "exploded").exists()


def test_description_is_plain_json(path):
    header = path.read_bytes()
    size = int.from_bytes(header[:8], "little")
    assert json.loads(json.loads(header[8 : 8 + size])["__metadata__"]["meta"]) == META
