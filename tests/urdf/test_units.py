"""Units: a robot whose size is impossible is refused with the flag that reads it, and is then the same as in metres."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import urdf_files as make

from mjx_nero.tools.import_urdf import main
from mjx_nero.types import UserError
from mjx_nero.urdf import files, import_urdf, read
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.units import Units

TRIPLE = re.compile(r'(xyz|size|length|radius)="([^"]*)"')
RANGE = re.compile(r'(type="prismatic".*?<limit )lower="([^"]*)" upper="([^"]*)" (.*?)velocity="([^"]*)"')
TENSOR = re.compile(r'(i[xyz][xyz])="([^"]*)"')


def in_other_units(text: str, by: float) -> str:
    """A URDF whose lengths, but not its meshes', are multiplied; axes are no lengths."""

    def times(numbers: str, factor: float = by) -> str:
        return " ".join(f"{factor * float(v):.12g}" for v in numbers.split())

    parts = text.split("<axis ")
    scaled = [TRIPLE.sub(lambda m: f'{m[1]}="{times(m[2])}"', parts[0])]
    for part in parts[1:]:
        axis, end, rest = part.partition("/>")
        scaled.append(axis + end + TRIPLE.sub(lambda m: f'{m[1]}="{times(m[2])}"', rest))
    text = TENSOR.sub(lambda m: f'{m[1]}="{times(m[2], by**2)}"', "<axis ".join(scaled))
    slide = r'\1lower="{0}" upper="{1}" \4velocity="{2}"'
    return RANGE.sub(lambda m: m.expand(slide.format(*(times(m[i]) for i in (2, 3, 5)))), text)


def arm(folder: Path, scale: float = 1.0) -> str:
    """With fingers, whose meshes are in metres; ``scale``: that they are given."""
    text = make.robot(make.base(), *make.six(), *make.fingers(folder, "link6"))
    return text.replace('scale="1 1 1"', f'scale="{scale} {scale} {scale}"')


def model(folder: Path, text: str, **options) -> mujoco.MjModel:
    import_urdf(make.write(folder / "in", text), folder / "out", **options)
    return mujoco.MjModel.from_xml_path(str(folder / "out" / "model.xml"))


@pytest.mark.parametrize(
    ("by", "scale", "flags"),
    [
        (1000.0, 1.0, "--scale 0.001 "),  # origins alone in millimetres
        (1000.0, 1000.0, "--scale 0.001 --mesh-scale 0.001 "),  # all of it
        (0.001, 1.0, "--scale 1000 "),
        (0.001, 0.001, "--scale 1000 --mesh-scale 1000 "),
    ],
)
def test_the_flag_of_the_message_reads_it(tmp_path, by, scale, flags):
    text = in_other_units(arm(tmp_path / "a", scale), by)
    path = make.write(tmp_path / "a" / "in", text)
    with pytest.raises(UserError, match=f"import with {flags}") as error:
        import_urdf(path, tmp_path / "a" / "out")
    assert "\n" not in str(error.value) and not (tmp_path / "a" / "out").exists()
    units = Units(scale=1 / by, mesh_scale=1 / scale if scale != 1 else None)
    found, wanted = model(tmp_path / "a", text, units=units), model(tmp_path / "b", arm(tmp_path / "b"))
    for field in ("body_pos", "body_ipos", "body_inertia", "jnt_range", "geom_size", "geom_pos"):
        np.testing.assert_allclose(getattr(found, field), getattr(wanted, field), rtol=1e-4, atol=1e-6, err_msg=field)


def test_a_crane_is_read_as_it_is_by_scale_1(tmp_path):
    text = in_other_units(arm(tmp_path), 20.0)
    with pytest.raises(UserError, match="--scale 1 takes them as they are"):
        import_urdf(make.write(tmp_path / "in", text), tmp_path / "out")
    assert model(tmp_path, text, units=Units(scale=1.0)).body("link3").pos[2] == pytest.approx(7.0)


def test_a_base_that_drives_is_named(tmp_path):
    """Its slide has placeholders for limits, which are no lengths in millimetres."""
    foot = make.joint("drive", "floor", "base", "prismatic", limit='lower="-99999" upper="99999" effort="9" velocity="1"')
    text = arm(tmp_path).replace("</robot>", make.link("floor", make.inertial()) + foot + "</robot>")
    with pytest.raises(UserError, match="'drive' slides by up to 1e.05 m.*--fix drive=0"):
        model(tmp_path, text)
    import_urdf(make.write(tmp_path / "in", text), tmp_path / "out", fix={"drive": 0.0})


def test_meshes_alone(tmp_path):
    with pytest.raises(UserError, match="--mesh-scale 0.001"):
        model(tmp_path, arm(tmp_path, 1000.0))
    robot = model(tmp_path, arm(tmp_path, 1000.0), units=Units(mesh_scale=0.001))
    assert np.ptp(robot.mesh_vert, axis=0).max() < 0.1


def test_couplings_of_slides_with_hinges(tmp_path):
    """A slide that follows a hinge: its factor is a length an angle."""
    turn = make.joint("turn", "link6", "disc", axis="0 0 1")
    slide = make.joint("slide", "link6", "rod", "prismatic", inner='<mimic joint="turn" multiplier="20" offset="5"/>', limit="")
    parts = (make.link("disc", make.inertial(0.1)), make.link("rod", make.inertial(0.1)))
    text = in_other_units(make.robot(make.base(), *make.six()), 1000.0).replace(
        "</robot>", "".join((*parts, turn, slide, "</robot>"))
    )
    path = make.write(tmp_path / "in", text)
    tree, _ = read.read(path, files.Roots(path, {}), Notes(), units=Units(scale=0.001))
    assert tree.joints["slide"].mimic == ("turn", pytest.approx(0.02), pytest.approx(0.005))
    assert (tree.joints["slide"].lower, tree.joints["slide"].upper) == pytest.approx((0.02 * -1 + 0.005, 0.02 * 1 + 0.005))


def test_the_commands_flags(tmp_path):
    path = make.write(tmp_path / "in", in_other_units(make.robot(make.base(), *make.six()), 1000.0))
    for value in ("0", "-1", "mm", "nan"):
        with pytest.raises(UserError, match="--scale"):
            main([str(path), "--out", str(tmp_path / "out"), "--scale", value])
    main([str(path), "--out", str(tmp_path / "out"), "--scale", "0.001", "--no-self-test"])
    robot = mujoco.MjModel.from_xml_path(str(tmp_path / "out" / "model.xml"))
    assert robot.body("link3").pos[2] == pytest.approx(0.35)
