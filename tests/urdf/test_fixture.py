"""URDFs of things with joints become fixtures."""

import json
import math

import jax.numpy as jnp
import numpy as np
import pytest

from mjx_nero import UserError
from mjx_nero.sim import fixtures, scene
from mjx_nero.sim.fixtures import FixtureCfg
from mjx_nero.sim.scene import SceneCfg, SimCfg
from mjx_nero.tasks.arms.nero import NERO
from mjx_nero.urdf.fixture import import_fixture

# A chest of 40 cm with a lid, hinged at its far edge; the handle is a link at the near one.
CHEST = """
<robot name="chest">
  <link name="case">
    <inertial><mass value="5"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><geometry><box size="0.4 0.4 0.3"/></geometry></visual>
    <collision><geometry><box size="0.4 0.4 0.3"/></geometry></collision>
  </link>
  <link name="lid">
    <inertial><mass value="1"/><inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial>
    <visual><origin xyz="0.2 0 0"/><geometry>{shape}</geometry></visual>
    <collision><origin xyz="0.2 0 0"/><geometry><box size="0.4 0.4 0.02"/></geometry></collision>
  </link>
  <link name="handle"/>
  <joint name="hinge" type="revolute">
    <parent link="case"/><child link="lid"/><origin xyz="-0.2 0 0.16"/><axis xyz="0 -1 0"/>
    <limit lower="0" upper="1.5" effort="0" velocity="0"/><dynamics damping="0.2" friction="0.1"/>
  </joint>
  <joint name="fix" type="fixed"><parent link="lid"/><child link="handle"/><origin xyz="0.4 0 0.02"/></joint>
</robot>
"""
BOX = '<box size="0.4 0.4 0.02"/>'


@pytest.fixture
def urdf(tmp_path):
    path = tmp_path / "chest.urdf"
    path.write_text(CHEST.format(shape=BOX))
    return path


def test_a_chest_opens(urdf, tmp_path):
    made = import_fixture(urdf, tmp_path / "chest")
    assert made.joints == ("hinge",) and "handle" in made.sites and not made.warnings
    chain = fixtures.chain(str(made.folder))
    pos, _ = chain.poses(jnp.array([math.pi / 2]))
    np.testing.assert_allclose(pos[chain.frames.index("handle")], [-0.2 - 0.02, 0.0, 0.16 + 0.4], atol=1e-5)
    model = scene.build(NERO, SceneCfg(fixtures={"chest": FixtureCfg(str(made.folder))}), SimCfg(), visuals=False)
    hinge = model.joint("chest/hinge")
    assert hinge.range.tolist() == [0.0, 1.5] and hinge.damping[0] == 0.2 and hinge.frictionloss[0] == 0.1
    assert model.geom("chest/lid").contype == fixtures.MEETS and model.geom("chest/lid").conaffinity == 0


def test_the_command_says_what_terms_may_read(call, urdf):
    code, out, err = call("mjx_nero", "import-urdf", urdf, "--out", "chest", "--fixture")
    assert code == 0 and "joints: hinge; sites: origin, handle" in out, err
    assert call("mjx_nero", "import-urdf", urdf, "--out", "chest", "--fixture")[0] != 0  # without --force
    assert call("mjx_nero", "import-urdf", urdf, "--out", "chest", "--fixture", "--force")[0] == 0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (CHEST.format(shape='<mesh filename="../../secret.stl"/>'), "outside"),
        (CHEST.format(shape=BOX).replace("revolute", "fixed"), "no joint that moves"),
        ("<robot/>", "no link|links"),
    ],
)
def test_strangers_files_leave_nothing(tmp_path, text, message):
    path = tmp_path / "there" / "bad.urdf"
    path.parent.mkdir()
    path.write_text(text)
    with pytest.raises(UserError, match=message):
        import_fixture(path, tmp_path / "out")
    assert [found.name for found in tmp_path.iterdir()] == ["there"]


def test_the_report_lists_what_was_written(urdf, tmp_path):
    made = import_fixture(urdf, tmp_path / "chest")
    report = json.loads((made.folder / "report.json").read_text())
    assert report["fixture"] == "chest" and list(report["files"]) == ["model.xml"]
