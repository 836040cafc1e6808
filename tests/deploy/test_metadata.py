"""A stranger's metadata: whatever stands in an exported policy's file, a line says so before an arm's process starts."""

import copy
import itertools

import arms
import pytest

from mjx_nero import UserError
from mjx_nero.deploy import loop, policy, setup
from mjx_nero.deploy.loop import Brain
from mjx_nero.tasks import registry

ODD = (None, True, 3, -1, 0, 1e300, float("nan"), "x", "", [], [None], [[1.0]], {}, {"x": 1}, 10**9, [0.0, 0.0, 0.0], [0.0] * 4)


def places(value, path=()):
    """Every place in plain values, but of a list only the first and the last."""
    yield path
    if isinstance(value, dict):
        for name in value:
            yield from places(value[name], (*path, name))
    elif isinstance(value, list):
        for i in sorted({0, len(value) - 1} if value else ()):
            yield from places(value[i], (*path, i))


def changed(value, path, new):
    """A copy with another value at a place; ``del``: without it."""
    out = copy.deepcopy(value)
    at = out
    for key in path[:-1]:
        at = at[key]
    if new is ...:
        del at[path[-1]]
    else:
        at[path[-1]] = new
    return out


def tried(brain, metadata, fence=False):
    """Does what the command does until the arm's process starts, and then that process; returns what was said."""
    try:
        policy._check(metadata, sum(term["size"] for term in brain.metadata["observations"]), brain.actions)
    except ValueError as error:  # the command puts it into a line
        return str(error)
    try:
        setup.check(metadata)
        other = copy.copy(brain)
        other.metadata = metadata
        other.warm()
        if fence:
            setup.safety_of(metadata)
    except UserError as error:
        return str(error)
    return ""


def test_every_place_in_the_metadata(lift, told, monkeypatch):
    """Three odd values in each, other ones in the next; the fence of a few."""
    monkeypatch.setattr(loop.gc, "collect", lambda: None)  # takes half a second with JAX
    brain, refused, odd = Brain(lift / "policy.onnx"), set(), itertools.cycle(ODD)
    found = list(places(told))[1:]
    for i, path in enumerate(found):
        for new in itertools.islice(odd, 3):
            said = tried(brain, changed(told, path, new), fence=not i % 50)
            assert len(said.splitlines()) <= 1
            refused |= {path} if said else set()
    assert tried(brain, told, fence=True) == "" and len(found) > 100
    assert all(tried(brain, changed(told, (name,), ...)) for name in setup.NEEDED)
    assert len({path[0] for path in refused} & {*setup.NEEDED}) > 8


def test_names_that_make_a_circle(lift, told):
    circle = [
        {**told["body"]["bodies"][0], "name": name, "parent": parent} for name, parent in (("a", None), ("b", "a"), ("a", "b"))
    ]
    metadata = {**told, "body": {**told["body"], "bodies": circle, "ee": {**told["body"]["ee"], "body": "a"}}}
    assert "two bodies are called 'a'" in tried(Brain(lift / "policy.onnx"), metadata)


def test_too_many_shapes(lift, told):
    metadata = {**told, "body": {**told["body"], "shapes": told["body"]["shapes"] * 100}}
    assert "at most 150 shapes" in tried(Brain(lift / "policy.onnx"), metadata)


def test_an_arm_that_calls_itself_a_gripper(lift, told):
    """A gripper's joints may be blocked and press; an arm's may not."""
    assert "all joints" in tried(Brain(lift / "policy.onnx"), {**told, "gripper": told["joints"]["names"]})


@pytest.mark.parametrize("env", ["nero_lift", "cobotta_reach", "so100_lift", "so101_reach", "piper_reach"])
def test_every_corner_of_a_tasks_own_region_is_within_reach(env):
    cfg = registry.env_cfg(env)
    told = arms.metadata(cfg.robot.name)
    for corner in itertools.product(*(cfg.command.params[axis] for axis in "xyz")):
        setup.check_reach(told, setup.body_of(told), "--goal", corner)
