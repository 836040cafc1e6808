"""The house by numbers: rooms, levels, arrows, the core and the lengths of functions, counted in the source.

``python tests/test_house.py`` prints the lines of the core, room by room.
"""

import ast
import pathlib
import re
import tomllib
from collections.abc import Iterator, Mapping

import pytest

ROOT = pathlib.Path(__file__).parents[1]
PACKAGE = ROOT / "mjx_nero"
CORE, MOST_OF_CORE = ("config", "files", "mdp", "sim", "envs", "learn"), 12_000  # besides the modules directly in the package
MOST_ROOMS, MOST_LEVELS, MOST_LINES = 20, 9, 60
LONG = "# Long: "  # on the line before a longer function, with the reason


def rooms(package: pathlib.Path = PACKAGE) -> dict[str, list[pathlib.Path]]:
    """Folders and modules that lie directly in the package, and their files; its face, ``__init__``, is none."""
    modules = {path.stem: [path] for path in package.glob("*.py") if path.stem != "__init__"}
    return modules | {path.parent.name: sorted(path.parent.rglob("*.py")) for path in package.glob("*/__init__.py")}


def arrows(found: Mapping[str, list[pathlib.Path]], package: str = PACKAGE.name) -> set[tuple[str, str]]:
    """(importing room, imported room) of every import between rooms, those within functions included."""
    pairs = {(room, name) for room, files in found.items() for path in files for name in _imported(path, package)}
    return {(room, other) for room, other in pairs if other in found and other != room}


def _imported(path: pathlib.Path, package: str) -> Iterator[str]:
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.module == package:
            yield from (name.name for name in node.names)
        names = [name.name for name in node.names] if isinstance(node, ast.Import) else [getattr(node, "module", None) or ""]
        yield from (name.split(".")[1] for name in names if name.startswith(f"{package}."))


def levels(found: Mapping[str, list[pathlib.Path]], pairs: set[tuple[str, str]]) -> dict[str, int]:
    """A room's level is one above the highest that it imports, 1 where it imports none.

    Raises:
        ValueError: some rooms import one another, so an arrow goes up.
    """
    below = {room: {other for first, other in pairs if first == room} for room in found}
    level: dict[str, int] = {}
    while len(level) < len(below):
        ready = [room for room in below if room not in level and below[room] <= set(level)]
        if not ready:
            raise ValueError(f"these import one another: {', '.join(sorted(set(below) - set(level)))}")
        level |= {room: 1 + max((level[other] for other in below[room]), default=0) for room in ready}
    return level


