"""MuJoCo Warp's functions, of which only what is asked for is imported."""

import json
import subprocess
import sys

import pytest

pytest.importorskip("warp")

from mjx_nero.sim.physics.warp import engine

READ = """
import json, sys
from mjx_nero.sim.physics.warp import engine
named = {name: getattr(engine, name) for name in engine._MODULES}
before = {name.rpartition(".")[2] for name in sys.modules if "mujoco_warp._src." in name}
other = engine.step
import mujoco.mjx.third_party.mujoco_warp as whole
assert other is whole.step
same = [name for name, value in named.items() if getattr(whole, name, value) is value]
print(json.dumps([sorted(before), sorted(same)]))
"""


def test_no_more_is_imported_than_is_asked_for():
    done = subprocess.run([sys.executable, "-c", READ], stdout=subprocess.PIPE, text=True, check=True)
    modules, same = json.loads(done.stdout.splitlines()[-1])
    assert {"io", "collision_driver", "constraint"} <= set(modules)
    assert not {"solver", "sensor", "forward", "render", "passive", "derivative", "island"} & set(modules)
    assert same == sorted(engine._MODULES)  # the package's own, where it has them


def test_what_it_does_not_have():
    with pytest.raises(AttributeError, match="no_such_function"):
        engine.no_such_function  # noqa: B018
