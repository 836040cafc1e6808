"""The header of a policy or checkpoint. The file is untrusted: its sizes are limited before it is parsed."""

import math
import pathlib
from collections.abc import Callable, Mapping
from typing import Any

from safetensors import SafetensorError, safe_open

from mjx_nero import files
from mjx_nero.config.values import short
from mjx_nero.errors import UserError

MAX_HEAD = 2_000_000  # bytes
MAX_FILE = 20_000_000_000  # bytes; a checkpoint holds all environments
MAX_POLICY = 200_000_000  # bytes
MAX_ARRAYS = 5_000
MAX_LAYERS, MAX_WIDTH = 16, 8192  # of networks
MAX_SIZE = 1_000_000  # numbers per observation group
DTYPES = {  # a safetensors file's name of a type -> numpy's
    "F64": "float64",
    "F32": "float32",
    "F16": "float16",
    "BF16": "bfloat16",
    "I64": "int64",
    "I32": "int32",
    "I16": "int16",
    "I8": "int8",
    "U64": "uint64",
    "U32": "uint32",
    "U16": "uint16",
    "U8": "uint8",
    "BOOL": "bool",
}
Arrays = dict[str, tuple[str, tuple[int, ...]]]  # name -> (numpy's name of the type, shape)


def read(path: pathlib.Path) -> tuple[Arrays, dict[str, str]]:
    """Reads which arrays a safetensors file holds, and its texts by name.

    Raises:
        UserError: the file is missing, too large or damaged.
    """
    with files.open_file(path) as (file, size):
        if size > MAX_FILE:
            raise UserError(f"{path} has {size / 1e9:.0f} GB: files above {MAX_FILE / 1e9:.0f} GB are not read")
        if int.from_bytes(file.read(8), "little") > MAX_HEAD:
            raise damaged(path)
    try:
        with safe_open(path, framework="numpy") as held:
            parts = {name: held.get_slice(name) for name in held.keys()}
            arrays = {name: (DTYPES[part.get_dtype()], tuple(part.get_shape())) for name, part in parts.items()}
            texts = held.metadata() or {}
    except (SafetensorError, OSError, KeyError):
        raise damaged(path) from None
    if len(arrays) > MAX_ARRAYS:
        raise damaged(path)
    return arrays, texts


def damaged(path: pathlib.Path) -> UserError:
    """Makes the error for a file that mjx_nero did not write."""
    return UserError(f"{path} is not a policy or checkpoint of mjx_nero, or it is damaged: train again or copy it again")


def check(meta: Mapping[str, Any], path: pathlib.Path) -> None:
    """Checks what a file says of its policy: each field that the package uses has its type and a plausible size.

    Raises:
        UserError: a field is missing, has the wrong type, or is too large.
    """
    for name in ("env", "preset", "observation_size", "observations", "action_size"):
        if name not in meta:
            raise UserError(f"{path} does not describe a policy: give the policy.safetensors of a run (it has no {name!r})")
    check_fields(meta, path)


def check_fields(meta: Mapping[str, Any], path: pathlib.Path) -> None:
    """Checks the fields that are there, as ``check`` does: checkpoints of older versions have fewer.

    Raises:
        UserError: a field has the wrong type, or is too large.
    """
    for name, good in _FIELDS.items():
        if name in meta and not good(meta[name]):
            shown = short(meta[name])
            raise UserError(f"{path} does not describe a policy: give the policy.safetensors of a run (its {name} is {shown})")


def acts_alike(*metas: Mapping[str, Any]) -> bool:
    """Returns whether two policies' actions have the same kinds. Files before 0.5.0 do not say; they take joint positions."""
    said = [list(meta["actions"]) for meta in metas if "actions" in meta]
    return said[0] == said[1] if len(said) == 2 else all(kinds[:1] == ["JointPosition"] for kinds in said)


def _word(value: Any) -> bool:
    return isinstance(value, str) and 0 < len(value) <= 200 and value.isprintable()


def _whole(lowest: int, most: int) -> Callable[[Any], bool]:
    return lambda value: type(value) is int and lowest <= value <= most


def _list(good: Callable[[Any], bool], most: int) -> Callable[[Any], bool]:
    return lambda value: isinstance(value, list) and len(value) <= most and all(map(good, value))


def _groups(good: Callable[[Any], bool]) -> Callable[[Any], bool]:
    """Checks a mapping that holds the group ``state``, which every policy observes."""
    return lambda value: isinstance(value, dict) and "state" in value and all(_word(k) and good(v) for k, v in value.items())


def _size(value: Any) -> bool:
    return bool(value) and _list(_whole(1, MAX_SIZE), 4)(value) and math.prod(value) <= MAX_SIZE


def _sizes(value: Any) -> bool:
    """Checks the shape of a group, or the shapes of its terms if they stay apart."""
    return (
        _size(value) or isinstance(value, dict) and 0 < len(value) <= 200 and all(_word(k) and _size(v) for k, v in value.items())
    )


def _number(most: float) -> Callable[[Any], bool]:
    return lambda value: type(value) in (int, float) and 0 <= value <= most


def _tally(value: Any) -> bool:
    """Checks the counts of a run: numbers, some of them optional, and its last evaluation."""
    open = ("seconds_to_95", "steps_to_95", "rewound_at")
    return isinstance(value, dict) and all(
        isinstance(v, dict) if k == "evaluation" else type(v) in (int, float) or v is None and k in open for k, v in value.items()
    )


_LAYERS = _list(_whole(1, MAX_WIDTH), MAX_LAYERS)
_NETWORK: dict[str, Callable[[Any], bool]] = {
    "actor": _LAYERS,
    "critic": _LAYERS,
    "activation": _word,
    "distribution": _word,
    "init_std": lambda value: _number(100)(value) and value > 0,
    "output_scale": _number(1e6),
    "max_observation": _number(1e6),
    "encoders": _list(lambda pair: _list(_word, 2)(pair) and len(pair) == 2, 200),
    "encoder_layers": _LAYERS,
}
_FIELDS: dict[str, Callable[[Any], bool]] = {
    **dict.fromkeys(("kind", "env", "preset", "robot", "learner", "fingerprint", "version"), _word),
    "observation_size": _groups(_sizes),
    "observations": _groups(_list(_word, 200)),
    "action_size": _whole(1, 1000),
    "actions": _list(_word, 200),
    "env_steps": _whole(0, 1 << 60),
    "num_envs": _whole(1, 1 << 24),
    "tally": _tally,
    "network": lambda value: isinstance(value, dict) and all(k in _NETWORK and _NETWORK[k](v) for k, v in value.items()),
}
