"""Random URDFs: an import keeps kinematics and mass; meshes of noise are left out. ``tests/hostile`` spoils the URDF."""

import pathlib
import re
import shutil
import tempfile

import mujoco
import numpy as np
import pytest
import urdf_files as make
import yourdfpy
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mjx_nero.sim import robot_file
from mjx_nero.types import UserError
from mjx_nero.urdf import Report, import_urdf

COMMON = {"deadline": None, "suppress_health_check": list(HealthCheck), "derandomize": True}
numbers = st.floats(-1, 1, width=32)
vectors = st.tuples(numbers, numbers, numbers)
SHAPES = (
    '<box size="0.1 0.2 0.05"/>',
    '<sphere radius="0.05"/>',
    '<cylinder radius="0.03" length="0.2"/>',
    '<mesh filename="no.stl"/>',
)


def text(values) -> str:
    return " ".join(map(repr, map(float, values)))


@st.composite
def tensors(draw) -> str:
    """Physical ones (from second moments), and others."""
    moments = np.array(draw(st.tuples(*[st.floats(1e-6, 0.1)] * 3)))
    diagonal = moments.sum() - moments if draw(st.booleans()) else draw(vectors)
    x, y, z = diagonal
    return text([x, 0, 0, y, 0, z])


@st.composite
def robots(draw) -> str:
    """A tree of up to 9 links with every type of joint that is imported, at least one of which moves."""
    count = draw(st.integers(2, 9))
    parts, moving = [], []
    for i in range(count):
        shapes = draw(st.lists(st.tuples(st.sampled_from(SHAPES), st.sampled_from(("visual", "collision"))), max_size=2))
        inner = [make.shape(g, tag, text(draw(vectors)), text(draw(vectors))) for g, tag in shapes]
        if draw(st.booleans()):
            mass = draw(st.sampled_from((0.0, 1e-9, 0.1, 2.0)))
            inner.append(make.inertial(mass, text(draw(vectors)), draw(tensors()), text(draw(vectors))))
        parts.append(make.link(f"link{i}", *inner))
        if i == 0:
            continue
        kind = draw(st.sampled_from(("revolute", "prismatic", "continuous", "fixed"))) if i > 1 else "revolute"
        lower = draw(st.floats(-3, 2.9))
        limit = (
            f'lower="{lower}" upper="{draw(st.floats(lower + 0.05, 3.1))}" effort="{draw(numbers)}" velocity="{draw(numbers)}"'
        )
        mimic = ""
        if moving and kind not in ("fixed", "continuous") and draw(st.integers(0, 3)) == 0:
            source, multiplier, offset = draw(st.sampled_from(moving)), draw(numbers), draw(numbers)
            mimic = f'<mimic joint="{source}" multiplier="{multiplier}" offset="{offset}"/>'
        axis = draw(vectors.filter(lambda v: np.linalg.norm(v) > 0.1))
        axis = np.array(axis) / np.linalg.norm(axis)  # yourdfpy moves slides by the axis as it is written
        parent = f"link{draw(st.integers(0, i - 1))}"
        name = draw(st.sampled_from(("joint", "finger", "gripper"))) + str(i)
        frame = {"xyz": text(draw(vectors)), "rpy": text(draw(vectors)), "axis": text(axis)}
        parts.append(make.joint(name, parent, f"link{i}", kind, limit=limit, inner=mimic, **frame))
        if kind != "fixed" and not mimic:
            moving.append(name)
    return make.robot(*draw(st.permutations(parts)))


def check(urdf: str) -> bool:
    """Imports; whether it went well. Raises what is not a UserError."""
    folder = pathlib.Path(tempfile.mkdtemp())
    try:
        path = make.write(folder / "in", urdf)
        try:
            report = imported(path, folder / "out")
        except UserError as error:
            assert "\n" not in str(error) and not (folder / "out").exists()
            return False
        finally:
            assert sorted(p.name for p in folder.iterdir()) in (["in"], ["in", "out"])
        robot_file.read(folder / "out")
        model = mujoco.MjModel.from_xml_path(str(folder / "out" / "model.xml"))
        np.testing.assert_allclose(model.body_mass.sum(), report.mass, rtol=1e-9)
        # a body that would move without mass has that of its shapes, or a gram; without any masses all do
        said = "\n".join(note.text for note in report.notes)
        whole = re.search(r"no link has a mass: now (\S+) kg", said)
        assert not whole or report.mass_read < 1e-3 * len(report.links)
        gains = [float(new) - float(old) for old, new in re.findall(r"moves with (\S+) kg: now (\S+) kg", said)]
        known = float(whole[1]) if whole else report.mass_read + sum(gains)
        slack = (0.006 * report.mass if whole or gains else 0) + 1e-9  # masses in notes have three digits
        assert known - slack <= report.mass <= known + 1e-3 * (model.nbody - 1) + slack
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        assert np.isfinite(data.qacc).all()
        return same_kinematics(path, model, data)
    finally:
        shutil.rmtree(folder)


def imported(path: pathlib.Path, out: pathlib.Path) -> Report:
    """Of a tree that is more than an arm the first arm that the message offers."""
    try:
        return import_urdf(path, out)
    except UserError as error:
        offered = re.search(r"--chain (\w+:\w+)", str(error))
        if offered is None:
            raise
        return import_urdf(path, out, chain=offered[1])


def same_kinematics(path: pathlib.Path, model: mujoco.MjModel, data: mujoco.MjData) -> bool:
    reference = yourdfpy.URDF.load(str(path), build_scene_graph=True, load_meshes=False)
    rng = np.random.default_rng(0)
    for _ in range(3):
        q = {j.name: rng.uniform(-1, 1) for j in reference.actuated_joints}
        held = [j for j in reference.actuated_joints if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, j.name) < 0]
        q |= {j.name: float(np.clip(0, j.limit.lower, j.limit.upper)) if j.type != "continuous" else 0.0 for j in held}
        reference.update_cfg(q)
        for j in reference.robot.joints:
            if j.mimic is not None and j.type != "fixed":
                q[j.name] = q[j.mimic.joint] * j.mimic.multiplier + j.mimic.offset
        for name, value in q.items():
            if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name) >= 0:
                data.joint(name).qpos = value
        mujoco.mj_kinematics(model, data)
        for name in reference.link_map:
            body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
            pos = data.xpos[body] if body >= 0 else data.site(name).xpos
            np.testing.assert_allclose(pos, reference.get_transform(name, reference.base_link)[:3, 3], rtol=0, atol=1e-6)
    return True


@pytest.mark.slow
@settings(max_examples=20, **COMMON)
@given(robots())
def test_random_trees(urdf):
    assert check(urdf)


@pytest.mark.slow
@settings(max_examples=10, **COMMON)
@given(st.binary(max_size=300), st.sampled_from(("stl", "obj", "dae")), st.booleans())
def test_mutated_meshes(noise, kind, append):
    """A mesh of noise, or one with noise in it, is left out with a warning, or is read."""
    folder = pathlib.Path(tempfile.mkdtemp())
    try:
        body = make.link("e", make.inertial(0.1), make.mesh(f"m.{kind}"))
        path = make.write(folder, make.arm(2, body, make.joint("j", "l2", "e")))
        good = make.box(folder / f"m.{kind}", (0, 0, 0), (0.1, 0.1, 0.1)).read_bytes()
        middle = len(good) // 2
        (folder / f"m.{kind}").write_bytes(good[:middle] + noise + good[middle + len(noise) :] if append else noise)
        report = import_urdf(path, folder / "out")
        assert report.links["e"]["shapes"]
    finally:
        shutil.rmtree(folder)
