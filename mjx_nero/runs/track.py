"""Tracking services that receive a run's metrics besides its folder: ``--track``."""

import importlib.util
import os
import pathlib
import re
import uuid
from collections.abc import Callable
from typing import Any

from mjx_nero import config, files
from mjx_nero.errors import UserError
from mjx_nero.runs.cfg import RunCfg
from mjx_nero.runs.logs import Row, Tracker


class Wandb:
    """Weights & Biases: a run in the project ``mjx_nero`` with every row, over env steps.

    Its settings come from the environment, such as ``WANDB_MODE=offline`` and ``WANDB_PROJECT``. A resumed run continues there,
    too.
    """

    def __init__(self, run: RunCfg, folder: pathlib.Path):
        import wandb

        own = files.inside(folder, "wandb", "id")
        if not own.exists():
            files.write(own, uuid.uuid4().hex.encode())
        name = files.read_bytes(own, 100).decode(errors="replace")
        if not re.fullmatch("[0-9a-f]{32}", name):
            raise UserError(f"{own} does not hold the id of a run: remove it")
        self._run: Any = wandb.init(
            project=os.environ.get("WANDB_PROJECT", "mjx_nero"),
            name=folder.name,
            id=name,
            dir=folder,
            config=config.to_dict(run),
            resume="allow",
            settings=wandb.Settings(console="off", silent=True),  # leaves stdout and stderr alone
        )

    def write(self, row: Row) -> None:
        """Sends a row of metrics."""
        self._run.log({name: value for name, value in row.items() if value is not None}, step=int(row["steps"]))

    def close(self) -> None:
        """Waits until everything is sent."""
        self._run.finish()


TRACKERS: dict[str, Callable[[RunCfg, pathlib.Path], Tracker]] = {"wandb": Wandb}


def check(name: str) -> None:
    """Checks that a tracker's package is installed.

    Raises:
        UserError: it is not.
    """
    if name and importlib.util.find_spec(name) is None:
        raise UserError(f"--track {name} needs the package {name}, of the extra 'track': pip install 'mjx-nero[track]'")


def tracker(run: RunCfg, folder: pathlib.Path) -> Callable[[], Tracker] | None:
    """Returns a function that makes the run's tracker; None if it has none."""
    return (lambda: TRACKERS[run.track](run, folder)) if run.track else None
