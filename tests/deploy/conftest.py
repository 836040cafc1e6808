"""An exported policy and its scene, made once."""

import episodes
import pytest

from mjx_nero.deploy.loop import Brain
from mjx_nero.tasks import registry


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
