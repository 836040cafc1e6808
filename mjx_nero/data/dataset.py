"""Opens data sets by their folder, whatever their format."""

import contextlib
import importlib
import pathlib
from collections.abc import Iterator, Sequence
from typing import Protocol

import numpy as np

from mjx_nero.data import folder
from mjx_nero.data.episode import Dataset, Episode, Schema
from mjx_nero.errors import UserError

# Form -> module, class, and the file that only this form has.
FORMS = {
    "lerobot": ("mjx_nero.data.lerobot", "LeRobotForm", "meta/info.json"),
    "arrays": ("mjx_nero.data.arrays", "ArraysForm", "meta/pieces.json"),
}


class Form(Protocol):
    """A data set in a folder that is claimed, or only read. It is made from the folder and the schema.

    Attributes:
        lengths, success, numbers: of the episodes in it, see ``Dataset``.

    Raises:
        UserError: the data set is damaged.
    """

    lengths: np.ndarray
    success: np.ndarray
    numbers: np.ndarray

    def tidy(self) -> None: ...
    def put(self, episodes: Sequence[Episode]) -> None: ...
    def finish(self) -> None: ...
    def column(self, name: str) -> np.ndarray: ...
    def frames(self, name: str) -> Iterator[np.ndarray]: ...


def _make(name: str, path: pathlib.Path, schema: Schema) -> Form:
    module, kind, _ = FORMS[name]
    return getattr(importlib.import_module(module), kind)(path, schema)


def _held(path: pathlib.Path) -> str | None:
    """Returns the form of the data set in a folder; None if it has no episodes yet."""
    return next((name for name, (_, _, index) in FORMS.items() if (path / index).exists()), None)


def check_writable(path: pathlib.Path, schema: Schema, form: str = "lerobot") -> None:
    """Checks that a folder is free, or holds a data set of this schema and form, and makes nothing.

    Raises:
        UserError: the folder holds something else, or a package is missing.
    """
    _check_form(path, form)
    folder.check(path, schema)


def _check_form(path: pathlib.Path, form: str) -> None:
    held = _held(path)
    if held not in (None, form):
        raise UserError(f"{path} holds a data set in the form {held!r}: pass --form {held}, or another folder")
    importlib.import_module(FORMS[form][0])  # a package may be missing


@contextlib.contextmanager
def writer(path: pathlib.Path, schema: Schema, form: str = "lerobot") -> Iterator[Form]:
    """Opens a data set for writing: a new one, or the one in the folder, to continue it. It is finished at the end, even after
    an error.

    Raises:
        UserError: the folder holds something else or cannot be written, or a package is missing.
    """
    _check_form(path, form)  # before the folder is made
    with folder.claim(path, schema):
        made = _make(form, path, schema)
        made.tidy()
        try:
            yield made
        except BaseException:
            with contextlib.suppress(UserError):  # report the first error
                made.finish()
            raise
        made.finish()


def open_dataset(path: pathlib.Path) -> Dataset:
    """Opens the data set in a folder.

    Raises:
        UserError: there is no data set, or it is damaged.
    """
    schema, form = folder.schema_of(path), _held(path)
    if form is None:
        raise UserError(f"{path} holds no episode yet: repeat the command that started it")
    made = _make(form, path, schema)
    return Dataset(schema, made.lengths, made.success, made.numbers, made.column, made.frames)


def open_with(path: pathlib.Path, index: int) -> Dataset:
    """Opens a data set that has an episode ``index``.

    Raises:
        UserError: there is no data set, it is damaged, or it has no such episode.
    """
    found = open_dataset(path)
    if not 0 <= index < len(found):
        raise UserError(f"{path} has {len(found)} episodes: --episode takes a number from 0 to {len(found) - 1}")
    return found
