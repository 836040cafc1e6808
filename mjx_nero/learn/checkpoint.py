"""Checkpoints: arrays and a JSON description in one safetensors file. No pickle, so reading an untrusted file runs no code."""

import json
import pathlib
import zlib
from collections.abc import Mapping
from typing import Any, TypeVar

import jax
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialize

from mjx_nero import files
from mjx_nero.errors import UserError
from mjx_nero.learn import header, machines

Tree = TypeVar("Tree")


class Damaged(UserError):
    """A file that ``save`` did not write, or that has changed since."""


def _names(tree: Any) -> list[str]:
    return [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)]


def _renamed(name: str, held: Mapping[str, str]) -> str:
    return next((other + name.removeprefix(own) for own, other in held.items() if name.startswith(own)), name)


def fetch(tree: Tree) -> Tree:
    """Copies the tree's arrays to this process's memory, so that the device may overwrite its own."""
    return jax.tree.map(machines.fetch, tree)


def save(path: pathlib.Path, tree: Any, meta: dict[str, Any]) -> None:
    """Writes the leaves of ``tree`` by name, and ``meta``. The file appears whole or not at all.

    Raises:
        UserError: the folder cannot be written.
    """
    arrays = dict(zip(_names(tree), [np.asarray(x, order="C") for x in jax.tree.leaves(tree)], strict=True))
    text = json.dumps(files.finite(meta), allow_nan=False)
    files.write(path, serialize(arrays, metadata={"meta": text, "crc32": _checksum(arrays)}))


def verify(path: pathlib.Path) -> None:
    """Checks a file's numbers against their checksum.

    Raises:
        Damaged: the file is missing, or its numbers have changed.
    """
    try:
        load_meta(path)
    except UserError as error:
        raise Damaged(str(error)) from None
    try:
        with safe_open(path, framework="numpy") as file:
            wanted = file.metadata().get("crc32")  # files of older versions have none
            good = wanted is None or wanted == _checksum({name: file.get_tensor(name) for name in file.keys()})
    except (SafetensorError, OSError, ValueError):
        good = False
    if not good:
        raise Damaged(f"{path} is damaged (its numbers have changed since it was written): copy it again or give another file")


def not_finite(tree: Any) -> str | None:
    """Returns the name of the first array with a number that is not finite, or None."""
    for name, x in zip(_names(tree), jax.tree.leaves(tree), strict=True):
        if not np.isfinite(np.asarray(x)).all():
            return name
    return None


def check_finite(tree: Any, path: pathlib.Path) -> None:
    """Checks that all numbers of a policy are finite.

    Raises:
        UserError: the file at ``path`` holds one that is not.
    """
    if name := not_finite(tree):
        raise UserError(f"{path} holds numbers that are not finite, in {name}: give an earlier file, or copy it again")


def _checksum(arrays: dict[str, np.ndarray]) -> str:
    total = 0
    for _, x in sorted(arrays.items()):
        total = zlib.crc32(x.tobytes(), total)
    return f"{total:08x}"


def load_meta(path: pathlib.Path) -> dict[str, Any]:
    """Reads the description in the file.

    Raises:
        UserError: the file is missing, or ``save`` did not write it.
    """
    if path.is_dir():
        there = sorted(path.glob("*.safetensors"), key=lambda p: p.name != "policy.safetensors")
        raise UserError(f"{path} is a folder: " + (f"give a file in it, such as {there[0]}" if there else "give a policy's file"))
    if not path.is_file():
        raise UserError(f"no such file: {path}")
    _, texts = header.read(path)
    try:
        meta = files.parse_json(texts["meta"])
    except (LookupError, ValueError, RecursionError):
        meta = None
    if not isinstance(meta, dict):
        raise header.damaged(path)
    return meta


def load(path: pathlib.Path, template: Tree, held: Mapping[str, str] | None = None) -> Tree:
    """Reads the arrays as a tree like ``template``, whose leaves need only shape and dtype.

    A float32 of the template may be bfloat16 in the file (``learner.Kind.stored``).

    Args:
        held: prefix of a name in ``template`` -> its prefix in the file, if the file holds a larger tree.

    Raises:
        UserError: the file is missing or damaged, or its names, shapes or types differ from the template's.
    """
    verify(path)
    there, _ = header.read(path)
    names = [_renamed(name, held or {}) for name in _names(template)]
    wanted = dict(zip(names, jax.tree.leaves(template), strict=True))
    for name, want in wanted.items():  # checked before reading: the file may be larger than the memory
        kind, shape = there.get(name, (str(want.dtype), want.shape))
        if (kind, str(want.dtype)) != ("bfloat16", "float32") and kind != str(want.dtype) or shape != want.shape:
            raise UserError(f"{path} does not fit: {name} is {kind}{shape}, expected {want.dtype}{want.shape}")
    try:
        with safe_open(path, framework="numpy") as file:
            arrays = [file.get_tensor(name).astype(want.dtype, copy=False) for name, want in wanted.items()]
            leaves = jax.device_put(arrays)  # jnp.asarray compiles a program for each
    except (SafetensorError, OSError):
        raise UserError(f"{path} does not fit this environment and these networks, or it is damaged: give another file") from None
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
