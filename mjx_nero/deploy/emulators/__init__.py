"""Arms in software that speak the real ones' protocols, with MuJoCo behind them."""

import contextlib
import json
import pathlib
import subprocess
import sys
from collections.abc import Iterator, Mapping
from typing import Any

from mjx_nero.errors import UserError

_MODULES = {"so101": "feetech", "so100": "feetech", "piper": "piper"}


@contextlib.contextmanager
def started(kind: str, options: Mapping[str, Any], metadata: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    """An emulated arm in a process of its own; gives the options of the driver that talks to it.

    Args:
        options: ``model`` (a file), ``tracker``, ``objects``, and perhaps ``start``, ``faults`` and ``bus``.

    Raises:
        UserError: it does not start.
    """
    folder, driver = pathlib.Path(options["model"]).parent, {}
    told = {"kind": kind, "metadata": {name: metadata[name] for name in ("joints", "gripper", "base", "robot")}, **options}
    if _MODULES[kind] == "feetech":
        from mjx_nero.deploy.emulators import feetech

        driver["calibration"] = told["calibration"] = str(folder / "calibration.json")
        (folder / "calibration.json").write_text(json.dumps(feetech.calibration(metadata, kind)))
    argv = [sys.executable, "-m", f"mjx_nero.deploy.emulators.{_MODULES[kind]}", json.dumps(told)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen(argv, start_new_session=True, **pipes) as process:  # type: ignore[call-overload]
        try:
            if not (port := process.stdout.readline().strip()):
                raise UserError(f"the emulated {kind} did not start")
            yield {"port": port, **driver}
        finally:
            process.stdin.close()
            process.wait(10)
