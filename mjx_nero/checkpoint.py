"""Arrays and a JSON description in one safetensors file: no pickle, so a file from a stranger runs no code."""

import contextlib
import json
import os
import pathlib
from typing import Any, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save as serialize

from mjx_nero.types import UserError

Tree = TypeVar("Tree")


def _names(tree: Any) -> list[str]:
    return [jax.tree_util.keystr(path) for path, _ in jax.tree_util.tree_leaves_with_path(tree)]


def save(path: pathlib.Path, tree: Any, meta: dict[str, Any]) -> None:
    """Writes the leaves of ``tree`` by name, and ``meta``; the file appears whole or not at all.

    Raises:
        UserError: the folder cannot be written.
    """
    arrays = dict(zip(_names(tree), [np.asarray(x, order="C") for x in jax.tree.leaves(tree)], strict=True))
    part = path.with_name(f".{path.name}.part")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        part.write_bytes(serialize(arrays, metadata={"meta": json.dumps(meta)}))
        os.replace(part, path)
    except (OSError, SafetensorError) as error:
        with contextlib.suppress(OSError):
            part.unlink()
        raise UserError(f"cannot write {path}: {error}") from None


def load_meta(path: pathlib.Path) -> dict[str, Any]:
    """The description in the file.

    Raises:
        UserError: missing, or not a file that ``save`` wrote.
    """
    if not path.is_file():
        raise UserError(f"no such file: {path}")
    try:
        with safe_open(path, framework="numpy") as file:
            return json.loads(file.metadata()["meta"])
    except (SafetensorError, KeyError, TypeError, ValueError, OSError):
        raise UserError(
            f"{path} is not a policy or checkpoint of mjx_nero, or it is damaged: train again or copy it anew"
        ) from None


def load(path: pathlib.Path, template: Tree) -> Tree:
    """The arrays in the file as a tree like ``template`` (whose leaves need only shape and dtype).

    Raises:
        UserError: missing, damaged, or other names, shapes or types than the template's.
    """
    load_meta(path)
    leaves = []
    try:
        with safe_open(path, framework="numpy") as file:
            for name, want in zip(_names(template), jax.tree.leaves(template), strict=True):
                value = file.get_tensor(name)
                if value.shape != want.shape or value.dtype != want.dtype:
                    raise UserError(
                        f"{path} does not fit: {name} is {value.dtype}{value.shape}, expected {want.dtype}{want.shape}"
                    )
                leaves.append(jnp.asarray(value))
    except (SafetensorError, OSError):
        raise UserError(f"{path} does not fit this environment and these networks, or it is damaged") from None
    return jax.tree.unflatten(jax.tree.structure(template), leaves)
