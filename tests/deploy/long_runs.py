"""What takes minutes each, and is run by name: pytest tests/deploy/long_runs.py"""

import arms
import episodes
import pytest
from test_safety import ROBOTS, fuzz, fuzz_feedback

from mjx_nero.deploy.emulators.plant import Faults
from mjx_nero.tools.deploy import trial


@pytest.mark.parametrize("name", ROBOTS)
def test_a_million_wild_targets_never_get_beyond_a_limit(name):
    _, worst = fuzz(arms.metadata(name), 1_000_000 // len(ROBOTS), 1)
    assert max(worst.values()) < 1e-6, worst


def test_a_hundred_thousand_feedbacks_are_fuzzed():
    fuzz_feedback(arms.metadata("so_arm101"), 100_000)


ARMS = {"so101_lift": "so101", "piper_lift": "piper", "nero_lift": "nero"}


@pytest.mark.parametrize(("name", "least"), [("so101_lift", 0.95), ("piper_lift", 0.97), ("nero_lift", 0.97)])
def test_a_hundred_episodes_succeed_as_in_eval(tmp_path, name, least):
    """Within 3 points of what ``eval.py`` measures (docs/guides/sim2real.md), over the arm's own protocol."""
    cfg = episodes.exported(tmp_path, name)
    share, ended = trial.lifts(tmp_path / "policy.onnx", cfg, ARMS[name], 100, Faults())
    print(f"{name}: {share:.2f}, {len(ended)} ended early")
    assert share >= least, (share, ended)


def test_a_hundred_episodes_with_soft_and_late_drives(lift, lift_cfg):
    """Drives 20% softer and 40 ms late, which ``--delay`` is told of."""
    share, ended = trial.lifts(lift / "policy.onnx", lift_cfg, "so101", 100, Faults(stiffness=0.8, late=0.04))
    print(f"so101_lift, soft and late: {share:.2f}, {len(ended)} ended early")
    assert share >= 0.85, (share, ended)
