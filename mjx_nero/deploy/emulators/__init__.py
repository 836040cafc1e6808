"""Emulated arms, which speak the protocols of real ones, with MuJoCo behind them."""

import contextlib
import json
import pathlib
import subprocess
from collections.abc import Iterator, Mapping
from typing import Any

from mjx_nero.deploy import children
from mjx_nero.errors import UserError

MODULES = {"so101": "feetech", "so100": "feetech", "piper": "agilex", "nero": "agilex", "cobotta": "bcap"}


@contextlib.contextmanager
def started(kind: str, options: Mapping[str, Any], metadata: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """Starts an emulated arm in a separate process; yields the options of the driver that talks to it.

    Args:
        options: ``model`` (a file), ``tracker``, ``objects``, and optionally ``start``, ``faults`` and ``bus``.

    Raises:
        UserError: it does not start.
    """
    folder, driver = pathlib.Path(options["model"]).parent, {}
    told = {"kind": kind, "metadata": {name: metadata[name] for name in ("joints", "gripper", "base", "robot")}, **options}
    if MODULES[kind] == "feetech":
        from mjx_nero.deploy.emulators import feetech

        driver["calibration"] = told["calibration"] = str(folder / "calibration.json")
        (folder / "calibration.json").write_text(json.dumps(feetech.calibration(metadata, kind)))
    argv = children.command(__name__, json.dumps(told))
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True, "env": children.environment()}
    with subprocess.Popen(argv, start_new_session=True, **pipes) as process:  # type: ignore[call-overload]
        try:
            if not (said := process.stdout.readline().strip()):
                raise UserError(f"the emulated {kind} did not start: see its error above")
            yield {**json.loads(said), **driver}
        finally:
            process.stdin.close()
            process.wait(10)
