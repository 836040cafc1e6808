"""What an expert has played is kept between runs, as long as nothing that it depends on has changed."""

import dataclasses
import functools
import os
import types

import jax
import numpy as np
import pytest

from mjx_nero.control import CONTROLLERS
from mjx_nero.envs import wrappers
from mjx_nero.envs.env import ManipulationEnv
from mjx_nero.errors import UserError
from mjx_nero.files import cache
from mjx_nero.learn import checkpoint
from mjx_nero.mdp.terms import RewardTerm
from mjx_nero.runs import kept, starts
from mjx_nero.tasks.registry import env_cfg

TREE = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "b": np.array([True, False])}


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "mjx_nero" / "experts"


def like(about=None):
    return jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), TREE)


def test_what_was_written_is_read_by_a_later_process(folder):
    kept.Shelf("experts", env_cfg("nero_lift"), 64).write(3, TREE, {"won": 0.27})
    tree, meta = kept.Shelf("experts", env_cfg("nero_lift"), 64).read(3, like)
    assert meta == {"won": 0.27} and all(isinstance(x, np.ndarray) for x in tree.values())
    assert all(np.array_equal(TREE[name], tree[name]) and TREE[name].dtype == tree[name].dtype for name in TREE)
    assert len(list(folder.iterdir())) == 1


def test_another_task_number_or_seed_finds_nothing():
    cfg = env_cfg("nero_lift")
    kept.Shelf("experts", cfg, 64).write(3, TREE, {})
    assert kept.Shelf("experts", cfg, 64).read(4, like) is None
    assert kept.Shelf("experts", cfg, 32).read(3, like) is None
    assert kept.Shelf("experts", env_cfg("nero_lift", **{"rewards.holding_object.weight": 7.0}), 64).read(3, like) is None
    assert kept.Shelf("experts", env_cfg("piper_lift"), 64).read(3, like) is None


def test_a_changed_file_finds_nothing(tmp_path, monkeypatch):
    """The package's own files, its assets, and files and folders that a config names."""
    source, mesh = tmp_path / "source", tmp_path / "mine" / "mug.obj"
    for made in (source / "inner", mesh.parent):
        made.mkdir(parents=True)
    monkeypatch.setattr(kept, "_HERE", source)
    code = source / "inner" / "code.py"
    for file in (code, mesh):
        file.write_text("one")
    for changed in (code, mesh):
        kept.Shelf("experts", str(mesh.parent)).write(0, TREE, {})
        assert kept.Shelf("experts", str(mesh.parent)).read(0, like)
        changed.write_text("more")
        assert kept.Shelf("experts", str(mesh.parent)).read(0, like) is None


def test_another_setting_of_xla_finds_nothing(monkeypatch):
    kept.Shelf("experts", "x").write(0, TREE, {})
    kept._machine.cache_clear()
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=1")
    assert kept.Shelf("experts", "x").read(0, like) is None
    kept._machine.cache_clear()


def _outside(view):
    return 0.0


@pytest.mark.parametrize("func", [_outside, lambda view: 0.0, functools.partial(_outside)])
def test_code_from_outside_is_not_kept(func, folder):
    """Nothing says when a user's function changes."""
    cfg = env_cfg("nero_lift")
    cfg = dataclasses.replace(cfg, rewards={**cfg.rewards, "mine": RewardTerm(func, weight=1.0)})
    kept.Shelf("experts", cfg).write(0, TREE, {})
    assert kept.Shelf("experts", cfg).read(0, like) is None and not folder.exists()


def test_what_a_partial_holds_counts():
    at = CONTROLLERS["pick_up"][0]
    kept.Shelf("experts", functools.partial(at, 1)).write(0, TREE, {})
    assert (
        kept.Shelf("experts", functools.partial(at, 1)).read(0, like)
        and kept.Shelf("experts", functools.partial(at, 2)).read(0, like) is None
    )


@pytest.mark.parametrize("damage", [lambda x: x[:-9], lambda x: x[:-9] + b"\1" + x[-8:], lambda x: b"", lambda x: b"\xff" * 99])
def test_a_damaged_file_is_made_anew(damage, folder):
    shelf = kept.Shelf("experts", "x")
    shelf.write(0, TREE, {})
    (file,) = folder.iterdir()
    file.write_bytes(damage(file.read_bytes()))
    assert shelf.read(0, like) is None
    shelf.write(0, TREE, {})
    assert shelf.read(0, like)


def test_a_tree_of_another_form_is_made_anew():
    shelf = kept.Shelf("experts", "x")
    shelf.write(0, TREE, {})
    assert shelf.read(0, lambda _: {**like(), "c": np.zeros(3)}) is None
    assert shelf.read(0, lambda _: {**like(), "a": np.zeros((2, 4), np.float32)}) is None


def test_the_files_that_nobody_reads_go(folder, monkeypatch):
    shelf = kept.Shelf("experts", "x")
    for seed in range(2):
        shelf.write(seed, TREE, {})
        (file,) = folder.glob(f"*-{seed}.safetensors")
        os.utime(file, (seed + 1, seed + 1))
    monkeypatch.setattr(kept, "ROOM", 2 * file.stat().st_size)
    assert shelf.read(0, like)  # newer than seed 1's now
    shelf.write(2, TREE, {})
    assert shelf.read(0, like) and shelf.read(2, like) and shelf.read(1, like) is None


def test_a_large_tree_a_full_disk_and_no_cache_keep_nothing(folder, monkeypatch):
    shelf = kept.Shelf("experts", "x")
    with monkeypatch.context() as small:
        small.setattr(kept, "ROOM", 10)
        shelf.write(0, TREE, {})

    def full(*_):
        raise UserError("cannot write: No space left on device")

    with monkeypatch.context() as disk:
        disk.setattr(checkpoint, "save", full)
        shelf.write(0, TREE, {})
    assert shelf.read(0, like) is None and not list(folder.glob("*"))
    monkeypatch.setattr(cache, "folder", lambda: None)
    kept.Shelf("experts", "x").write(0, TREE, {})
    assert kept.Shelf("experts", "x").read(0, like) is None


@pytest.mark.slow
def test_an_expert_plays_once(monkeypatch):
    """The second run gets what the first one got, to the bit, and neither traces nor compiles an expert."""
    env = ManipulationEnv(env_cfg("lift", robot="nero", **{"curriculum.expert_starts": 0.5}), impl="native", num_envs=8)
    asked = types.SimpleNamespace(env=wrappers.for_training(env), num_envs=8, imitates=True)
    told: list[str] = []
    first, shapes = starts.Maker(asked, told.append)(0), starts.Maker(asked, told.append).shapes()
    for program in ("_begun", "_played"):
        monkeypatch.setattr(starts, program, None)
    again = starts.Maker(asked, told.append)(0)
    assert set(first) == {"bank", "shown"} and jax.tree.structure(first) == jax.tree.structure(again) == jax.tree.structure(
        shapes
    )
    for one, two, shape in zip(*map(jax.tree.leaves, (first, again, shapes)), strict=True):
        assert np.array_equal(one, two) and one.dtype == two.dtype == shape.dtype and one.shape == shape.shape
    assert len(told) == 2 and told[0].rsplit("(", 1)[0] == told[1].rsplit("(", 1)[0]
