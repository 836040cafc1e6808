"""The files that a URDF names, found within given folders only."""

import os
import pathlib
import re
import stat
import urllib.parse
from collections.abc import Mapping

from mjx_nero.files import parse_xml as parse_xml
from mjx_nero.files import read_bytes
from mjx_nero.types import UserError

MAX_URDF = 10_000_000  # bytes
MAX_PACKAGE = 100_000  # bytes of a package.xml
LEVELS = 5  # that a package's folder lies above the URDF at most
read = read_bytes


class Missing(Exception):
    """A file that cannot be used; the message says why. The importer goes on without it."""


class Absent(Missing):
    """There is no such file."""


class Roots:
    """The folders that a URDF may name files in.

    These are the URDF's own folder; the package that it lies in, the nearest folder with a ``package.xml`` at most ``LEVELS``
    above, or without one the folder above, if the URDF lies in a folder called ``urdf``, ``robots`` or ``xacro``; ``packages``;
    and packages that it names which lie beside it or beside a folder above it: ``NAME/package.xml``.

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
        package = next((f for f in self._above if f not in _private() and (f / "package.xml").is_file()), None)
        self._own = [self.here]
        if package is not None:
            self._own.append(package)
            self.packages.setdefault(package_name(package), package)
        elif self.here.name in ("urdf", "robots", "xacro") and len(self._above) > 1:
            self._own.append(self.here.parent)
        self.folders = [*self._own, *self.packages.values()]

    def find(self, name: str, base: pathlib.Path | None = None) -> pathlib.Path:
        """The file that a URDF calls ``name``: ``package://``, ``model://``, ``file://``, absolute, or relative to ``base``.

        Raises:
            UserError: it lies outside the folders, be it by a symbolic link.
            Missing: there is no such file.
        """
        scheme, _, rest = name.replace("\\", "/").rpartition("://")
        scheme = re.split(r"[/:]+", scheme)[-1]  # file://$(find NAME)/... is file://package://NAME/...
        if "\0" in rest or not rest.strip("/ "):
            raise Missing("names no file")
        if scheme in ("package", "model"):
            package, _, rest = rest.partition("/")
            rest = rest.lstrip("/")
            if package not in self.packages:
                self._look_beside(package)
            if package in self.packages:
                places, lacking = [self.packages[package]], f" in package {package!r}, which is {self.packages[package]}"
            else:  # the package that holds the URDF goes by any name
                places = [f.parent for f in self._own if f.name == package and f.parent in self._own] + self._own
                places = [f for f in self._own if f.name == package] + places
                lacking = f"; for package {package!r} pass --package {package}=DIR"
        elif scheme in ("", "file"):
            places, lacking = [base or self.here], ""
        else:
            raise Missing(f"{scheme}:// is not fetched")
        for place in dict.fromkeys(places):
            for text in dict.fromkeys((rest, urllib.parse.unquote(rest))):  # as it is written, then with %20 as a space
                path = self._inside(place / text, name)
                if path is not None:
                    return path
        raise Absent(f"there is no such file{lacking}")

    def _look_beside(self, package: str) -> None:
        """Takes a package that lies beside the URDF, or beside a folder above it, into the folders; none that is a link."""
        if not re.fullmatch(r"\w[\w.-]{0,100}", package):
            return
        for above in self._above:
            folder = above / package
            if folder.resolve() == folder and folder not in _private() and (folder / "package.xml").is_file():
                self.packages[package] = folder
                self.folders.append(folder)
                return

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
