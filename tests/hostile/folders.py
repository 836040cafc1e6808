"""Run folders that a stranger has made, and what is done with them."""

import dataclasses
import functools
import json
import os
import pathlib
import random
import socket
from collections.abc import Callable
from typing import Any

import fuzz
import numpy as np
import server

from mjx_nero.learn import checkpoint, policy
from mjx_nero.runs import cfg as run_cfg
from mjx_nero.runs import checkpoints, logs, resume, training, trust
from mjx_nero.runs import folder as run_folder
from mjx_nero.tasks import registry
from mjx_nero.tools import seeds, train_run
from mjx_nero.tools.view import agents
from mjx_nero.tools.view import opening as view_opening

NAMES = (".lock", "config.json", "summary.json", "seeds.json", "metrics.jsonl", "policy.safetensors", "best.safetensors")
NAMES += ("curve.png", "video.mp4", "checkpoints", "tensorboard", "wandb", "wandb/id", "wandb/run-1", "wandb/latest-run")
NAMES += ("tensorboard/events.out.1", "checkpoints/000000001024.safetensors", "checkpoints/000000002048.safetensors")
NAMES += (".config.part.json", ".metrics.part.jsonl", "checkpoints/.000000001024.part.safetensors", ".policy.part.safetensors")
NAMES += ("checkpoints/ 1.safetensors", "seed_0", "x", ".", "..", "checkpoints/deep/er/x", "wandb/debug.log", "-rf")


def run(folder: pathlib.Path) -> pathlib.Path:
    """A run's folder as training leaves it."""
    home = folder / "run"
    (home / "checkpoints").mkdir(parents=True)
    (home / "tensorboard").mkdir()
    for name, content in fuzz.a_run().items():
        (home / name).write_bytes(content)
    meta = {**checkpoint.load_meta(policy.shipped("nero_reach")), "num_envs": 256, "tally": {"steps": 1024}}
    checkpoint.save(home / "policy.safetensors", {"x": np.ones(3)}, meta)
    checkpoint.save(home / "checkpoints" / "000000001024.safetensors", {"x": np.ones(3)}, {**meta, "kind": "checkpoint"})
    return home


def entries(draw: random.Random, folder: pathlib.Path) -> tuple[str, Callable[[], None]]:
    """Some of a run's entries are something else than files and folders."""
    home, said = run(folder), []
    for _ in range(draw.choice((1, 1, 2, 3))):
        name, kind = draw.choice(NAMES), draw.choice(list(KINDS))
        path = pathlib.Path(os.path.normpath(home / name))
        above = pathlib.Path(os.path.realpath(path.parent))
        if path in (home, home.parent) or home.parent not in (above, *above.parents):
            continue  # within a link that another has made
        said.append(f"{name} is a {kind}")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
        except OSError:  # one of its folders is none any more
            continue
        if path.is_dir() and not path.is_symlink():
            path.rename(path.with_name(f"{path.name}_{draw.randrange(10**9)}"))
        path.unlink(missing_ok=True)
        KINDS[kind](path, folder / "mine", draw)
    use = draw.choice((restored, restored, restored, followed, started))
    return f"{'; '.join(said)}; {use.__name__}", functools.partial(server.program, functools.partial(use, home))


def _socket(path: pathlib.Path) -> None:
    here = os.getcwd()
    os.chdir(path.parent)  # a socket's name is short
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name)
    os.chdir(here)


def _sparse(path: pathlib.Path, size: int) -> None:
    path.write_bytes(b"{")
    os.truncate(path, size)


def _many(path: pathlib.Path) -> None:
    path.mkdir()
    for i in range(3000):
        (path / f"{i:012d}.safetensors").write_bytes(b"x")


def _deep(path: pathlib.Path) -> None:
    for _ in range(150):
        path.mkdir()
        path = path / "d"


Maker = Callable[[pathlib.Path, pathlib.Path, random.Random], Any]
KINDS: dict[str, Maker] = {
    "link to a file": lambda path, mine, draw: path.symlink_to(mine / "keys.yaml"),
    "link to a checkpoint": lambda path, mine, draw: path.symlink_to(mine / "000000000512.safetensors"),
    "link to nothing": lambda path, mine, draw: path.symlink_to(mine / f"new_{draw.randrange(9)}"),
    "link to a folder": lambda path, mine, draw: path.symlink_to(mine),
    "link upwards": lambda path, mine, draw: path.symlink_to("../" * draw.randint(1, 6) + "mine/keys.yaml"),
    "link to itself": lambda path, mine, draw: path.symlink_to(path.name),
    "link within": lambda path, mine, draw: path.symlink_to(draw.choice(("config.json", "checkpoints", "../config.json"))),
    "second name": lambda path, mine, draw: os.link(mine / draw.choice(("keys.yaml", "000000000512.safetensors")), path),
    "pipe": lambda path, mine, draw: os.mkfifo(path),
    "device": lambda path, mine, draw: path.symlink_to(draw.choice(("/dev/zero", "/dev/random", "/dev/stdin", "/proc/self/mem"))),
    "socket": lambda path, mine, draw: _socket(path),
    "folder": lambda path, mine, draw: path.mkdir(),
    "deep folder": lambda path, mine, draw: _deep(path),
    "folder of thousands": lambda path, mine, draw: _many(path),
    "large file": lambda path, mine, draw: _sparse(path, draw.choice((5_000_000, 300_000_000, 40_000_000_000))),
    "empty file": lambda path, mine, draw: path.write_bytes(b""),
    "noise": lambda path, mine, draw: path.write_bytes(draw.randbytes(draw.randint(1, 5000))),
    "brackets": lambda path, mine, draw: path.write_bytes(draw.choice((b"[", b'{"a":', b"[[],")) * draw.choice((50, 100_000))),
    "other JSON": lambda path, mine, draw: path.write_text(draw.choice(('{"a": 1}', "[]", "null", "3", '"x"', "true", "{}"))),
    "closed file": lambda path, mine, draw: (path.write_bytes(b"{}"), path.chmod(0)),
}


