"""Triangles and the first texture of a binary glTF file (GLB, version 2). References to other files are refused.

Source of the format: the Khronos Group's glTF 2.0 specification.
"""

import json
from collections.abc import Iterator
from typing import Any

import numpy as np

from mjx_nero import files

MAX_JSON = 4_000_000  # bytes
MAX_NODES, MAX_DEPTH = 10_000, 32
_NUMBERS = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTH = {"SCALAR": 1, "VEC2": 2, "VEC3": 3}
_TRIANGLES = 4
_JSON, _BIN = 0x4E4F534A, 0x004E4942

Parsed = tuple[np.ndarray, np.ndarray, np.ndarray, bytes | None, tuple[float, float, float, float] | None]


def parse(content: bytes, most: int) -> Parsed:
    """Reads vertices [n, 3] (z up), faces [m, 3], places in the texture [n, 2], the texture's bytes, and the colour.

    Args:
        most: most triangles to read.

    Raises:
        ValueError: the file is damaged or too large, or needs an unsupported feature.
    """
    try:
        head, data = _chunks(content)
        return _Reader(head, data, most).all()
    except (KeyError, IndexError, TypeError, AttributeError, RecursionError, OverflowError, json.JSONDecodeError) as error:
        raise ValueError(f"its description is damaged ({type(error).__name__}: {str(error)[:60]})") from None


def _chunks(content: bytes) -> tuple[dict[str, Any], bytes]:
    magic, version, length = content[:4], int.from_bytes(content[4:8], "little"), int.from_bytes(content[8:12], "little")
    if magic != b"glTF" or version != 2 or length != len(content):
        raise ValueError("not a glTF 2 file of the stated length")
    at: int = 12
    found: dict[int, tuple[int, int]] = {}
    while at + 8 <= length:
        size, kind = int.from_bytes(content[at : at + 4], "little"), int.from_bytes(content[at + 4 : at + 8], "little")
        if at + 8 + size > length:
            raise ValueError("a part of it is longer than the file")
        found.setdefault(kind, (at + 8, size))
        at += 8 + size
    start, size = found.get(_JSON, (0, 0))
    if not 0 < size <= MAX_JSON:
        raise ValueError(f"its description has {size:,} bytes: at most {MAX_JSON:,} are read")
    head = files.parse_json(content[start : start + size].rstrip(b" \0"))
    start, size = found.get(_BIN, (0, 0))
    if not isinstance(head, dict):
        raise ValueError("its description is not a JSON object")
    return head, content[start : start + size]


