"""A fuzzer over all readers of files: python tests/hostile/fuzz.py --minutes 60 [--reader yaml] [--seed 7].

Files of the corpus are cut, doubled, exchanged and filled with words that readers stumble over. A reader takes the result or
refuses it by a UserError of one line; anything else is a find, which is shrunk and shown: too much time or memory, a file left
behind, a file opened that is not the reader's, a program run. A run of the same reader and seed tries the same files.
What was found once is in ``corpus``, one folder a reader, so that it is tried again.
"""

import argparse
import contextlib
import dataclasses
import functools
import json
import os
import pathlib
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections.abc import Callable

HERE = pathlib.Path(__file__).resolve().parent
if __name__ == "__main__":
    sys.path[:0] = [str(HERE.parents[1]), str(HERE.parent)]

import hypothesis  # noqa: E402
import matplotlib  # noqa: E402
import mujoco  # noqa: E402
import numpy as np  # noqa: E402
import urdf_files as make  # noqa: E402
from hypothesis import strategies as st  # noqa: E402
from matplotlib import font_manager  # noqa: E402

from mjx_nero import UserError, config, files  # noqa: E402
from mjx_nero.control import rmpflow_config  # noqa: E402
from mjx_nero.envs import identified  # noqa: E402
from mjx_nero.identify import log as arm_log  # noqa: E402
from mjx_nero.learn import checkpoint, header  # noqa: E402
from mjx_nero.runs import cfg as run_cfg  # noqa: E402
from mjx_nero.runs import logs, resume, training  # noqa: E402
from mjx_nero.sim import model_file, robot_file  # noqa: E402
from mjx_nero.tasks import registry  # noqa: E402
from mjx_nero.tools import (  # noqa: E402
    public_robots,
    results,
    seeds,
    train_run,
)
from mjx_nero.tools.robustness import command as robustness  # noqa: E402
from mjx_nero.tools.view import opening as view_opening  # noqa: E402
from mjx_nero.urdf import drives, import_urdf, meshes, xacro  # noqa: E402
from mjx_nero.urdf import files as urdf_files  # noqa: E402
from mjx_nero.urdf.report import Notes  # noqa: E402
from mjx_nero.urdf.xacro.expander import URIS  # noqa: E402

SECONDS = 20.0  # of processor time that a file may take, most of it MuJoCo's
WAIT = 6 * SECONDS  # by the clock, which on a busy machine says little; what hangs takes no processor time
LIMITS = {signal.SIGPROF: (signal.ITIMER_PROF, SECONDS), signal.SIGALRM: (signal.ITIMER_REAL, WAIT)}
MEMORY = 6_000_000_000  # bytes of addresses beyond those at the start
LONGEST = 500  # characters of a message
ASSETS = HERE.parents[1] / "assets"
WORDS = """
0 -1 1e999 -1e999 nan .nan inf .inf 1_0 0x10 0o7 1e-400 99999999999999999999 2024-99-99 ~ null true yes
" ' < > & ; : , [ ] { } ( ) - ? ! * & | % @ ` # = / \\ .. ../../../etc/passwd /dev/zero file:///etc/passwd package://x/y
!!int !!float !!python/object/apply:os.system !!binary !!set !!omap &a *a << --- ... %YAML
&#10; &lt; <![CDATA[ <!-- --> <?x ?> </a> <a>
name mesh joint body free ball include replicate size flexcomp link robot limit mimic floating planar world link1 é x
visual collision geometry origin
xacro:include xacro:macro xacro:property xacro:if xacro:insert_block xacro:call xacro:element xacro:arg filename value params ns
${} ${p} ${1/0} $(arg $(find $(eval $(env *o **o ^| := .__class__ .__globals__ lambda: import os.system subprocess __builtins__
range(9**9) [x for x in 9**9**9 <<99999 %99999d .format .join() load_yaml() str list dict len eval open exec getattr
__metadata__ meta dtype shape data_offsets F32 F8_E4M3 actor critic state env solid facet vertex endfacet v f vn g o usemtl mtllib
""".split()
TOKENS = [word.encode() for word in WORDS]
TOKENS += [b"\0", b"\n", b"\r\n", b"\t", b" ", b"\x1b[2J", b"\x9b", b"\xff\xfe", b"\xef\xbb\xbf", b"\xc2\x9b", b"\xe2\x80\xae"]
TOKENS += [b"9" * 400, b"[" * 500, b"{" * 500, b"<a>" * 300, b"(" * 300, b"\xff" * 4, b"\x00\x00\xc0\x7f", b"\xff" * 7 + b"\x7f"]
EDIT = st.tuples(
    st.sampled_from(("put", "cut", "double", "swap", "over", "number", "word")),
    st.floats(0, 1, exclude_max=True),
    st.floats(0, 1, exclude_max=True),
    st.one_of(st.sampled_from(TOKENS), st.binary(max_size=8)),
)


