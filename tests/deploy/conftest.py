"""An exported policy and its scene, made once."""

import threading
import time

import arms
import episodes
import pytest

from mjx_nero.deploy.loop import Brain
from mjx_nero.tasks import registry
from mjx_nero.tools.deploy import arms as command


@pytest.fixture(scope="session")
def lift(tmp_path_factory):
    """``so101_lift`` in ``sim2real``: a folder with ``policy.onnx`` and ``scene.mjb``."""
    folder = tmp_path_factory.mktemp("lift")
    episodes.exported(folder, "so101_lift")
    return folder


@pytest.fixture(scope="session")
def lift_cfg():
    """Its config."""
    return registry.env_cfg("so101_lift", "sim2real")


@pytest.fixture(scope="session")
def told(lift):
    """The policy's metadata."""
    return Brain(lift / "policy.onnx").metadata


@pytest.fixture
def patient(monkeypatch):
    """``deploy``, as ``arms.PATIENT`` has it."""
    monkeypatch.setattr(command, "safety_of", command.safety_of)  # so that it is put back
    exec(arms.PATIENT, {})


@pytest.fixture
def late():
    """By how much this machine wakes sleepers late while a test runs, at worst [s]: what a busy one adds to any deadline."""
    worst, over = [0.0], threading.Event()

    def sleeper():
        while not over.is_set():
            begun = time.monotonic()
            time.sleep(0.005)
            worst[0] = max(worst[0], time.monotonic() - begun - 0.005)

    thread = threading.Thread(target=sleeper, daemon=True)
    thread.start()
    yield lambda: worst[0]
    over.set()
    thread.join()
