"""Files that a URDF names, found only within given folders."""

import functools
import os
import pathlib
import re
import shlex
import stat
import urllib.parse
from collections.abc import Iterator, Mapping

from mjx_nero.files import parse_xml as parse_xml
from mjx_nero.files import read_bytes
from mjx_nero.types import UserError

MAX_URDF = 10_000_000  # bytes
MAX_PACKAGE = 100_000  # bytes of a package.xml
LEVELS = 5  # greatest number of levels that a package's folder lies above the URDF
MOST_BESIDE = 200  # greatest number of packages in a folder whose names are read
_DEPTH = 32  # how many of an absolute path's last folders may be a package
_PARTS = ("urdf", "robots", "xacro")  # folders of a package that hold its URDFs
read = read_bytes


class Missing(Exception):
    """A file that cannot be used; the message says why. The importer continues without it."""


class Shared(Missing):
    """A file that rarely lacks alone; one warning names all files of one such kind."""


class Absent(Shared):
    """A file that does not exist."""


class Foreign(Shared):
    """A mesh in a format that is not read."""


class Roots:
    """The folders in which a URDF may name files.

    They are: the URDF's own folder; its package, the nearest folder with a ``package.xml`` at most ``LEVELS`` above (or the
    parent folder, if there is none and the URDF lies in ``urdf``, ``robots`` or ``xacro``); the given ``packages``; and packages
    that the URDF names, if their folder lies beside it or beside a folder above: ``NAME`` with a ``package.xml``, or a folder
    beside the URDF's own whose ``package.xml`` has that name.

    Inside its own folders, a package is a folder of that name, or one whose ``package.xml`` has that name. A file whose folder
    is not here is taken from the own folders, at a tail of its path (``elsewhere``).

    Args:
        urdf: path of the URDF.
        packages: name -> folder for ``package://name/...``.

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
        self._packages_in: dict[pathlib.Path, dict[str, list[pathlib.Path]]] = {}
        self.elsewhere: dict[str, pathlib.Path] = {}  # files of folders that are not here, and what was taken instead

    def find(self, name: str, base: pathlib.Path | None = None) -> pathlib.Path:
        """Finds the file that a URDF calls ``name``.

        The name starts with ``package://``, ``model://`` or ``file://``, or it is a path, absolute or relative to ``base``. An
        absolute path from another machine is searched for in the package that it passes through.

        Raises:
            UserError: the file lies outside the folders, even by a symbolic link.
            Missing: the file does not exist.
        """
        scheme, _, rest = name.replace("\\", "/").rpartition("://")
        scheme = re.split(r"[/:]+", scheme)[-1]  # file://$(find NAME)/... is file://package://NAME/...
        if "\0" in rest or not rest.strip("/ "):
            raise Missing("names no file")
        lacking, place = "", None
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
        tails = self._tails(rest) if place is None else ()  # a package that is here lacks the file
        for place, rest in dict.fromkeys([*tries, *tails]):
            for text in dict.fromkeys((rest, urllib.parse.unquote(rest))):  # as it is written, then with %20 as a space
                try:
                    path = self._inside(place / text, name)
                except UserError as error:
                    refused = error
                    continue
                if path is not None and os.path.isdir(place):
                    if (place, rest) not in tries:
                        self.elsewhere[name] = path
                    return path
        raise refused or Absent(f"there is no such file{lacking}")

    def _places(self, package: str, plain: bool = True, named: bool = True) -> list[pathlib.Path]:
        """Lists the folders that may be a package, the nearest to the URDF first; only the given one, if one is given.

        A folder outside the own folders needs a ``package.xml`` and must not be a link; it joins ``folders``. Inside them,
        ``plain`` folders need none. The folders beside the own ones are looked through only for a package that is ``named``, not
        for one that is guessed from a path.
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
            else:
                found = [folder] if described and _usable(folder) else []
                if not found and named and above == self._own[-1].parent and above not in _private():
                    found = self._beside(above).get(package, [])
                places += found
                self.folders += [folder for folder in found if folder not in self.folders]
        return places

    def _beside(self, above: pathlib.Path) -> dict[str, list[pathlib.Path]]:
        """Lists the packages that lie in a folder, by the names in their ``package.xml``."""
        if above not in self._packages_in:
            found: dict[str, list[pathlib.Path]] = {}
            for file in sorted(above.glob("*/package.xml"))[:MOST_BESIDE]:
                if os.path.realpath(file) == str(file) and os.path.isfile(file) and _usable(file.parent):
                    found.setdefault(package_name(file.parent), []).append(file.parent)
            self._packages_in[above] = found
        return self._packages_in[above]

    def _foreign(self, path: str) -> Iterator[tuple[pathlib.Path, str]]:
        """Yields where a file with an absolute path may lie here: the packages that the path passes through, outermost first."""
        if not re.match(r"/|[A-Za-z]:/", path):
            return
        parts = [part for part in path.split("/") if part][-_DEPTH:]
        for i, part in enumerate(parts[:-1]):
            if part not in _PARTS:  # a folder below share/ is a package; elsewhere a name like meshes proves nothing
                for place in self._places(part, plain=parts[i - 1 : i] == ["share"], named=False):
                    yield place, "/".join(parts[i + 1 :])

    def _tails(self, path: str) -> Iterator[tuple[pathlib.Path, str]]:
        """Yields where a file of an unknown folder may lie: at a tail of its path in the own folders, the longest first.

        A tail has a folder, as a mere name like ``base.stl`` proves nothing.
        """
        parts = [part for part in path.split("/") if part][-_DEPTH:]
        for i in range(len(parts) - 1 if ".." not in parts else 0):
            for own in self._own:
                yield own, "/".join(parts[i:])

    def told(self) -> str:
        """Says which files were taken from elsewhere; empty if none were."""
        if not self.elsewhere:
            return ""
        name, path = next(iter(self.elsewhere.items()))
        more = f" and {len(self.elsewhere) - 1} more files" if len(self.elsewhere) > 1 else ""
        return f"{name!r}{more}: not where the name says, so taken from {path.parent} (--package names another folder)"

    @functools.cached_property
    def _named(self) -> list[tuple[str, pathlib.Path]]:
        """Name and folder of the own folders as packages: by folder name and by ``package.xml``."""
        found = [(folder.name, folder) for folder in self._own]
        for own in dict.fromkeys(self._own):
            file = own / "package.xml"
            if os.path.realpath(file) == str(file) and os.path.isfile(file):
                found.append((package_name(own), own))
        return found

    def _inside(self, path: pathlib.Path, name: str) -> pathlib.Path | None:
        """Resolves links and ``..`` in ``path``.

        Returns the path if it is a regular file within the folders, and None if it is not a file.
        """
        try:
            real = path.resolve()
            regular = stat.S_ISREG(real.stat().st_mode)
        except (OSError, RuntimeError, ValueError):  # absent, forbidden, a loop of links, or too long a name
            real, regular = pathlib.Path(os.path.normpath(path)), False
        if not any(real.is_relative_to(folder) for folder in self.folders):
            raise UserError(f"{name!r} lies outside the URDF's folder: pass {self._flag(real)}, if you trust that folder")
        return real if regular else None

    def _flag(self, outside: pathlib.Path) -> str:
        """Writes the flag for a file's folder: the one beside the URDF's folder, or beside one above, that holds it."""
        shared = pathlib.Path(os.path.commonpath((self.here, outside)))
        folder = shared / outside.relative_to(shared).parts[0] if outside.parent != shared else shared
        return f"--package {folder.name or 'NAME'}={shlex.quote(str(folder))}"


def package_name(folder: pathlib.Path) -> str:
    """Name of the package in a folder: from its package.xml, or else the folder's own."""
    try:
        root = parse_xml(read(folder / "package.xml", MAX_PACKAGE), "package.xml")
    except UserError:
        return folder.name
    return (root.findtext("name") or "").strip() or folder.name


def _usable(folder: pathlib.Path) -> bool:
    """True if a folder may count as a package: it is no link, and none of the ``_private`` ones."""
    return os.path.realpath(folder) == str(folder) and folder not in _private()


def _private() -> tuple[pathlib.Path, ...]:
    """Folders that never count as packages."""
    home = pathlib.Path.home()
    return (home, *home.parents)