def restored(home: pathlib.Path) -> None:
    """What ``train --restore`` does with a folder, but that the learner is not compiled, and ends after the first row."""
    asked = dataclasses.replace(run_cfg.resolve("nero_reach", "default", None, {}, {}), restore=home)
    found = train_run.going_on(asked, {"restore"}, {"env": {}, "ppo": {}})
    with run_folder.claim(home, found.env_name, goes_on=True):
        source = resume.find(home, print)
        resume.header.check_fields(source.meta, source.path)
        tally = training._tally(source)
        training._over(found, tally)
        resume.overridden(home, found)
        run_folder.begin(home, training.config.to_dict(found))
        trust.mark(home)
        kept, noted = checkpoints.Checkpoints(home, 1), logs.Logs(home, print)
        noted.write({"steps": 4096, "eval/success_rate": 0.5})
        kept.save({"x": np.ones(2)}, {"y": np.ones(2)}, source.meta, 4096, best=4096)
        kept.close(), kept.wait(), noted.close()
        training._summary(home)


def started(home: pathlib.Path) -> None:
    """What ``train --out`` does with a folder that holds something."""
    with run_folder.claim(home, "nero_reach", goes_on=False):
        seeds._earlier(home / "seeds.json")


def followed(home: pathlib.Path) -> None:
    """What ``view --run`` reads of a folder, up to the networks."""
    named = view_opening._described(home)
    registry.env_cfg(named.get("env_name", "nero_lift"), named.get("preset", "default"))
    newest = agents.newest(home)
    if newest is not None:
        resume.header.check(checkpoint.load_meta(newest), newest)
        checkpoint.load(newest, {"x": np.ones(3)})


ODD = [
    None,
    True,
    -1,
    0,
    0.5,
    1e308,
    10**30,
    "x",
    "",
    "x" * 3000,
    "\x1b[2J\n",
    [],
    [[1]],
    {},
    {"a": {"b": [None]}},
    "nan",
    "1e999",
]
ODD += [[0] * 2000, "../../mine/keys.yaml", "/dev/zero", "/etc/passwd", -(2**63), "1:1:1", "(1, (2", 1e-300, [True], "default", 7]


def _paths(node: Any, at: tuple = ()) -> list[tuple]:
    own = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return [at, *(path for key, value in own for path in _paths(value, (*at, key)))]


def config(draw: random.Random, folder: pathlib.Path) -> tuple[str, Callable[[], None]]:
    """A run whose config says something else in some places, or names the user's files."""
    home, said = run(folder), []
    name = draw.choice(("config.json",) * 5 + ("summary.json", "seeds.json"))
    held = json.loads((home / name).read_text())
    for _ in range(draw.randint(1, 3)):
        *above, last = draw.choice(_paths(held)[1:])
        node = held
        for key in above:
            node = node[key]
        value = draw.choice((*ODD, str(folder / "mine" / "keys.yaml"), str(folder / "mine")))
        what = draw.choice(("value", "value", "value", "gone", "name"))
        said.append(f"{'.'.join(map(str, (*above, last)))}: {what} {value!r:.40}")
        if what == "value":
            node[last] = value
        else:
            gone = node.pop(last)
            if what == "name" and isinstance(node, dict):
                node[str(value)] = gone
    if draw.random() < 0.3 and name == "config.json":
        mine = str(folder / "mine" / "keys.yaml")
        field = draw.choice(("identified", "robot.folder", "robot.name", "robot.mjcf", "robot.base_link"))
        held["asked"] = {"robot": draw.choice((None, mine)), "env": {field: mine}, "learner": {}}
        said.append(f"asked for {field} and {held['asked']['robot']}")
    (home / name).write_text(json.dumps(held))
    use = draw.choice((restored, restored, followed, started))
    return f"{name}: {'; '.join(said)}; {use.__name__}", functools.partial(server.program, functools.partial(use, home))


def names(draw: random.Random, folder: pathlib.Path) -> tuple[str, Callable[[], None]]:
    """Files in ``checkpoints`` whose names are like those of a run, which are somebody's own."""
    home, own = run(folder), {}
    for _ in range(draw.randint(1, 6)):
        digits = "".join(draw.choice("0123456789") for _ in range(draw.choice((1, 11, 12, 13, 40))))
        name = draw.choice(
            ("{}.safetensors", "{} (copy).safetensors", "{}.safetensors.bak", "-{}.safetensors", "{}", "{}.SAFETENSORS")
        )
        name = name.format(draw.choice((digits, f"+{digits}", "٣" * 12, f"{digits}\n", "1_0" * 4, "é", "\udce9"))).replace(
            "/", ""
        )
        path = home / "checkpoints" / name
        if not checkpoints._NAME.fullmatch(name) and not path.exists():
            path.write_text("mine")
            own[str(path)] = "mine"

    def use() -> None:
        restored(home)
        assert {path: pathlib.Path(path).read_text() for path in own} == own

    return ", ".join(ascii(pathlib.Path(path).name) for path in own), functools.partial(server.program, use)
