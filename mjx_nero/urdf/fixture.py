"""Imports a URDF of a thing with joints, such as a cabinet, to a folder for ``SceneCfg.fixtures``: ``model.xml``, ``meshes/``."""

import dataclasses
import json
import pathlib
from collections.abc import Mapping

import numpy as np

from mjx_nero.sim import fixtures
from mjx_nero.urdf import collide, files, folder, importer, inertia, meshes, mjcf, primitives
from mjx_nero.urdf import read as reader
from mjx_nero.urdf.geometry import Looks
from mjx_nero.urdf.report import Notes
from mjx_nero.urdf.tree import Tree, bodies
from mjx_nero.urdf.units import METRES, Units, check_lengths

ARMATURE = {"prismatic": 0.05, "revolute": 1e-3, "continuous": 1e-3}  # [kg, kg m2] of every joint; URDFs have none


@dataclasses.dataclass(frozen=True)
class Made:
    """The results of an import.

    Attributes:
        joints: names of the joints that move.
        sites: names of the frames that terms can read: links that are fixed to others.
        warnings: one line each about what could not be used.
    """

    folder: pathlib.Path
    joints: tuple[str, ...]
    sites: tuple[str, ...]
    warnings: tuple[str, ...]


def import_fixture(
    path: pathlib.Path | str,
    out: pathlib.Path | str,
    packages: Mapping[str, pathlib.Path] | None = None,
    *,
    args: Mapping[str, str] | None = None,
    units: Units = METRES,
    force: bool = False,
) -> Made:
    """Makes a fixture's folder from a URDF or xacro file. Links that collide keep up to three shapes of their own.

    The folder appears whole or not at all. The limits on files are those of ``importer.import_urdf``, as are the arguments.

    Raises:
        UserError: the input cannot be used; the message says why and what to do.
    """
    path, out = pathlib.Path(path), pathlib.Path(out)
    folder.check(out, force)
    notes, roots = Notes(), files.Roots(path, packages or {})
    tree, _ = reader.read(path, roots, notes, args or {}, units=units)
    looks = Looks(tree, bodies(tree), meshes.Meshes(roots), notes)
    check_lengths(tree, looks.spans, units)
    tree = importer.filled(tree, looks, notes)
    text = _text(tree, looks, notes)
    warnings = [f"{n.where} {n.name}: {n.text}" for n in notes if n.kind == "warning"]
    with folder.making(out, force) as made:
        folder.write_model(made, text, looks.stl)
        report = {"source": path.name, "fixture": tree.name, "warnings": warnings, "files": folder.hashes(made)}
        (made / "report.json").write_text(json.dumps(report, indent=1), encoding="utf-8")
        found = fixtures.chain(str(made))
    return Made(out, found.joints, found.frames, tuple(warnings))


def _text(tree: Tree, looks: Looks, notes: Notes) -> str:
    """Writes the model, with the joints at 0 or as near to 0 as they go."""
    parts = bodies(tree)
    joints = [body.joint for body in parts.values() if body.joint]
    taken = [link for body in parts.values() for link in body.links]
    return mjcf.document(
        tree.name,
        parts,
        {name: inertia.body_mass(body, notes) if body.joint else body.mass for name, body in parts.items()},
        {name: look.drawn for name, look in looks.of.items()},
        {name: _collisions(name, looks) for name in tree.links},
        (importer.free("origin", taken), tree.root, np.eye(4)),
        {joint.name: ARMATURE[joint.type] for joint in joints},
        {joint.name: float(np.clip(0.0, joint.lower, joint.upper)) for joint in joints},
    )


def _collisions(link: str, looks: Looks) -> list[tuple[str, primitives.Primitive, int]]:
    """Fits shapes to a link's collisions, in its frame."""
    look = looks.of[link]
    shapes = collide.shapes_of(look.surfaces, look.exact) if look.surfaces else []
    return [(link if len(shapes) == 1 else f"{link}_{i + 1}", shape, mjcf.TABLE) for i, shape in enumerate(shapes)]
