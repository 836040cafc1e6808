"""Meshes of objects with what a stranger may put there: each is written into a folder and shown by ``inspect --object``."""

import functools
import io
import json
import os
import pathlib
import random
import struct
import zlib
from collections.abc import Callable

import numpy as np
import server
import trimesh
from PIL import Image

Made = tuple[str, bytes]  # name of the mesh, and its content
CUBE = b"".join(b"v %d %d %d\n" % (i & 1, i >> 1 & 1, i >> 2) for i in range(8))
CUBE += b"f 1 3 4 2\nf 5 6 8 7\nf 1 2 6 5\nf 3 7 8 4\nf 1 5 7 3\nf 2 4 8 6\n"


def _picture(size: tuple[int, int] = (8, 8), kind: str = "PNG") -> bytes:
    out = io.BytesIO()
    Image.new("RGB", size, (200, 40, 40)).save(out, kind)
    return out.getvalue()


def _bomb(edge: int) -> bytes:
    """A PNG of a few bytes that says it has ``edge`` x ``edge`` pixels, all of which are there."""
    row = zlib.compressobj(9)
    body = b"".join([row.compress(b"\0" * (1 + 3 * edge)) for _ in range(min(edge, 3000))]) + row.flush()

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", edge, edge, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def glb(change: Callable[[dict], None] = lambda head: None, picture: bytes | None = None, spoil=lambda data: data) -> bytes:
    """A cube with a texture as GLB, its description changed."""
    mesh = trimesh.creation.box((0.1, 0.1, 0.1))
    points, corners = mesh.vertices.astype("<f4").tobytes(), mesh.faces.astype("<u4").tobytes()
    uv, image = np.zeros((8, 2), "<f4").tobytes(), picture or _picture()
    data, views, at = b"", [], 0
    for part in (points, corners, uv, image):
        part += b"\0" * (-len(part) % 4)
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(part)})
        data, at = data + part, at + len(part)
    head = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 2}, "indices": 1, "material": 0}]}],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 8, "type": "VEC3"},
            {"bufferView": 1, "componentType": 5125, "count": 36, "type": "SCALAR"},
            {"bufferView": 2, "componentType": 5126, "count": 8, "type": "VEC2"},
        ],
        "materials": [{"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "baseColorFactor": [1, 0, 0, 1]}}],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "bufferViews": views,
        "buffers": [{"byteLength": len(data)}],
    }
    change(head)
    text = json.dumps(head).encode()
    text += b" " * (-len(text) % 4)
    data = spoil(data)
    body = struct.pack("<II", len(text), 0x4E4F534A) + text + struct.pack("<II", len(data), 0x004E4942) + data
    return b"glTF" + struct.pack("<II", 2, 12 + len(body)) + body


def _put(path: list, value: object) -> Callable[[dict], None]:
    def change(head: dict) -> None:
        at = head
        for key in path[:-1]:
            at = at[key]
        at[path[-1]] = value

    return change


ODD = (-1, 0, 1, 7, 2**31, 2**40, 1e308, float("nan"), None, "x", [], {}, True, 0.5, [0] * 1000, "../../mine/keys.yaml")
PATHS = (
    ["accessors", 0, "count"],
    ["accessors", 1, "count"],
    ["accessors", 0, "componentType"],
    ["accessors", 0, "type"],
    ["accessors", 1, "byteOffset"],
    ["bufferViews", 0, "byteLength"],
    ["bufferViews", 1, "byteOffset"],
    ["bufferViews", 0, "byteStride"],
    ["bufferViews", 0, "buffer"],
    ["buffers", 0, "uri"],
    ["images", 0, "uri"],
    ["images", 0, "bufferView"],
    ["nodes", 0, "children"],
    ["nodes", 0, "mesh"],
    ["nodes", 0, "scale"],
    ["nodes", 0, "matrix"],
    ["nodes", 0, "rotation"],
    ["scenes", 0, "nodes"],
    ["scene"],
    ["meshes", 0, "primitives"],
    ["materials", 0, "pbrMetallicRoughness", "baseColorFactor"],
    ["extensionsRequired"],
)


def _nested(head: dict) -> None:
    """A chain of nodes, each of which has the next one twice."""
    head["nodes"] = [{"mesh": 0, "children": [i + 1, i + 1]} for i in range(60)] + [{"mesh": 0}]


def of_glb(draw: random.Random) -> Made:
    """One number of the description is another; or nodes that multiply, a texture that is a bomb, points that are none."""
    nans = functools.partial(
        glb, spoil=lambda data: struct.pack("<f", draw.choice((float("nan"), float("inf"), 1e38))) + data[4:]
    )
    makers = (
        lambda: glb(_nested),
        lambda: glb(_put(["nodes", 0, "children"], [0])),
        nans,
        lambda: glb(picture=_bomb(30_000)),
        lambda: glb(picture=_bomb(draw.choice((9000, 100_000)))),
        lambda: glb(picture=draw.randbytes(300)),
        lambda: glb(spoil=lambda data: data[: draw.randrange(len(data))]),
        lambda: glb()[: draw.randrange(300)],
        lambda: b"glTF" + struct.pack("<II", 2, 20 + 0) + struct.pack("<II", 2**32 - 1, 0x4E4F534A),
    )
    if draw.random() < 0.5:
        return "m.glb", draw.choice(makers)()
    return "m.glb", glb(_put(draw.choice(PATHS), draw.choice(ODD)))


def of_stl(draw: random.Random) -> Made:
    """Counts that are wrong, coordinates that are none, text that ends early, triangles that are points, and many of them."""
    triangle = struct.Struct("<12fH")
    box = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="stl")
    ascii_ = trimesh.creation.box((0.1, 0.1, 0.1)).export(file_type="stl_ascii").encode()
    odd = draw.choice((float("nan"), float("inf"), 1e30, -1e7, 1e-30, 0.0))
    makers = (
        lambda: box[: draw.randrange(len(box))],
        lambda: bytes(80) + struct.pack("<I", 2**32 - 1) + box[84:],
        lambda: bytes(80) + struct.pack("<I", 4) + b"".join(triangle.pack(*[odd] * 12, 0) for _ in range(4)),
        lambda: ascii_[: draw.randrange(len(ascii_))],
        lambda: ascii_.replace(b"0.05", str(odd).encode(), draw.randrange(1, 9)),
        lambda: b"solid " + b"vertex 0 0 0\n" * draw.choice((1, 4, 100_000)),
        lambda: (
            bytes(80)
            + struct.pack("<I", 300_000)
            + np.random.default_rng(1).random((300_000, 50), np.float32).astype("u1").tobytes()
        ),
        lambda: (
            bytes(80)
            + struct.pack("<I", 60_000)
            + b"".join(triangle.pack(*np.random.default_rng(i).random(12), 0) for i in range(60_000))
        ),
        lambda: bytes(80) + struct.pack("<I", 0),
    )
    return "m.stl", draw.choice(makers)()


