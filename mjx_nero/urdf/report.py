"""The importer's report to its user: a note about everything that it changed, guessed or could not use."""

import dataclasses
import json
import pathlib
from collections.abc import Mapping
from typing import Any

from mjx_nero.sim.robot import RobotCfg

KINDS = ("warning", "repaired", "guessed", "note")


@dataclasses.dataclass(frozen=True)
class Note:
    """One note. ``kind`` is one of ``KINDS``; ``where`` is ``link``, ``joint`` or ``robot``, and ``name`` its name."""

    kind: str
    where: str
    name: str
    text: str


class Notes(list[Note]):
    """Notes in order, each once."""

    def __init__(self) -> None:
        super().__init__()
        self._of: dict[tuple[str, str], dict[str, None]] = {}

    def add(self, kind: str, where: str, name: str, text: str) -> None:
        known, line = self._of.setdefault((where, name), {}), f"{kind}: {text}"
        if line not in known:
            known[line] = None
            self.append(Note(kind, where, name, text))

    def of(self, where: str, name: str) -> list[str]:
        return list(self._of.get((where, name), ()))


@dataclasses.dataclass(frozen=True)
class Report:
    """The results of an import. ``report.json`` holds the same, and later the results of the self-test (``folder.record``).

    Attributes:
        folder: the model folder.
        robot: the config in ``robot.yaml``.
        links: name -> data of the link, its body in the model, and its collision shapes with their coverage.
        joints: name -> data of the joint, in the URDF and in the model.
        mass: mass of the model [kg]; ``mass_read``: sum over the URDF's links.
        contacts: greatest number of contacts with the table, and with the table and one cube.
    """

    source: str
    folder: pathlib.Path
    robot: RobotCfg
    links: dict[str, dict[str, Any]]
    joints: dict[str, dict[str, Any]]
    mass: float
    mass_read: float
    contacts: dict[str, int]
    notes: Notes

    @property
    def warnings(self) -> list[str]:
        """One line each about what could not be used, and what replaces it."""
        return [f"{n.where} {n.name}: {n.text}" for n in self.notes if n.kind == "warning"]

    def json(self, files: Mapping[str, str]) -> str:
        """Returns the content of ``report.json``.

        Args:
            files: name -> hash of the folder's other files.
        """
        content = {
            "files": dict(files),
            "source": self.source,
            "robot": self.robot.name,
            "mass": self.mass,
            "mass_read": self.mass_read,
            "contacts": self.contacts,
            "gap": {"open": self.robot.opening, "closed": self.robot.closed},
            "warnings": self.warnings,
            "notes": self.notes.of("robot", self.robot.name),
            "links": {name: {**row, "notes": self.notes.of("link", name)} for name, row in self.links.items()},
            "joints": {name: {**row, "notes": self.notes.of("joint", name)} for name, row in self.joints.items()},
        }
        return json.dumps(content, indent=2) + "\n"
