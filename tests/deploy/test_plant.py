"""The arm behind the emulators."""

import threading
import time

import arms
import mujoco
import numpy as np

from mjx_nero.deploy.emulators.plant import Plant

_HINGE = """<mujoco><worldbody><body><joint name="a" type="hinge"/><geom size="0.1"/></body></worldbody>
<actuator><position joint="a" kp="5" kv="1" forcerange="-3 3"/></actuator></mujoco>"""


def test_one_thread_at_a_time_is_in_the_physics(monkeypatch):
    """An emulator advances the plant in its thread while a test, or the runtime, resets and reads it in another."""
    clock, inside, most = arms.Clock(), [], []
    plant = Plant(mujoco.MjModel.from_xml_string(_HINGE), ["a"], np.zeros(1), clock)

    def watched(call):
        def one(*args):
            inside.append(call)
            most.append(len(inside))
            time.sleep(1e-3)
            call(*args)
            inside.pop()

        return one

    for name in ("mj_step", "mj_resetData", "mj_forward"):
        monkeypatch.setattr(mujoco, name, watched(getattr(mujoco, name)))

    def advances():
        for _ in range(20):
            clock.time += 0.01
            plant.advance()

    threads = [threading.Thread(target=advances), threading.Thread(target=lambda: [plant.reset(np.zeros(1)) for _ in range(20)])]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(most) > 40 and max(most) == 1
