"""The bundled policies: each fits its environment, and one a task and kind of arm succeeds. ``every_policy.py`` plays all."""

import every_policy
import jax
import pytest
from every_policy import NAMES, REAL, SIGHT

from mjx_nero import make
from mjx_nero.learn import policy
from mjx_nero.sim.robot import ASSETS
from mjx_nero.tools import results

# Nobody has trained these by the default command.
ARMS = ("nero", "cobotta", "piper", "so100", "so101")
MISSING = {
    *(f"{arm}_{task}" for arm in ("piper", "so100", "so101") for task in ("hang_ring", "insert_peg")),
    *(f"{arm}_{task}" for arm in ("piper", "so100", "so101") for task in ("open_door", "turn_knob")),
    *(f"{arm}_{task}" for arm in ("so100", "so101") for task in ("open_drawer", "lift_any")),
    "piper_reach_obstacles",
    "piper_reorient",
    "nero_cobotta_handover",
}


def some(names):
    """One name a task and kind of arm (an SO-ARM or not), every arm in its turn."""
    kinds = {}
    for name in names:
        arm, task = name.split("_", 1)
        kinds.setdefault((task, arm.startswith("so10")), []).append(name)
    return [found[turn % len(found)] for turn, found in enumerate(kinds.values())]


PLAYED = some(NAMES)
FILES = [(name, preset) for preset, names in (("default", NAMES), ("sim2real", REAL), ("rgb", SIGHT)) for name in names]


def test_every_task_that_is_to_be_learnt_has_one():
    """But for those that are known to be missing, none of which is there."""
    assert set(results.learnable()) == set(NAMES) | MISSING and not MISSING & set(NAMES)


def test_lifts_and_reaches_have_one_for_the_real_arm():
    assert set(REAL) == {*(f"{arm}_lift" for arm in ("nero", "cobotta", "piper", "so101")), "nero_reach", "cobotta_reach"}


def test_no_file_is_left_out():
    files = {path.stem for path in (ASSETS / "policies").glob("*.safetensors")}
    assert files == {name + ("" if preset == "default" else f"_{preset}") for name, preset in FILES}
    assert {name.split("_")[0] for name in PLAYED} == set(ARMS)
    assert {name.split("_", 1)[1] for name in PLAYED} == {name.split("_", 1)[1] for name in NAMES}


@pytest.mark.parametrize(("name", "preset"), [file for file in FILES if file not in {(name, "default") for name in PLAYED}])
def test_it_fits(name, preset):
    """The file is whole, was trained for this model of the robot and these observations, and acts on them."""
    env = make(name, preset, impl="native")
    trained = policy.load_for(env, name, None, preset=preset)
    assert trained.meta["preset"] == preset and trained.meta["robot"] == env.cfg.robot.name and trained.meta["fingerprint"]
    assert jax.eval_shape(trained.act, env.state_shape.obs).shape == (env.action_size,)


@pytest.mark.slow
@pytest.mark.parametrize("name", PLAYED)
def test_it_succeeds(name):
    every_policy.test_it_succeeds(name)


@pytest.mark.slow
def test_it_succeeds_where_everything_differs():
    every_policy.test_it_succeeds_where_everything_differs("so101_lift")


@pytest.mark.slow
def test_it_succeeds_by_sight():
    every_policy.test_it_succeeds_by_sight("nero_lift", episodes=8)