def core(package: pathlib.Path = PACKAGE) -> dict[str, int]:
    """Lines of the core by room, without its wings: those that the contract ``wings`` of import-linter protects."""
    contracts = tomllib.loads((package.parent / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    wings = [name for each in contracts if each["id"] == "wings" for name in each["protected_modules"]]
    within = {"the ground": sorted(package.glob("*.py")), **{room: sorted((package / room).rglob("*.py")) for room in CORE}}
    return {
        room: sum(len(path.read_text().splitlines()) for path in paths if not any(_in(path, wing, package) for wing in wings))
        for room, paths in within.items()
    }


def _in(path: pathlib.Path, module: str, package: pathlib.Path) -> bool:
    """True if a file is the module or lies in the package of that dotted name."""
    own = path.relative_to(package.parent).with_suffix("").parts
    return list(own[: module.count(".") + 1]) == module.split(".")


def long_functions(path: pathlib.Path) -> list[str]:
    """Functions of more than ``MOST_LINES`` lines that no reason stands above."""
    text = path.read_text()
    lines, out = text.splitlines(), []
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            first = min([node.lineno, *(each.lineno for each in node.decorator_list)])
            long = (node.end_lineno or 0) - node.lineno + 1
            if long > MOST_LINES and not lines[first - 2].strip().startswith(LONG):
                out.append(f"{path.name}: {node.name} has {long} lines")
    return out


def test_rooms_and_levels():
    found = rooms()
    level = levels(found, arrows(found))
    assert len(found) <= MOST_ROOMS, sorted(found)
    assert max(level.values()) <= MOST_LEVELS, level
    assert level["errors"] == 1 and level["mdp"] < level["sim"] < level["envs"] < level["learn"] < level["tools"]


def test_the_core_is_small_and_says_so():
    lines = sum(core().values())
    assert lines <= MOST_OF_CORE
    said = re.search(r"The core has ([\d,]+) lines", (ROOT / "docs/concepts/house.md").read_text())
    assert said and abs(int(said[1].replace(",", "")) - lines) <= 250, lines


def test_functions_fit_a_screen():
    assert not [text for path in sorted(PACKAGE.rglob("*.py")) for text in long_functions(path)]


@pytest.fixture
def house(tmp_path):
    """A package of four rooms on three levels."""
    files = {
        "ground.py": "",
        "middle/__init__.py": "",
        "middle/one.py": "from small import ground\nfrom small.middle import two",
        "middle/two.py": "import small.ground",
        "top.py": "def late():\n    from small.middle.one import x",
        "face.py": "import small",
    }
    for name, text in files.items():
        path = tmp_path / "small" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    (tmp_path / "small" / "__init__.py").write_text("from small import top")
    return tmp_path / "small"


def test_the_count_counts(house):
    found = rooms(house)
    assert sorted(found) == ["face", "ground", "middle", "top"]
    pairs = arrows(found, "small")
    assert pairs == {("middle", "ground"), ("top", "middle")}
    assert levels(found, pairs) == {"ground": 1, "face": 1, "middle": 2, "top": 3}
    with pytest.raises(ValueError, match="import one another: ground, middle, top"):
        levels(found, pairs | {("ground", "top")})


def test_the_core_is_counted_without_its_wings(house):
    wings = '[[tool.importlinter.contracts]]\nid = "wings"\nprotected_modules = ["small.sim.far", "small.mdp.one"]\n'
    (house.parent / "pyproject.toml").write_text(wings)
    for path, lines in (("sim/near.py", 3), ("sim/far/__init__.py", 5), ("sim/far_too.py", 7), ("mdp/one.py", 11)):
        (house / path).parent.mkdir(parents=True, exist_ok=True)
        (house / path).write_text("x = 1\n" * lines)
    found = core(house)
    assert found["sim"] == 3 + 7 and not found["mdp"]
    assert found["the ground"] == 4  # of the face, the top and the package itself


def test_long_functions_are_found(tmp_path):
    path, body = tmp_path / "a.py", "    x = 1\n" * MOST_LINES
    path.write_text(f"def long():\n{body}")
    assert long_functions(path) == ["a.py: long has 61 lines"]
    path.write_text(f"# Long: a list\n@cache\ndef long():\n{body}")
    assert not long_functions(path)
    path.write_text(f"def short():\n{body[: -len('    x = 1') - 1]}")
    assert not long_functions(path)


def test_whoever_imports_brax_or_mjx_silences_them_first():
    """Otherwise MJX prints that it has no Warp, depending on which module of the package comes first."""
    loud = []
    for path in sorted(PACKAGE.rglob("*.py")):
        names = [name for node in ast.parse(path.read_text()).body for name in _names(node)]
        heavy = [k for k, name in enumerate(names) if name.startswith(("brax.", "mujoco.mjx"))]
        if heavy and not any(name.startswith("mjx_nero.sim.quiet") for name in names[: heavy[0]]):
            loud.append(path)
    assert not loud


def _names(node: ast.stmt) -> list[str]:
    if isinstance(node, ast.ImportFrom):
        return [f"{node.module}.{name.name}" for name in node.names]
    return [name.name for name in node.names] if isinstance(node, ast.Import) else []


if __name__ == "__main__":
    for name, count in (counted := core()).items():
        print(f"{name:12}{count:7,}")
    print(f"{'the core':12}{sum(counted.values()):7,}")
