"""The checkpoints of a run, written during training. The newest few and the best one are kept."""

import concurrent.futures
import contextlib
import pathlib
import re
from typing import Any

from mjx_nero import files
from mjx_nero.errors import UserError
from mjx_nero.learn import checkpoint

_NAME = re.compile(r"\d{12}\.safetensors")  # the number of env steps
FOLDER, POLICY, BEST = "checkpoints", "policy.safetensors", "best.safetensors"


class NotWritten(UserError):
    """A checkpoint or policy could not be written. Training must stop, or its result would be lost."""


def saved(run_folder: pathlib.Path) -> list[pathlib.Path]:
    """Lists a run's checkpoints, newest first. Files that the run did not name itself are ignored.

    Raises:
        UserError: one of them is a link.
    """
    folder = files.inside(run_folder, FOLDER)
    names = sorted((path.name for path in folder.glob("*.safetensors") if _NAME.fullmatch(path.name)), reverse=True)
    return [files.inside(run_folder, FOLDER, name) for name in names]


class Checkpoints:
    """Writes a run's checkpoints and policies, one after another, in a thread of its own.

    Args:
        run_folder: folder for ``checkpoints/<steps>.safetensors``, ``policy.safetensors`` and ``best.safetensors``.
        keep: number of newest checkpoints to keep, besides the best.
        active: False in processes that are not the first: they help to assemble the copies, but write nothing.
    """

    def __init__(self, run_folder: pathlib.Path, keep: int, active: bool = True):
        self._folder, self._keep, self._active = run_folder, keep, active
        self._thread = concurrent.futures.ThreadPoolExecutor(max_workers=1)
        self._writing: concurrent.futures.Future[None] | None = None

    def save(self, state: Any, policy: Any, meta: dict[str, Any], steps: int, best: int) -> None:
        """Copies a state and its policy, and queues them for writing. The caller may reuse both at once.

        Args:
            meta: description for the policy's file (``policy.describe``).
            best: env steps of the best checkpoint so far, which may be this one.

        Raises:
            NotWritten: the previous checkpoint could not be written.
        """
        copies = checkpoint.fetch((state, policy))
        self.wait()
        if not self._active:
            return
        self._writing = self._thread.submit(self._write, *copies, meta, steps, best)

    def wait(self) -> None:
        """Waits until everything queued is on the disk.

        Raises:
            NotWritten: it could not be written.
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
            with contextlib.suppress(UserError):  # the policy is smaller, and may still fit
                self._write_policy(policy, meta, False)
            raise NotWritten(str(error)) from None
        for path in saved(self._folder)[self._keep :]:
            if int(path.stem) != best:
                with contextlib.suppress(OSError):
                    path.unlink()

    def _write_policy(self, policy: Any, meta: dict[str, Any], best: bool) -> None:
        for name in (POLICY, BEST) if best else (POLICY,):
            checkpoint.save(self._folder / name, policy, meta)
