"""Arms for the tests of the runtime: what a policy says of a robot, an arm without physics."""

import json
import threading

import numpy as np

from mjx_nero.deploy.arm import ArmError, Feedback
from mjx_nero.deploy.emulators.timeless import Clock
from mjx_nero.interop import description
from mjx_nero.tasks import registry

__all__ = ["PATIENT", "Bench", "Clock", "Ideal", "metadata"]

# Run before the command ``deploy``, which then forgives a busy machine its deadlines: what those do is tested in simulated time.
PATIENT = """
import dataclasses
from mjx_nero.tools.deploy import arms
limits = arms.safety_of
arms.safety_of = lambda args: dataclasses.replace(limits(args), misses=1_000_000, silence=60.0, stale=60.0, behind_s=60.0)
"""


def metadata(name, dt=0.02):
    """The part of a policy's metadata that is about its robot."""
    task = {"env": "reach", "preset": "default", "observations": [], "command": {}, "objects": {}}
    told = {**description.robot(registry.robot(name)), "robot": name, "control_dt": dt, **task}
    return json.loads(json.dumps(told))


class Bench:
    """An emulated ``arm`` behind its ``guard``, in time that passes where the test waits; answers need a thread meanwhile."""

    def serve(self):
        self._over = threading.Event()
        self._thread = threading.Thread(target=self.port.serve, args=(self._over.is_set,), daemon=True)
        self._thread.start()

    def stop(self):
        self._over.set()
        self._thread.join()

    def start(self):
        self.arm.connect()
        self.arm.engage()
        return self.guard.start()

    def play(self, targets):
        for target in targets:
            due = self.clock.now() + 0.02
            self.guard.read()
            self.guard.command(target)
            self.clock.sleep_until(due)


class Ideal:
    """An arm that is at once where it is told to be; ``told`` has what was sent. There is no way to ask it to cut torque."""

    def __init__(self, joints, home, clock):
        self.joints, self.clock = joints, clock
        self.at, self.told, self.broken = np.array(home, float), [], ""
        self.bend = lambda feedback: feedback

    def connect(self):
        pass

    def ranges(self):
        return None

    def engage(self):
        pass

    def read(self):
        if "read" in self.broken:
            raise ArmError("no answer")
        still = np.zeros(len(self.at))
        return self.bend(Feedback(self.clock.now(), self.at.copy(), still, still, still + 30.0))

    def command(self, position, velocity):
        if "send" in self.broken:
            raise ArmError("the cable is cut")
        self.at = position.copy()
        self.told.append(position.copy())
        return position

    def close(self):
        pass