class _Reader:
    def __init__(self, head: dict[str, Any], data: bytes, most: int):
        self._head, self._data, self._left, self._numbers = head, data, most, 12 * most
        self._picture: bytes | None = None
        self._rgba: tuple[float, float, float, float] | None = None
        if needed := head.get("extensionsRequired"):
            raise ValueError(f"it needs the extension {str(needed[0])[:40]}: export it without")

    def all(self) -> Parsed:
        parts = [part for node, pose in self._nodes() for part in self._mesh(node, pose)]
        if not parts:
            raise ValueError("it holds no triangles")
        offsets = np.cumsum([0, *(len(part[0]) for part in parts)])
        faces = np.concatenate([part[1] + offset for part, offset in zip(parts, offsets[:-1], strict=True)])
        whole = all(len(part[2]) for part in parts)
        uv = np.concatenate([part[2] for part in parts]) if whole else np.zeros((0, 2))
        vertices = np.concatenate([part[0] for part in parts])[:, [0, 2, 1]] * [1, -1, 1]  # its y is up
        return vertices, faces, uv, self._picture, self._rgba

    def _nodes(self) -> Iterator[tuple[dict[str, Any], np.ndarray]]:
        """Every node of the scene with its pose [4, 4]; nodes may not contain one another."""
        nodes = self._head.get("nodes", [])
        scene = self._head["scenes"][self._head.get("scene", 0)] if "scenes" in self._head else {"nodes": range(len(nodes))}
        waiting, seen = [(index, np.eye(4), 0) for index in scene.get("nodes", [])], 0
        while waiting:
            index, above, depth = waiting.pop()
            seen += 1
            if seen > MAX_NODES or depth > MAX_DEPTH:
                raise ValueError(f"more than {MAX_NODES:,} nodes or {MAX_DEPTH} levels of them")
            node = nodes[_natural(index)]
            pose = above @ _pose(node)
            yield node, pose
            waiting += [(child, pose, depth + 1) for child in node.get("children", [])]

    def _mesh(self, node: dict[str, Any], pose: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        if "mesh" not in node:
            return
        for part in self._head["meshes"][_natural(node["mesh"])]["primitives"]:
            if part.get("mode", _TRIANGLES) != _TRIANGLES:
                continue
            points = self._array(part["attributes"]["POSITION"], 3)
            corners = self._array(part["indices"], 1)[:, 0] if "indices" in part else np.arange(len(points))
            if len(corners) % 3:
                raise ValueError("its indices do not make up triangles")
            self._left -= len(corners) // 3
            if self._left < 0:
                raise ValueError("it has too many triangles")
            uv = self._array(part["attributes"]["TEXCOORD_0"], 2) if "TEXCOORD_0" in part["attributes"] else np.zeros((0, 2))
            self._look(part)
            flip = np.linalg.det(pose[:3, :3]) < 0
            faces = corners.reshape(-1, 3).astype(np.int64)[:, :: -1 if flip else 1]
            if len(faces) and faces.max() >= len(points):
                raise ValueError("a triangle with vertices that it does not have")
            yield points @ pose[:3, :3].T + pose[:3, 3], faces, np.stack([uv[:, 0], 1 - uv[:, 1]], axis=1) if len(uv) else uv

    def _look(self, part: dict[str, Any]) -> None:
        """Keeps the first texture and the first colour."""
        if "material" not in part:
            return
        look = self._head["materials"][_natural(part["material"])].get("pbrMetallicRoughness", {})
        if self._rgba is None and (colour := look.get("baseColorFactor")):
            rgba = np.clip(np.array(colour, float), 0, 1)
            if rgba.shape != (4,) or not np.isfinite(rgba).all():
                raise ValueError("a colour that is not four numbers")
            self._rgba = (float(rgba[0]), float(rgba[1]), float(rgba[2]), 1.0)
        if self._picture is None and "baseColorTexture" in look:
            texture = self._head["textures"][_natural(look["baseColorTexture"]["index"])]
            image = self._head["images"][_natural(texture["source"])]
            if "uri" in image:
                raise ValueError("its texture lies in another file: embed it")
            self._picture = self._view(image["bufferView"])[0]

    def _view(self, index: int) -> tuple[bytes, int]:
        """The bytes of a buffer view, and its stride; 0: packed."""
        view = self._head["bufferViews"][_natural(index)]
        buffer = self._head["buffers"][_natural(view["buffer"])]
        if "uri" in buffer or view["buffer"] != 0:
            raise ValueError("its data lies in another file: embed it")
        start, size = _natural(view.get("byteOffset", 0)), _natural(view["byteLength"])
        if start + size > len(self._data):
            raise ValueError("data beyond its end")
        return self._data[start : start + size], _natural(view.get("byteStride", 0))

    def _array(self, index: int, width: int) -> np.ndarray:
        """The numbers of an accessor, [n, width]."""
        found = self._head["accessors"][_natural(index)]
        if "sparse" in found or "bufferView" not in found:
            raise ValueError("its data is sparse or missing")
        kind, count = np.dtype(_NUMBERS[found["componentType"]]), _natural(found["count"])
        if _WIDTH[found["type"]] != width or (width > 1 and kind.kind != "f") or (width == 1 and kind.kind != "u"):
            raise ValueError("data of an unsupported type")
        content, stride = self._view(found["bufferView"])
        start, each = _natural(found.get("byteOffset", 0)), width * kind.itemsize
        stride = stride or each
        self._numbers -= count * width  # a file may place the same data again and again
        if self._numbers < 0:
            raise ValueError("too much data")
        if stride < each or (count and start + stride * (count - 1) + each > len(content)):
            raise ValueError("data beyond the end of its buffer view")
        return np.ndarray((count, width), kind, content, start, (stride, kind.itemsize)).copy()


def _natural(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or value < 0:
        raise ValueError(f"{str(value)[:40]} in place of an integer from 0")
    return value


def _pose(node: dict[str, Any]) -> np.ndarray:
    """A node's pose [4, 4]: a matrix, column by column, or translation, rotation (xyzw) and scale."""
    if "matrix" in node:
        pose = np.array(node["matrix"], float).reshape(4, 4).T
    else:
        x, y, z, w = (float(v) for v in node.get("rotation", (0, 0, 0, 1)))
        turn = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )
        pose = np.eye(4)
        pose[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), float).reshape(3)
        pose[:3, 3] = np.array(node.get("translation", (0, 0, 0)), float).reshape(3)
    if not (np.abs(pose) < 1e6).all():
        raise ValueError("a pose that is not finite")
    return pose
