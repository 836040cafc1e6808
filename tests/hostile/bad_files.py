"""Makers of hostile files: each writes them into a folder and returns the command that is given them."""

import json
import os
import pathlib
import re
import shutil
import struct

import trimesh
import urdf_files as make
import yaml

ASSETS = pathlib.Path(__file__).resolve().parents[2] / "assets"
ROW = {"stiffness": 100.0, "damping": 10.0, "effort": 10.0, "speed": 1.0, "home": 0.0}
ROBOT = {"name": "arm", "base_link": "base", "ee_site": "ee", "arm": {"j1": ROW, "j2": ROW}, "gripper": {}}
MODEL = """<mujoco model="arm">
  <compiler angle="radian" autolimits="true" meshdir="meshes"/>
  <asset><mesh name="m" file="m.stl"/></asset>
  <worldbody>
    <body name="base">
      <geom type="mesh" mesh="m" mass="0" contype="0" conaffinity="0"/>
      <body name="l1" pos="0 0 0.1">
        <inertial mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.01"/>
        <joint name="j1" axis="0 0 1" range="-1 1"/>
        <body name="l2" pos="0 0 0.1">
          <inertial mass="1" pos="0 0 0" diaginertia="0.01 0.01 0.01"/>
          <joint name="j2" axis="0 1 0" range="-1 1"/>
          <site name="ee"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""
PIPE, ZERO, DIRECTORY, SECRET = object(), object(), object(), object()  # in place of a file's content


def put(path: pathlib.Path, content) -> None:
    """Writes what the case asks for: text, bytes, or something that is no regular file."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.unlink(missing_ok=True)
    if content is PIPE:
        os.mkfifo(path)
    elif content is ZERO:
        path.symlink_to("/dev/zero")
    elif content is DIRECTORY:
        path.mkdir()
    elif content is SECRET:
        make.box(path.parents[2] / "secret" / "s.stl", (0, 0, 0), (0.1, 0.1, 0.1))
        path.symlink_to(path.parents[2] / "secret" / "s.stl")
    else:
        path.write_bytes(content if isinstance(content, bytes) else content.encode())


def robot(folder: pathlib.Path, yaml_text=None, model=MODEL, mesh=None, **fields) -> list:
    """``inspect`` of a robot's folder: its robot.yaml (as ``yaml_text``, or with other ``fields``), its model and its mesh."""
    home = folder / "robot"
    make.box(home / "meshes" / "m.stl", (0, 0, 0), (0.1, 0.1, 0.1))
    if mesh is not None:
        put(home / "meshes" / "m.stl", mesh)
    put(home / "robot.yaml", yaml.safe_dump({**ROBOT, **fields}) if yaml_text is None else yaml_text)
    put(home / "model.xml", model)
    return ["inspect", home]


def with_model(old: str, new: str):
    """A robot whose model has something in place of something else."""
    assert old in MODEL
    return lambda folder: robot(folder, model=MODEL.replace(old, new, 1))


def gains(folder: pathlib.Path, content) -> list:
    """An import with a file of gains."""
    put(folder / "gains.yaml", content)
    return ["import-urdf", make.write(folder / "in", make.arm(3)), "--out", folder / "out", "--gains", folder / "gains.yaml"]


def rmpflow(folder: pathlib.Path, content) -> list:
    """An evaluation by RMPflow with another parameter file."""
    put(folder / "flow.yaml", content)
    command = "eval --env cobotta_follow_target --controller rmpflow --episodes 1 --control.config"
    return [*command.split(), folder / "flow.yaml"]


def urdf(folder: pathlib.Path, text: str, *flags) -> list:
    """An import."""
    return ["import-urdf", make.write(folder / "in", text), "--out", folder / "out", *flags]


def mesh(folder: pathlib.Path, content: bytes, kind: str, count: int = 1) -> list:
    """An import of an arm with the mesh on its last link."""
    put(folder / "in" / f"m.{kind}", content)
    scales = [make.mesh(f"m.{kind}", scale=f"1 1 {1 + i / 1000:g}") for i in range(count)]
    return urdf(folder, make.arm(2, make.link("e", make.inertial(0.1), *scales), make.joint("j", "l2", "e")))


def stl(triangles: int, equal: bool = False) -> bytes:
    """A binary STL of some triangles in a row of 1 m, or of the same again and again."""
    one, wide = struct.Struct("<12fH"), 1 / triangles
    places = (0.0 if equal else i * wide for i in range(triangles))
    rows = (one.pack(0, 0, 1, x, 0, 0, x + wide, 0, 0, x, 1, 1, 0) for x in places)
    return bytes(80) + struct.pack("<I", triangles) + b"".join(rows)


def solid(kind: str) -> bytes:
    """A box."""
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    content = trimesh.exchange.dae.export_collada(box) if kind == "dae" else box.export(file_type=kind)
    return content if isinstance(content, bytes) else content.encode()


def within(content: bytes, tag: str, new: bytes) -> bytes:
    """XML with something more behind the first opening of a tag."""
    return re.sub(rb"<%s(\s[^>]*)?>" % tag.encode(), lambda found: found[0] + new, content, count=1)


def policy(folder: pathlib.Path, *flags, head=None, meta=None, raw: bytes | None = None, size: int = 0, spoil=None) -> list:
    """An evaluation of the policy that ships, with another head, description or content.

    Args:
        head: function that changes the file's head in place, or takes its place by what it returns.
        meta: likewise of the description; a string stands for its text.
        raw: all of the file.
        size: bytes that it is made long, without content.
        spoil: function of the arrays' bytes.
    """
    content = (ASSETS / "policies" / "nero_reach.safetensors").read_bytes()
    length = int.from_bytes(content[:8], "little")
    top, body = json.loads(content[8 : 8 + length]), content[8 + length :]
    if callable(meta):
        described = json.loads(top["__metadata__"]["meta"])
        described = meta(described) or described
        top["__metadata__"]["meta"] = json.dumps(described)
    elif meta is not None:
        top["__metadata__"]["meta"] = meta
    if head is not None:
        top = head(top) or top
    text = json.dumps(top).encode()
    path = folder / "policy.safetensors"
    put(path, raw if raw is not None else len(text).to_bytes(8, "little") + text + (spoil(body) if spoil else body))
    if size:
        os.truncate(path, size)
    return ["eval", "--env", "nero_reach", "--episodes", "1", "--policy", path, *flags]


def imported(folder: pathlib.Path, change) -> list:
    """A second import with --force into a folder that a first one has made and ``change`` has touched."""
    from mjx_nero.urdf import import_urdf

    path = make.write(folder / "in", make.arm(2))
    import_urdf(path, folder / "out")
    change(folder / "out", path)
    return ["import-urdf", path, "--out", folder / "out", "--force"]


def source_within(folder: pathlib.Path) -> list:
    """An import with --force into the folder of its own source."""
    path = make.write(folder / "o", make.arm(2))
    return ["import-urdf", path, "--out", folder / "o", "--force"]


def source_moved_in(out: pathlib.Path, path: pathlib.Path) -> None:
    """The source lies in the folder of its own import."""
    shutil.copy(path, out / path.name)
