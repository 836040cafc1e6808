"""Whole episodes through runtime, driver and emulated servos."""

import episodes

from mjx_nero.deploy.emulators.plant import Faults


def test_episodes_succeed(lift, lift_cfg):
    share, ended = episodes.success(lift, "so101_lift", lift_cfg, 2, Faults(late=0.04))
    assert share == 1.0 and not ended
