"""What is misused by the thousand in one process: the viewer's door and messages, Gymnasium's environments; and signals."""

import contextlib
import io
import logging
import os
import pathlib
import random
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

LONGEST, SECONDS = 500, 30.0


def _log() -> io.StringIO:
    """What the package and its servers log from here on."""
    said = io.StringIO()
    logging.getLogger().addHandler(logging.StreamHandler(said))
    return said


def http(seed: int, count: int) -> Iterator[tuple[str, str]]:
    """Requests to the doors of an empty page."""
    import pages

    from mjx_nero.tools.view import inner
    from mjx_nero.tools.view.door import Door

    said, draw, page = _log(), random.Random(f"http {seed}"), inner.Inner()
    doors = [Door(host, 0, page.path) for host in ("127.0.0.1", "0.0.0.0")]
    for i in range(count):
        door = doors[i % 2]
        data = next(pages.odd_requests(door, draw))
        answer = _answer(door.port, data)
        known = answer.split(b" ")[1:2] in ([b"200"], [b"101"], [b"303"], [b"400"], [b"403"], [b"404"])
        good = f"GET / HTTP/1.1\r\nHost: localhost\r\nCookie: {pages.cookie_of(door)}\r\n\r\n".encode()
        alive = i % 20 or _answer(door.port, good).startswith(b"HTTP/1.1 200")
        why = (
            ""
            if known and alive and "Traceback" not in said.getvalue()
            else f"{answer[:200]!r} {alive} {said.getvalue()[-2000:]}"
        )
        yield f"request {data[:200]!r}", why
    for each in (*doors, page):
        each.close()


def _answer(port: int, data: bytes) -> bytes:
    with socket.create_connection(("127.0.0.1", port), timeout=SECONDS) as client:
        answer = b""
        with contextlib.suppress(OSError):
            client.sendall(data)
            client.shutdown(socket.SHUT_WR)
            while b"\r\n\r\n" not in answer and (more := client.recv(1 << 16)):
                answer += more
        return answer


def messages(seed: int, count: int) -> Iterator[tuple[str, str]]:
    """Messages to a view, a hundred a connection; a page of somebody else's stays all the time."""
    import pages
    from waiting import wait

    from mjx_nero.tools.view import opening

    said, draw = _log(), random.Random(f"messages {seed}")
    shown = opening.open_view(env_name="nero_reach", agent="zero", port=18600)
    odd = pages.odd_messages(shown, draw)
    try:
        with pages.talk(shown) as other:
            threading.Thread(target=pages.drain, args=(other,), daemon=True).start()
            pages.look(shown, other)
            for start in range(0, count, 100):
                sent = [next(odd) for _ in range(min(100, count - start))]
                with contextlib.suppress(Exception), pages.talk(shown) as client:  # a wrong frame ends its own connection
                    threading.Thread(target=pages.drain, args=(client,), daemon=True).start()
                    for raw in sent:
                        client.send(raw)
                    time.sleep(1.0)
                speed = draw.choice((1.0, 2.0, 3.0, 0.5))
                pages.say(other, "GuiUpdateMessage", uuid=pages.controls(shown)["Speed"][0], updates={"value": speed})
                try:
                    wait(lambda speed=speed: shown.session.speed == speed)
                    why = "Traceback" if "Traceback" in said.getvalue() or shown.session.failure is not None else ""
                except AssertionError:
                    why = "the other page is not heard any more"
                yield from ((f"message {raw[:200]!r}", why and f"{why}: {said.getvalue()[-2000:]}") for raw in sent)
    finally:
        shown.close()


NAN = float("nan")
VALUES: list[Callable[[random.Random, tuple[int, ...]], Any]] = [
    lambda draw, shape: draw.choice((None, "x", b"x", {}, [], (), {1: 2}, object(), NAN, True, 10**400, "nan", -1, 2**32, 1e30)),
    lambda draw, shape: [draw.choice((0.0, NAN, None, "x", 1e39, 10**400, [], True, -1)) for _ in range(draw.choice((1, 7, 8)))],
    lambda draw, shape: np.full(
        draw.choice((shape, shape, (), (7,), (2, 7), (7, 2), (0,))), draw.choice((0, NAN, 1e308, -1e38, 3))
    ),
    lambda draw, shape: np.zeros(shape).astype(draw.choice(("i1", "u8", "f2", "f8", "c8", "O", "U3", "S3", "?", "M8[s]", "V4"))),
    lambda draw, shape: np.random.default_rng(draw.randrange(9)).normal(size=shape) * 10.0 ** draw.randint(-300, 300),
    lambda draw, shape: np.zeros((*shape, 2))[..., 0],
    lambda draw, shape: np.ma.masked_all(shape),
    lambda draw, shape: np.zeros(shape, ">f4"),
]


