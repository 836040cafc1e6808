"""The checkpoints of a run: written beside the training, the newest few and the best of them kept."""

import concurrent.futures
import contextlib
import pathlib
import re
from typing import Any

from mjx_nero import files
from mjx_nero.errors import UserError
from mjx_nero.learn import checkpoint

_NAME = re.compile(r"\d{12}\.safetensors")  # env steps
FOLDER, POLICY, BEST = "checkpoints", "policy.safetensors", "best.safetensors"


class NotWritten(UserError):
    """A checkpoint or policy that could not be written: training without them would be for nothing."""


def saved(run_folder: pathlib.Path) -> list[pathlib.Path]:
    """Checkpoints of a run, the newest first. What the run has not named so itself is somebody else's, and left alone.

    Raises:
        UserError: a link stands in their place.
    """
    folder = files.inside(run_folder, FOLDER)
    names = sorted((path.name for path in folder.glob("*.safetensors") if _NAME.fullmatch(path.name)), reverse=True)
    return [files.inside(run_folder, FOLDER, name) for name in names]


class Checkpoints:
    """Writes a run's checkpoints and policies in a thread of its own, one after another.

    Args:
        run_folder: gets ``checkpoints/<steps>.safetensors``, ``policy.safetensors`` and ``best.safetensors``.
        keep: how many of the newest stay; the best does beside them.
        active: False writes nothing, in a process that is not the first, but helps to put the copies together.
    """

    def __init__(self, run_folder: pathlib.Path, keep: int, active: bool = True):
        self._folder, self._keep, self._active = run_folder, keep, active
        self._thread = concurrent.futures.ThreadPoolExecutor(max_workers=1)
        self._writing: concurrent.futures.Future[None] | None = None

    def save(self, state: Any, policy: Any, meta: dict[str, Any], steps: int, best: int) -> None:
        """Hands a state and its policy over; they are copied, so the caller may go on with them.

        Args:
            meta: of the policy's file (``policy.describe``).
            best: env steps of the best checkpoint so far, perhaps these.

        Raises:
            NotWritten: the one before.
        """
        copies = checkpoint.fetch((state, policy))
        self.wait()
        if not self._active:
            return
        self._writing = self._thread.submit(self._write, *copies, meta, steps, best)

    def wait(self) -> None:
        """Until all that was handed over is on the disk.

        Raises:
            NotWritten: it is not.
        """
        if self._writing is not None:
            writing, self._writing = self._writing, None
            writing.result()

    def close(self) -> None:
        """Ends the thread."""
        self._thread.shutdown()

    def _write(self, state: Any, policy: Any, meta: dict[str, Any], steps: int, best: int) -> None:
        try:
            checkpoint.save(self._folder / FOLDER / f"{steps:012d}.safetensors", state, {**meta, "kind": "checkpoint"})
            self._write_policy(policy, meta, steps == best)
        except UserError as error:
            with contextlib.suppress(UserError):  # it is smaller, and may find room yet
                self._write_policy(policy, meta, False)
            raise NotWritten(str(error)) from None
        for path in saved(self._folder)[self._keep :]:
            if int(path.stem) != best:
                with contextlib.suppress(OSError):
                    path.unlink()

    def _write_policy(self, policy: Any, meta: dict[str, Any], best: bool) -> None:
        for name in (POLICY, BEST) if best else (POLICY,):
            checkpoint.save(self._folder / name, policy, meta)