def edited(content: bytes, edits: list[tuple[str, float, float, bytes]]) -> bytes:
    """The file after some changes; places are shares of its length, so that they mean something in every file."""
    for kind, start, length, piece in edits:
        at = int(start * (len(content) + 1))
        end = min(len(content), at + int(length**4 * len(content)) + 1)
        if kind in ("number", "word"):  # the next run of such characters
            wanted = (
                b"+-.0123456789eE" if kind == "number" else b"abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ_0123456789."
            )
            while at < len(content) and content[at] not in wanted:
                at += 1
            end = at
            while end < len(content) and content[end] in wanted:
                end += 1
        if kind == "put":
            content = content[:at] + piece + content[at:]
        elif kind == "cut":
            content = content[:at] + content[end:]
        elif kind == "double":
            content = content[:end] + content[at:end] * 2 + content[end:]
        elif kind == "swap":
            content = content[end:] + content[at:end] + content[:at]
        else:
            content = content[:at] + piece + content[end:]
    return content


def read_yaml(folder: pathlib.Path, content: bytes) -> None:
    (folder / "a.yaml").write_bytes(content)
    files.read_yaml(folder / "a.yaml")


def read_gains(folder: pathlib.Path, content: bytes) -> None:
    (folder / "a.yaml").write_bytes(content)
    drives.load_gains(folder / "a.yaml", dict.fromkeys(("joint1", "joint2", "joint3", "finger")))


def read_descriptor(folder: pathlib.Path, content: bytes) -> None:
    (folder / "a.yaml").write_bytes(content)
    rmpflow_config.load(rmpflow_config.DescriptorCfg, folder / "a.yaml")


def read_flow(folder: pathlib.Path, content: bytes) -> None:
    (folder / "a.yaml").write_bytes(content)
    rmpflow_config.load(rmpflow_config.RmpFlowCfg, folder / "a.yaml")


@functools.cache
def a_robot() -> dict[str, bytes]:
    """The files of an imported robot with a mesh."""
    folder = pathlib.Path(tempfile.mkdtemp())
    make.box(folder / "in" / "m.stl", (0, 0, 0), (0.1, 0.06, 0.02))
    body = make.link("e", make.inertial(0.1), make.mesh("m.stl"))
    import_urdf(make.write(folder / "in", make.arm(2, body, make.joint("j", "l2", "e"))), folder / "out")
    found = {str(p.relative_to(folder / "out")): p.read_bytes() for p in (folder / "out").rglob("*") if p.is_file()}
    shutil.rmtree(folder)
    return found


def read_robot(folder: pathlib.Path, content: bytes, name: str) -> None:
    for other, own in a_robot().items():
        (folder / other).parent.mkdir(exist_ok=True)
        (folder / other).write_bytes(content if other == name else own)
    robot_file.read(folder)


def read_model(folder: pathlib.Path, content: bytes) -> None:
    (folder / "model.xml").write_bytes(content)
    try:
        model_file.read(folder / "model.xml").compile()
    except ValueError as error:  # the compiler's, which robot_file.read takes for the user's mistake
        raise error if isinstance(error, UserError) else UserError(str(error)) from None


def read_policy(folder: pathlib.Path, content: bytes) -> None:
    (folder / "a.safetensors").write_bytes(content)
    header.check(checkpoint.load_meta(folder / "a.safetensors"), folder / "a.safetensors")
    held, _ = header.read(folder / "a.safetensors")
    checkpoint.load(folder / "a.safetensors", {})
    assert sum(len(name) for name in held) < header.MAX_HEAD


def read_mesh(folder: pathlib.Path, content: bytes, kind: str) -> None:
    with contextlib.suppress(urdf_files.Missing):
        parts = meshes._parse(content, kind)
        assert parts and all(mesh.vertices.shape[1] == 3 and len(mesh.faces) for mesh, _ in parts)