def gym(seed: int, count: int) -> Iterator[tuple[str, str]]:
    """Steps, resets and arguments with odd values, in any order; also after close."""
    import gymnasium

    import mjx_nero
    from mjx_nero import UserError
    from mjx_nero.interop.gymnasium import Env, VectorEnv

    draw = random.Random(f"gym {seed}")
    reach = mjx_nero.make("nero_reach", impl="native", num_envs=3, episode_length_s=1.0)
    live = [Env(reach), VectorEnv(reach, 3)]
    closed = [Env(reach), VectorEnv(reach, 3)]
    for env in (*live, *closed):
        env.reset(seed=0)
    for env in closed:
        env.close()
    fine = (UserError, gymnasium.error.Error, gymnasium.error.ResetNeeded, gymnasium.error.ClosedEnvironmentError)
    arguments = ("env", "num_envs", "arrays", "group", "render_mode", "num_rendered", "preset", "impl", "sim.dt", "robot", "x")
    arguments += ("episode_length_s", "sim.decimation", "scene.goal", "observations.state.joint_pos.history", "action_clip")

    def any_call() -> tuple[str, Callable[[], Any]]:
        env = draw.choice((*live, *live, *live, *closed))
        value = draw.choice(VALUES)(draw, env.action_space.shape)
        kind = draw.choice(("step", "step", "reset", "options", "make"))
        if kind == "step":
            return f"step({value!r:.200})", lambda: env.step(value)
        if kind == "reset":
            return f"reset(seed={value!r:.200})", lambda: env.reset(seed=value)
        if kind == "options":
            return f"reset(options={value!r:.200})", lambda: env.reset(options=value)
        name, made = draw.choice(arguments), draw.choice((Env, VectorEnv))
        return f"{made.__name__}({name}={value!r:.200})", lambda: made(**{"env": "nero_reach", "impl": "native", name: value})

    for _ in range(count):
        what, call = any_call()
        began, why = time.monotonic(), ""
        try:
            call()
        except fine as error:
            why = "" if str(error).isprintable() and 5 < len(str(error)) < LONGEST else f"message: {error}"
        except Exception as error:
            why = "".join(traceback.format_exception(error))[-2000:]
        yield what, why or (f"{time.monotonic() - began:.0f} s" if time.monotonic() - began > SECONDS else "")
        for env in live:
            if not np.isfinite(env.step(np.zeros(env.action_space.shape))[0]).all():
                yield what, "observations afterwards are not finite"


def signals(seed: int, count: int) -> Iterator[tuple[str, str]]:
    """Trainings that one to three signals end at any time: nothing is half-written, and what is left can be read."""
    draw = random.Random(f"signals {seed}")
    for number in (signal.SIGINT, signal.SIGHUP):  # what a shell has put in the background ignores them
        signal.signal(number, signal.SIG_DFL)
    for i in range(count):
        sent = [(draw.choice(("TERM", "INT", "HUP", "USR1")), draw.uniform(0, 8))]
        sent += [(draw.choice(("TERM", "INT", "USR1")), draw.choice((0.0, 0.05, 1.0))) for _ in range(draw.randint(0, 2))]
        training = i % 2 == 1  # else they come as the program starts
        with tempfile.TemporaryDirectory() as folder:
            yield f"signals {sent}, training: {training}", _signalled(pathlib.Path(folder), sent, training)


TRAIN = "train --env nero_reach --impl native --num-envs 8 --num-timesteps 1e9 --eval-every 100000 --no-video --out run"


def _signalled(folder: pathlib.Path, sent: list[tuple[str, float]], training: bool) -> str:
    """What is wrong with how a training ended; empty if nothing is.

    Args:
        sent: signals, and how long to wait before each [s].
        training: the first wait begins when its first update is made.
    """
    from mjx_nero import UserError
    from mjx_nero.runs import resume

    env = {**os.environ, "XDG_CACHE_HOME": f"{folder}/cache", "JAX_DISABLE_MOST_OPTIMIZATIONS": "true"}
    with open(folder / "said", "w") as said:
        run = subprocess.Popen([sys.executable, "-m", "mjx_nero", *TRAIN.split()], cwd=folder, env=env, stdout=said, stderr=said)
    deadline = time.monotonic() + 300
    while training and run.poll() is None and not (folder / "run" / "config.json").exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    for name, wait in sent:
        time.sleep(wait)
        run.send_signal(getattr(signal, f"SIG{name}"))
    began, before = time.monotonic(), _queued(run.pid)
    queued = dict(before)
    while run.poll() is None:
        queued |= _queued(run.pid)
        if time.monotonic() - began > SECONDS + sum(queued.values()) - sum(before.values()):
            run.kill()
            run.wait()
            return f"did not end within {SECONDS:g} s of the last signal: {(folder / 'said').read_text()[-2000:]}"
        time.sleep(0.05)
    code = run.returncode
    text, left = (folder / "said").read_text(), [str(path) for path in folder.glob("run/**/*.part*")]
    ways = [-getattr(signal, f"SIG{name}") for name, _ in sent if not training]  # before the program has begun
    ways += [128 + getattr(signal, f"SIG{name}") for name, _ in sent]
    try:
        resume.find(folder / "run", lambda line: None)
    except UserError as error:
        if training and len(sent) == 1:
            return f"nothing to go on from: {error}"
    if "Traceback" in text or (left and len(sent) == 1) or code not in ways:
        return f"exit {code}, left {left}: {text[-2000:]}"
    return ""


def _queued(pid: int) -> dict[str, float]:
    """By thread: the time that it was ready to run and a busy machine gave it no core [s]; see ``server.run``."""
    found = {}
    for path in pathlib.Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with contextlib.suppress(OSError, IndexError):  # the thread has ended
            found[path.parent.name] = 1e-9 * int(path.read_text().split()[1])
    return found
