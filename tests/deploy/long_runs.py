"""What takes minutes each, and is run by name: pytest tests/deploy/long_runs.py"""

import arms
import pytest
from test_episodes import success
from test_safety import ROBOTS, fuzz, fuzz_feedback

from mjx_nero.deploy.emulators.plant import Faults


@pytest.mark.parametrize("name", ROBOTS)
def test_a_million_wild_targets_never_get_beyond_a_limit(name):
    _, worst = fuzz(arms.metadata(name), 1_000_000 // len(ROBOTS), 1)
    assert max(worst.values()) < 1e-6, worst


def test_a_hundred_thousand_feedbacks_are_fuzzed():
    fuzz_feedback(arms.metadata("so_arm101"), 100_000)


@pytest.mark.parametrize(("faults", "least"), [(Faults(), 0.95), (Faults(stiffness=0.8, late=0.04), 0.85)])
def test_a_hundred_episodes_succeed(lift, faults, least):
    """With drives of the model's, and with drives 20% softer and 40 ms late."""
    share, ended = success(lift, 100, faults)
    assert share >= least, (share, ended)
