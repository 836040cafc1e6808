"""The process of an emulated arm.

    python -m mjx_nero.deploy.emulators '{"kind": "so101", "model": "scene.mjb", ...}'

prints the ports, ``--port`` among them, and serves until its input ends.
"""

import importlib
import json
import sys

from mjx_nero.deploy.emulators import MODULES, plant
from mjx_nero.deploy.guard import WallClock, urgent


def main() -> None:
    """Makes the plant and the arm that ``emulators.started`` describes, prints the arm's ports, and serves."""
    told = json.loads(sys.argv[1])
    scene = {name: told.get(name) for name in ("model", "tracker", "start", "objects", "faults")}
    module = importlib.import_module(f"mjx_nero.deploy.emulators.{MODULES[told['kind']]}")
    port = module.port_of(plant.of(told["metadata"], WallClock(), **scene), told)
    gripper = getattr(port, "gripper", None)
    print(json.dumps({"port": port.name, **({"gripper": gripper} if gripper else {})}), flush=True)
    with urgent():
        port.serve(other=sys.stdin.fileno())


if __name__ == "__main__":
    main()
