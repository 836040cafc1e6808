"""Materials of OBJ files: what is there is drawn, what is missing is said, and what comes later is found."""

import pytest
from PIL import Image

from mjx_nero.sim import solids
from mjx_nero.sim.solids import store
from mjx_nero.types import UserError

CORNERS = [(x, y, z) for x in (0, 0.04) for y in (0, 0.03) for z in (0, 0.02)]
FACES = ["1 2 4 3", "5 7 8 6", "1 5 6 2", "3 4 8 7", "1 3 7 5", "2 6 8 4"]


@pytest.fixture
def slab(tmp_path):
    """A box whose file names materials that are not there."""
    lines = ["mtllib slab.mtl", *(f"v {x} {y} {z}" for x, y, z in CORNERS), "vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1", "usemtl skin"]
    faces = ["f " + " ".join(f"{corner}/{k + 1}" for k, corner in enumerate(face.split())) for face in FACES]
    path = tmp_path / "slab.obj"
    path.write_text("\n".join([*lines, *faces]) + "\n")
    return path


def test_what_is_missing_is_said_and_found_once_it_is_there(slab, call):
    found = solids.find(str(slab))
    assert found.rgba == store.GREY and not found.texture.size and found.volume == pytest.approx(2.4e-5)
    assert found.note == "drawn without slab.mtl, which is not there"
    assert "drawn without slab.mtl" in call("mjx_nero", "inspect", "--object", slab)[1]

    slab.with_name("slab.mtl").write_text("newmtl skin\nKd 1 0.5 0\nmap_Kd skin.png\n")
    store._found.cache_clear()
    found = solids.find(str(slab))
    assert found.rgba == (1.0, 0.5, 0.0, 1.0) and found.note == "drawn without skin.png, which is not there"

    Image.new("RGB", (2, 2), (0, 0, 255)).save(slab.with_name("skin.png"))
    store._found.cache_clear()
    found = solids.find(str(slab))
    assert found.texture.shape == (2, 2, 3) and len(found.uv) == len(found.vertices) and not found.note


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("newmtl a\nmap_Kd ../x.png\n", "not below its own folder: copy it there, and name it without folders"),
        ("newmtl a\nmap_Kd C:\\pictures\\x.png\n", "not below its own folder"),
        ("newmtl a\nKd nan 1 1\n", "a colour that is not three finite numbers"),
        ("newmtl a\nKd red\n", "a colour that is not three finite numbers"),
    ],
)
def test_faults_of_materials(slab, text, says):
    slab.with_name("slab.mtl").write_text(text)
    with pytest.raises(UserError, match=says):
        solids.find(str(slab))
