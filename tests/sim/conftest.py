"""Physics is tested by scripts, which act by positions."""

import pytest
from batches import Batch

import mjx_nero
from mjx_nero.envs.task import joint_actions


@pytest.fixture(scope="session")
def env() -> mjx_nero.ManipulationEnv:
    """As all tests' ``env``, with an action that is where the joints are to be."""
    return mjx_nero.make("nero_lift", impl="native", actions=joint_actions())


@pytest.fixture(scope="session")
def batch(env) -> Batch:
    """Of that one: a fixture of the whole session keeps what it was first made of."""
    return Batch(env)
