"""The files that a URDF names, found within given folders only."""

import functools
import os
import pathlib
import re
import stat
import urllib.parse
from collections.abc import Iterator, Mapping

from mjx_nero.files import parse_xml as parse_xml
from mjx_nero.files import read_bytes
from mjx_nero.types import UserError

MAX_URDF = 10_000_000  # bytes
MAX_PACKAGE = 100_000  # bytes of a package.xml
LEVELS = 5  # that a package's folder lies above the URDF at most
_DEPTH = 32  # last folders of an absolute path that may be a package
_PARTS = ("urdf", "robots", "xacro")  # folders of a package that its URDFs lie in
read = read_bytes


class Missing(Exception):
    """A file that cannot be used; the message says why. The importer goes on without it."""


class Absent(Missing):
    """There is no such file."""


class Roots:
    """The folders that a URDF may name files in.

    These are the URDF's own folder; the package that it lies in, the nearest folder with a ``package.xml`` at most ``LEVELS``
    above, or without one the folder above, if the URDF lies in a folder called ``urdf``, ``robots`` or ``xacro``; ``packages``;
    and packages that it names which lie beside it or beside a folder above it: ``NAME/package.xml``. Inside its own folders
    a package is a folder called so, or that of a ``package.xml`` that says so. A folder of another name serves for none.

    Args:
        urdf: path of the URDF.
        packages: name -> folder, for ``package://name/...``.

    Raises:
        UserError: a package's folder does not exist.
    """

    def __init__(self, urdf: pathlib.Path, packages: Mapping[str, pathlib.Path]):
        self.here = urdf.resolve().parent
        self.packages = {}
        for name, folder in packages.items():
            if not pathlib.Path(folder).is_dir():
                raise UserError(f"--package {name}={folder}: no such folder")
            self.packages[name] = pathlib.Path(folder).resolve()
        self._above = [f for f in (self.here, *self.here.parents) if f != f.parent][: LEVELS + 1]
        package = next((f for f in self._above if f not in _private() and os.path.isfile(f / "package.xml")), None)
        self._own = [self.here]
        if package is not None:
            self._own.append(package)
        elif self.here.name in _PARTS and len(self._above) > 1:
            self._own.append(self.here.parent)
        self.folders = [*self._own, *self.packages.values()]

    def find(self, name: str, base: pathlib.Path | None = None) -> pathlib.Path:
        """The file that a URDF calls ``name``: ``package://``, ``model://``, ``file://``, absolute, or relative to ``base``.

        An absolute path of another machine is looked for in the package that it passes through.

        Raises:
            UserError: it lies outside the folders, be it by a symbolic link.
            Missing: there is no such file.
        """
        scheme, _, rest = name.replace("\\", "/").rpartition("://")
        scheme = re.split(r"[/:]+", scheme)[-1]  # file://$(find NAME)/... is file://package://NAME/...
        if "\0" in rest or not rest.strip("/ "):
            raise Missing("names no file")
        lacking = ""
        if scheme in ("package", "model"):
            package, _, rest = rest.partition("/")
            tries = [(place, rest.lstrip("/")) for place in self._places(package)]
            place = next((place for place, _ in tries if os.path.isdir(place)), None)
            lacking = f"; no folder here is package {package!r}: pass --package {package}=DIR"
            if place is not None:
                lacking = f" in package {package!r}, which is {place}"
        elif scheme in ("", "file"):
            tries = [(base or self.here, rest), *self._foreign(rest)]
        else:
            raise Missing(f"{scheme}:// is not fetched")
        refused = None
        for place, rest in dict.fromkeys(tries):
            for text in dict.fromkeys((rest, urllib.parse.unquote(rest))):  # as it is written, then with %20 as a space
                try:
                    path = self._inside(place / text, name)
                except UserError as error:
                    refused = error
                    continue
                if path is not None and os.path.isdir(place):
                    return path
        raise refused or Absent(f"there is no such file{lacking}")

    def _places(self, package: str, plain: bool = True) -> list[pathlib.Path]:
        """The folders that are a package, the nearest to the URDF first; the given one alone, if one is given.

        Those outside the own folders need a ``package.xml`` and are no links; they join ``folders``. Of those inside, ``plain``
        ones need none.
        """
        if package in self.packages:
            return [self.packages[package]]
        if package in ("", ".", ".."):
            return []
        places = []
        for above in self._above:
            places += [folder for name, folder in self._named if name == package and above in (folder, folder.parent)]
            folder = above / package
            described = os.path.isfile(folder / "package.xml")
            if above.is_relative_to(self._own[-1]):
                if plain or described:
                    places.append(folder)
            elif described and os.path.realpath(folder) == str(folder) and folder not in _private():
                places.append(folder)
                if folder not in self.folders:
                    self.folders.append(folder)
        return places

    def _foreign(self, path: str) -> Iterator[tuple[pathlib.Path, str]]:
        """Where the file of an absolute path may lie here: the packages that the path passes through, the outermost first."""
        if not re.match(r"/|[A-Za-z]:/", path):
            return
        parts = [part for part in path.split("/") if part][-_DEPTH:]
        for i, part in enumerate(parts[:-1]):
            if part not in _PARTS:  # behind share/ stands a package; elsewhere a folder may be just called so: meshes
                for place in self._places(part, plain=parts[i - 1 : i] == ["share"]):
                    yield place, "/".join(parts[i + 1 :])

    @functools.cached_property
    def _named(self) -> list[tuple[str, pathlib.Path]]:
        """Name and folder of the packages that the own folders are: by the folder's name, by its ``package.xml``."""
        found = [(folder.name, folder) for folder in self._own]
        for own in dict.fromkeys(self._own):
            file = own / "package.xml"
            if os.path.realpath(file) == str(file) and os.path.isfile(file):
                found.append((package_name(own), own))
        return found

    def _inside(self, path: pathlib.Path, name: str) -> pathlib.Path | None:
        """``path`` without links and ``..`` if it is a regular file within the folders, None if it is none."""
        try:
            real = path.resolve()
            regular = stat.S_ISREG(real.stat().st_mode)
        except (OSError, RuntimeError, ValueError):  # absent, no permission, a loop of links, too long a name
            real, regular = pathlib.Path(os.path.normpath(path)), False
        if not any(real.is_relative_to(folder) for folder in self.folders):
            raise UserError(f"{name!r} lies outside the URDF's folder: name its folder with --package NAME=DIR, if you trust it")
        return real if regular else None


def package_name(folder: pathlib.Path) -> str:
    """What the package in a folder is called: as its package.xml says, or as the folder is."""
    try:
        root = parse_xml(read(folder / "package.xml", MAX_PACKAGE), "package.xml")
    except UserError:
        return folder.name
    return (root.findtext("name") or "").strip() or folder.name


def _private() -> tuple[pathlib.Path, ...]:
    """Folders that are no package, whatever lies in them."""
    home = pathlib.Path.home()
    return (home, *home.parents)