def of_obj(draw: random.Random, folder: pathlib.Path) -> Made:
    """Indices that are none, numbers that are none, lines without end, and materials that name what is not theirs."""
    body = CUBE.replace(b"v 1", b"v 0.1")
    name = draw.choice(
        (
            b"m.mtl",
            b"../mine/keys.yaml",
            b"/etc/passwd",
            b"link.mtl",
            b"../../../../../../etc/passwd",
            b"/dev/zero",
            b"pipe.mtl",
            b"sub/../m.mtl",
            b"x" * 5000,
            b"\xff\xfe",
            b"m.mtl\0",
            str(folder / "mine" / "keys.yaml").encode(),
            b".",
        )
    )
    skin = draw.choice(
        (b"skin.png", b"../../mine/keys.yaml", b"link.png", b"/dev/zero", b"m.obj", b"bomb.png", b"none.png", b"sub")
    )
    here = folder / "home" / "in"
    (here / "sub").mkdir(parents=True, exist_ok=True)
    (here / "m.mtl").write_bytes(
        draw.choice((b"newmtl a\nKd 1 0 0\nmap_Kd " + skin + b"\n", b"map_Kd " * 1000, b"Kd nan 1 1\n", draw.randbytes(500)))
    )
    (here / "skin.png").write_bytes(
        draw.choice((_picture(), _picture(kind="JPEG"), _picture(kind="GIF"), draw.randbytes(99), b""))
    )
    (here / "bomb.png").write_bytes(_bomb(draw.choice((8000, 60_000))))
    for link, to in (("link.mtl", "mine/keys.yaml"), ("link.png", "mine/keys.yaml")):
        os.symlink(folder / to, here / link)
    os.mkfifo(here / "pipe.mtl")
    uv = b"vt 0 0\nvt 1 1\n" + body.replace(b" 1 3 4 2", b" 1/1 3/2 4/1 2/2")
    makers = (
        lambda: b"mtllib " + name + b"\n" + uv,
        lambda: (
            b"mtllib "
            + name
            + b"\n"
            + b"vt 0 0\n"
            + b"\n".join(
                b"f" + b"".join(b" %s/1" % w for w in line.split()[1:]) if line[:1] == b"f" else line
                for line in body.split(b"\n")
            )
        ),
        lambda: body[: draw.randrange(len(body))],
        lambda: body.replace(
            draw.choice((b"1", b"0", b"4", b"8")),
            draw.choice((b"nan", b"inf", b"1e999", b"-9", b"99999999999999999999", b"x", b"1_0", b"")),
            draw.randrange(1, 4),
        ),
        lambda: body + b"f " + b" 1" * draw.choice((2, 5, 200_000)) + b"\n",
        lambda: body * draw.choice((2, 3000)),
        lambda: b"v 0 0 0\n" * 400_000 + b"f 1 2 3\n",
        lambda: body.replace(b"\n", b"\\\n", 5),
        lambda: b"v " + b"9" * draw.choice((30, 1_000_000)) + b" 0 0\n" + body,
        lambda: draw.randbytes(4000),
    )
    return "m.obj", draw.choice(makers)()