def read_urdf(folder: pathlib.Path, content: bytes) -> None:
    make.box(folder / "in" / "m.stl", (0, 0, 0), (0.1, 0.06, 0.02))
    (folder / "in" / "robot.urdf").write_bytes(content)
    try:
        import_urdf(folder / "in" / "robot.urdf", folder / "out")
        model = mujoco.MjModel.from_xml_path(str(folder / "out" / "model.xml"))
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        assert np.isfinite(data.qacc).all()
    except UserError:
        assert not (folder / "out").exists()
        raise
    finally:
        assert {p.name for p in folder.iterdir()} <= {"in", "out"} and {p.name for p in (folder / "in").iterdir()} <= {
            "m.stl",
            "robot.urdf",
        }


def read_xacro(folder: pathlib.Path, content: bytes) -> None:
    root = urdf_files.parse_xml(content, "robot.xacro")
    if xacro.is_xacro(root):
        _expand(folder, root)


def read_expression(folder: pathlib.Path, content: bytes, form: str = "${%s}") -> None:
    """What stands between the braces of a xacro file."""
    root = make.etree.fromstring(f'<robot name="r" xmlns:xacro="{URIS[0]}"><link/></robot>')
    with contextlib.suppress(ValueError):  # what no attribute can hold
        root[0].set("name", form % content.decode(errors="replace"))
    _expand(folder, root)


def read_loaded(folder: pathlib.Path, content: bytes) -> None:
    """A YAML file that a xacro file loads."""
    (folder / "a.yaml").write_bytes(content)
    read_expression(folder, b"xacro.load_yaml('a.yaml')")


def _expand(folder: pathlib.Path, root: make.etree._Element) -> None:
    """Beside the file lie one to include and one to load."""
    for other in (HERE / "corpus" / "beside").iterdir():
        shutil.copy(other, folder)
    path = folder / "robot.xacro"
    xacro.expand(root, path, urdf_files.Roots(path, {}), {}, Notes())


LOST = {"nan_count": 0, "overflow_count": 0, "lost": {"metrics.jsonl": 1}}
BEST = {"success_rate": 0.9, "env_steps": 64}
SUMMARY = {"env_steps": 1024, "train_s": 1.5, "steps_per_s": 700, "best": BEST, **LOST}
SEED = {"seed": 0, "success_rate": 0.5, "success_rate_95": [0.4, 0.6], "seconds_to_95": None, "env_steps": 10, "train_s": 1.0}
CURVES = {"cube mass [kg]": [{"value": 0.5, "success_rate": 0.9, "success_rate_95": [0.8, 0.95]}]}


@functools.cache
def a_run() -> dict[str, bytes]:
    """The JSON files of a run's folder."""
    run = run_cfg.resolve("nero_reach", "default", None, {"episode_length_s": "4"}, {"learning_rate": "1e-4"})
    described = {**config.to_dict(run), "versions": {"mjx-nero": "0.5.0"}}
    row = {"steps": 1, "train/success": 0.5, "reward/action_rate": -0.1, "eval/success_rate": None}
    return {
        "config.json": json.dumps(described, default=str).encode(),
        "summary.json": json.dumps({**SUMMARY, "evaluation": {"success_rate": 0.5}}).encode(),
        "seeds.json": json.dumps({"rows": [{**SEED, "seed": n, "stopped": "finished"} for n in (0, 7)]}).encode(),
        "metrics.jsonl": "".join(f"{json.dumps({**row, 'steps': step})}\n" for step in (1, 20, 300)).encode(),
    }


def read_run(folder: pathlib.Path, content: bytes, name: str) -> None:
    """A run's folder in which one of the JSON files is another: as it is gone on with, shown and told of."""
    for other, own in a_run().items():
        (folder / other).write_bytes(content if other == name else own)
    with contextlib.redirect_stdout(open(os.devnull, "w")):
        if name == "config.json":
            view_opening._described(folder)
            resume.same_run(folder, run_cfg.resolve("nero_reach", "default", None, {}, {}), (), {})
        elif name == "summary.json":
            train_run.report({**training._summary(folder), "folder": "x"}, films=False)
        elif name == "seeds.json":
            train_run.report_seeds(seeds._earlier(folder / name), folder)
        elif rows := logs.read(folder / name):
            logs.plot_curve(rows, folder / "curve.png")


