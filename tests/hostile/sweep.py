"""Every number of every file, one after another, in place of which stands what no reader should trust."""

import json
import random
import re
from collections.abc import Callable, Iterator

import fuzz

HUGE, LONG = "9" * 400, "9" * 5000
JSON = ["NaN", "Infinity", "1e400", "-1e400", "-1", "0", "0.5", "1e25", "1e-320", HUGE, LONG, "18446744073709551616", "true"]
JSON += ["null", "[]", "{}", "[1, [2]]", '{"a": 1}', '"x"', '"nan"', '"1e400"', '"\\u0000\\u001b[2J"', "[" * 40 + "]" * 40]
JSON += ['"' + "x" * 3000 + '"', "[" + "1," * 3000 + "1]", "-9223372036854775809", "1e-400"]
YAML = [".nan", ".inf", "-.inf", "1e400", "-1", "0", "1e25", "1.0e-300", HUGE, LONG, "1:" * 30 + "1", "1:" * 30_000 + "1.5"]
YAML += ["0x1F", "0o17", "1_000", "2024-01-01", "null", "true", "~", "[1, [2]]", "{a: 1}", "x", '"1"', "!!float x", "!!int 1.5"]
YAML += ["[" + "1," * 3000 + "1]", "'" + "x" * 3000 + "'", "*a", "&a 1"]
XML = ["nan", "inf", "-inf", "1e400", "-1", "0", "1e25", "1e-300", HUGE, "", " ", "x", "1 2", "1,2", "1 2 3 4 5", "0x1F", "1_0"]
XML += ["%20", "&#10;1", "-0", "1e", "--1", "é", "1" * 60_000, "0.0.0", "1e-400", "+1", ".5", "1."]
CSV = ["nan", "inf", "-inf", "1e400", "1e5", "-1", "", "x", '"1"', "=1+1", HUGE, "x" * 200_000, "1_0", "0x1F", "1;2", "\x00", " "]
NUMBER = re.compile(rb"(?<![\w.#])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?(?![\w.])")
WORDS = {  # reader -> what to put in place of its numbers
    **dict.fromkeys(("robot", "gains", "descriptor", "flow", "identified", "public_robots", "yaml"), YAML),
    **dict.fromkeys(("run", "summary", "seeds", "metrics", "results", "robustness", "onnx", "policy"), JSON),
    **dict.fromkeys(("urdf", "model"), XML),
    "log": CSV,
}


GOOD: dict[str, Callable[[], bytes]] = {  # where the fuzzer's last file has hardly a number, or is none that is taken
    "gains": lambda: b"joint1: {stiffness: 10.0, damping: 1.0, effort: 5.0, speed: 1.0}\nfinger: {stiffness: 10, damping: 1}\n",
    "yaml": lambda: b"a: 1\nb: [2.5, -3e-2, {c: 0.1}]\nd: 7\n",
    "public_robots": lambda: (
        b'repositories: {a/b1: "12"}\nrobots: {arm 3: {repository: a/b1, file: 4/arm5.urdf, packages: [c6]}}\n'
    ),
    "policy": lambda: (fuzz.ASSETS / "policies" / "nero_reach.safetensors").read_bytes(),
}


def places(content: bytes) -> list[tuple[int, int]]:
    """Where its numbers stand."""
    return [found.span() for found in NUMBER.finditer(content)]


def inner(reader: str) -> tuple[bytes, Callable[[bytes], bytes]]:
    """The text of a reader's good file that has the numbers, and what makes a file of such a text."""
    content = GOOD[reader]() if reader in GOOD else fuzz.corpus(reader)[-1]
    if reader != "policy":
        return content, lambda text: text
    length = int.from_bytes(content[:8], "little")
    head, body = json.loads(content[8 : 8 + length]), content[8 + length :]

    def packed(text: bytes) -> bytes:
        said = json.dumps({**head, "__metadata__": {**head["__metadata__"], "meta": text.decode(errors="replace")}}).encode()
        return len(said).to_bytes(8, "little") + said + body

    return head["__metadata__"]["meta"].encode(), packed


def count(reader: str) -> int:
    """How many files there are."""
    return len(places(inner(reader)[0])) * len(WORDS[reader])


def files(reader: str, most: int | None = None, seed: int = 0) -> Iterator[tuple[str, bytes]]:
    """What is replaced by what, and the file; ``most`` of them, drawn by the seed, or all."""
    text, packed = inner(reader)
    every = [(at, word) for at in places(text) for word in WORDS[reader]]
    if most is not None and most < len(every):
        every = random.Random(f"{reader} {seed}").sample(every, most)
    for (start, end), word in every:
        line = text.count(b"\n", 0, start) + 1
        name = f"{reader}: {text[start:end].decode()} at {start}, line {line}: {word[:40]!r}"
        yield name, packed(text[:start] + word.encode() + text[end:])