def of_folder(draw: random.Random, folder: pathlib.Path) -> Made:
    """An ``object.yaml`` that names what is not its own, or has numbers that are none."""
    here = folder / "home" / "in"
    (here / "m.obj").write_bytes(CUBE.replace(b"v 1", b"v 0.1"))
    os.symlink(folder / "mine" / "keys.yaml", here / "link.obj")
    name = draw.choice(("m.obj", "link.obj", "../m.obj", "/etc/passwd.obj", "sub/m.obj", "m.exe", "", "[]", "x" * 300 + ".obj"))
    number = draw.choice(("500", "-1", "nan", "1e400", "[]", "{a: b}", "0", "!!python/object:os.system x", "&a [*a]"))
    text = f"mesh: {name}\nparts: {draw.choice(('m.obj', 'none.obj', name))}\ndensity: {number}\n"
    return "object.yaml", draw.choice((text, text[: draw.randrange(len(text))], "a: " * 1000, "- 1\n" * 5000)).encode()


def mesh(draw: random.Random, folder: pathlib.Path) -> tuple[str, Callable[[], None]]:
    """One mesh, a folder of one, or a name that is none."""
    here = folder / "home" / "in"
    here.mkdir()
    (folder / "mine" / "m.mtl").write_text("secret")
    kind = draw.choice(("glb", "glb", "stl", "obj", "obj", "folder", "name"))
    if kind == "name":
        name = draw.choice(("/dev/zero", "/dev/stdin", "/", "..", "x" * 5000 + ".stl", "m.3mf", "\n.obj", "%s.glb", "."))
        return f"name {name[:20]!r}", functools.partial(server.command, ["inspect", "--object", name])
    makers = {
        "glb": of_glb,
        "stl": of_stl,
        "obj": functools.partial(of_obj, folder=folder),
        "folder": functools.partial(of_folder, folder=folder),
    }
    name, content = makers[kind](draw)
    path = here / (name if draw.random() < 0.95 else name.rpartition(".")[0] + draw.choice((".obj", ".stl", ".glb", ".zip", "")))
    path.write_bytes(content)
    scale = draw.choice(("1", "1", "0.1", "1e-9", "1e9", "0.001"))
    given = here if kind == "folder" and draw.random() < 0.5 else path
    return f"{kind} {path.name}, {len(content)} bytes, scale {scale}", functools.partial(
        server.command, ["inspect", "--object", given, "--scale", scale]
    )