def read_figures(folder: pathlib.Path, content: bytes, read: Callable[[pathlib.Path], object]) -> None:
    """A JSON or YAML file of figures."""
    (folder / "a.json").write_bytes(content)
    found = read(folder / "a.json")
    if read is results.read:
        results.page(list(results.rows(found)), "a.json", "a.md")
    if read is robustness.read and found["curves"]:
        robustness.save_plot(folder / "a.png", [found])


def read_identified(folder: pathlib.Path, content: bytes) -> None:
    """A file of ``identify``, taken into a task."""
    (folder / "a.yaml").write_bytes(content)
    identified.applied(dataclasses.replace(registry.env_cfg("nero_reach"), identified=str(folder / "a.yaml")))


def read_log(folder: pathlib.Path, content: bytes) -> None:
    """A log of an arm."""
    (folder / "a.csv").write_bytes(content)
    arm_log.read(folder / "a.csv", ("joint1", "joint2"))


def read_onnx(folder: pathlib.Path, content: bytes) -> None:
    """An exported policy whose metadata are other texts by name; what runs it takes a ValueError for the file's fault."""
    import onnx

    from mjx_nero.deploy.policy import Policy

    made = onnx.load_model_from_string(an_export()[0])
    try:
        stored = files.parse_json(content)
        texts = {str(name)[:100].replace("\0", ""): json.dumps(value) for name, value in stored.items()}
    except (ValueError, AttributeError, RecursionError, TypeError):
        texts = {"joints": content.decode(errors="replace").replace("\0", "")}
    del made.metadata_props[:]
    onnx.helper.set_model_props(made, texts)
    onnx.save(made, folder / "a.onnx")
    try:
        policy = Policy(folder / "a.onnx")
        home = policy.metadata["joints"]["home"]
        targets = policy.executor(np.resize(home, len(policy.metadata["joints"]["names"])))
        sizes = {term["name"]: term["size"] // term["history"] for term in policy.metadata["observations"]}
        action = policy.act({name: np.zeros(size) for name, size in sizes.items()})
        assert np.isfinite(targets(action, targets.last)).all()
    except ValueError as error:
        raise error if isinstance(error, UserError) else UserError(_same(str(error))) from None


def _same(text: str) -> str:
    """The text, if it is one line as it stands."""
    assert text.isprintable() and len(text) <= LONGEST, text
    return text


@functools.cache
def an_export() -> tuple[bytes, bytes]:
    """An exported policy, and its metadata as JSON."""
    import onnxruntime  # noqa: F401  (reads a file of the system's at first)

    from mjx_nero.interop import onnx
    from mjx_nero.learn import policy

    env = registry.make("nero_reach", impl="native")
    trained = policy.load_for(env, "nero_reach", policy.shipped("nero_reach"))
    made = onnx.model(trained, env)
    return made.SerializeToString(), json.dumps({entry.key: json.loads(entry.value) for entry in made.metadata_props}).encode()


@functools.cache
def a_log() -> bytes:
    """A log of two joints, as short as one may be."""
    rows = [f"{0.02 * i:.3f},0.1,0.5,{0.1 + 1e-4 * i:.4f},0.5" for i in range(520)]
    return "\n".join(["# a log", "time,target.joint1,target.joint2,position.joint1,position.joint2", *rows]).encode()


@functools.cache
def an_identified() -> bytes:
    """What ``identify`` writes of Nero's arm."""
    number = {"value": 10.0, "low": 9.0, "high": 11.0}
    of = dict.fromkeys(("stiffness", "damping", "armature", "friction", "offset"), number)
    joints = dict.fromkeys(registry.env_cfg("nero_reach").robot.arm.joints, of)
    found = {"robot": "nero", "delay": {"value": 0.02, "low": 0.01, "high": 0.03}, "joints": joints}
    return json.dumps(found).encode()  # JSON is YAML


IN_FOLDER = {"robot": "robot.yaml", "model_in_folder": "model.xml", "mesh_in_folder": "meshes/m.stl"}
READERS: dict[str, Callable[[pathlib.Path, bytes], None]] = {
    "yaml": read_yaml,
    "gains": read_gains,
    "descriptor": read_descriptor,
    "flow": read_flow,
    "model": read_model,
    **{reader: functools.partial(read_robot, name=name) for reader, name in IN_FOLDER.items()},
    "policy": read_policy,
    **{kind: functools.partial(read_mesh, kind=kind) for kind in ("stl", "obj", "dae")},
    "urdf": read_urdf,
    "xacro": read_xacro,
    "expression": read_expression,
    "eval": functools.partial(read_expression, form="$(eval %s)"),
    "loaded": read_loaded,
    "run": functools.partial(read_run, name="config.json"),
    **{name: functools.partial(read_run, name=f"{name}.json") for name in ("summary", "seeds")},
    "metrics": functools.partial(read_run, name="metrics.jsonl"),
    "results": functools.partial(read_figures, read=results.read),
    "robustness": functools.partial(read_figures, read=robustness.read),
    "public_robots": functools.partial(read_figures, read=public_robots.read),
    "identified": read_identified,
    "log": read_log,
    "onnx": read_onnx,
}
BATCH = 100  # files of a run of one seed, and ...
SLOW = dict.fromkeys(("robot", "model_in_folder", "mesh_in_folder", "urdf"), 10)  # ... of readers that take longer
SLOW |= dict.fromkeys(("run", "metrics", "robustness", "identified", "onnx"), 20)


@functools.cache
def corpus(reader: str) -> list[bytes]:
    """What to start from: files of the package's own, and those of the folder ``corpus``."""
    own = [p.read_bytes() for p in sorted((HERE / "corpus" / reader).glob("*"))]
    flow = ASSETS / "cobotta_pro_900" / "rmpflow"
    made = a_robot()
    good = {
        "descriptor": lambda: [(flow / "robot_descriptor.yaml").read_bytes()],
        "flow": lambda: [(flow / "rmpflow_common.yaml").read_bytes()],
        "robot": lambda: [made["robot.yaml"]],
        "model": lambda: [(ASSETS / "nero" / "nero.xml").read_bytes(), (ASSETS / "so_arm101" / "so_arm101.xml").read_bytes()],
        "model_in_folder": lambda: [made["model.xml"]],
        "mesh_in_folder": lambda: [made["meshes/m.stl"]],
        "policy": lambda: [_small_policy()],
        "stl": lambda: [made["meshes/m.stl"]],
        "run": lambda: [a_run()["config.json"]],
        "summary": lambda: [a_run()["summary.json"]],
        "seeds": lambda: [a_run()["seeds.json"]],
        "metrics": lambda: [a_run()["metrics.jsonl"]],
        "results": lambda: [(ASSETS.parent / "docs" / "benchmarks.json").read_bytes()],
        "robustness": lambda: [json.dumps({"env": "e", "preset": "p", "version": "v", "curves": CURVES}).encode()],
        "public_robots": lambda: [(ASSETS.parent / "docs" / "public_robots.yaml").read_bytes()],
        "identified": lambda: [an_identified()],
        "log": lambda: [a_log()],
        "onnx": lambda: [an_export()[1]],
        "urdf": lambda: [
            make.arm(2, make.link("e", make.inertial(0.1), make.mesh("m.stl")), make.joint("j", "l2", "e")).encode()
        ],
    }
    return [*own, *good.get(reader, list)()]


def _small_policy() -> bytes:
    """The head of a policy that ships, with its smallest array alone."""
    content = (ASSETS / "policies" / "nero_reach.safetensors").read_bytes()
    length = int.from_bytes(content[:8], "little")
    head = json.loads(content[8 : 8 + length])
    sizes = {name: entry["data_offsets"][1] - entry["data_offsets"][0] for name, entry in head.items() if name != "__metadata__"}
    name = min(sizes, key=sizes.__getitem__)
    small = {"__metadata__": head["__metadata__"], name: {**head[name], "data_offsets": [0, sizes[name]]}}
    text = json.dumps(small).encode()
    return len(text).to_bytes(8, "little") + text + bytes(sizes[name])


_RUNS = ("os.system", "os.exec", "os.fork", "os.posix_spawn", "os.spawn", "subprocess.Popen", "socket.connect", "ctypes.dlopen")
_OWN = (sys.prefix, sys.base_prefix, str(HERE.parents[1]), "/proc/", "/sys/", "/dev/null", "/dev/urandom")
_OWN += (matplotlib.get_cachedir(), matplotlib.get_configdir())  # where it keeps its list of fonts
_OWN += tuple({os.path.dirname(font.fname) for font in font_manager.fontManager.ttflist})  # some are the system's
_watched: list[str] = []  # the folder of the file that is being judged, while one is
_seen: list[str] = []


def _watch(event: str, args: tuple) -> None:
    """Notes programs that are run, and files that are opened which are neither the reader's nor Python's."""
    if not _watched:
        return
    if event in _RUNS:
        _seen.append(f"{event} {args!r:.200}")
    elif event == "open" and isinstance(args[0], str | bytes):
        path = os.path.realpath(os.fsdecode(args[0]))
        if not path.startswith((_watched[0], *_OWN)):
            _seen.append(f"open {path}")


sys.addaudithook(_watch)


def judge(reader: str, content: bytes) -> bool:
    """Whether the file is taken; raises if it does harm."""
    folder = pathlib.Path(tempfile.mkdtemp())
    here = pathlib.Path.cwd()
    before = set(here.iterdir())

    def late(number, _):
        raise TimeoutError(f"more than {LIMITS[number][1]:g} s")

    for number, (timer, seconds) in LIMITS.items():
        signal.signal(number, late)
        signal.setitimer(timer, seconds)
    _seen.clear()
    _watched.append(os.path.realpath(folder))
    try:
        READERS[reader](folder, content)
    except UserError as error:
        assert str(error).isprintable() and len(str(error)) <= LONGEST, str(error)
        return False
    finally:
        for timer, _ in LIMITS.values():
            signal.setitimer(timer, 0)
        _watched.clear()
        shutil.rmtree(folder)
        assert not _seen, _seen
        assert set(here.iterdir()) == before, set(here.iterdir()) - before
    return True


def fuzz(reader: str, seed: int, start: list[bytes] | None = None) -> tuple[int, int]:
    """Tries some files; how many were tried, and how many of them were taken.

    Args:
        start: the files that are changed, in place of the corpus.
    """
    start, counts = start or corpus(reader), [0, 0]

    @hypothesis.seed(seed)
    @hypothesis.settings(
        max_examples=SLOW.get(reader, BATCH),
        deadline=None,
        database=None,
        suppress_health_check=list(hypothesis.HealthCheck),
        print_blob=False,
    )
    @hypothesis.given(st.sampled_from(range(len(start))), st.lists(EDIT, min_size=1, max_size=4))
    def attempt(which, edits):
        content = edited(start[which], edits)
        counts[0] += 1
        try:
            counts[1] += judge(reader, content)
        except BaseException as error:
            again = f"again: fuzz.py --reader {reader} --seed {seed} --minutes 0"
            error.add_note(f"{len(content)} bytes: {content[:2000]!r}; {again}")
            raise

    attempt()
    return counts[0], counts[1]


def limit_memory() -> None:
    """No more than ``MEMORY`` beyond what is in use now."""
    used = 4096 * int(pathlib.Path("/proc/self/statm").read_text().split()[0])
    resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, resource.RLIM_INFINITY))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=10.0, help="shared by the readers; each has one run at least")
    parser.add_argument("--seed", type=int, default=1, help="of the first run; the next has the next")
    parser.add_argument("--reader", choices=READERS, action="append", help="again for more (default: all)")
    parser.add_argument("--finds", type=pathlib.Path, default=pathlib.Path("finds.txt"), help="where finds are written")
    args = parser.parse_args()
    limit_memory()
    finds_file = args.finds.resolve()
    os.chdir(tempfile.mkdtemp())  # where nobody else leaves files
    readers = args.reader or list(READERS)
    finds = total = 0
    for reader in readers:
        began, seed, tried, taken, found = time.monotonic(), args.seed, 0, 0, []
        while seed == args.seed or time.monotonic() - began < 60 * args.minutes / len(readers):
            try:
                if seed == args.seed:
                    for content in corpus(reader):
                        judge(reader, content)
                more = fuzz(reader, seed)
                tried, taken = tried + more[0], taken + more[1]
            except Exception as error:
                found.append(f"{reader}, seed {seed}\n{''.join(traceback.format_exception(error))}\n")
            seed += 1
        with finds_file.open("a") as file:
            file.writelines(found)
        finds, total = finds + len(found), total + tried
        print(f"{reader:<16} {tried:>8,} files, {taken:,} taken, {len(found)} finds, seeds {args.seed} to {seed - 1}", flush=True)
    print(f"{total:,} files in {args.minutes:g} minutes in one process; {finds} finds")
    return 1 if finds else 0


if __name__ == "__main__":
    sys.exit(main())
