"""The door of the browser view: who gets in, and what becomes of requests that make no sense."""

import contextlib
import http.client
import http.server
import os
import random
import socket
import stat
import threading
import time

import msgspec
import pytest

from mjx_nero.tools.view import opening, request

pytest.importorskip("viser")

from pages import CAMERA, SPOKEN, controls, cookie_of, odd_requests, token_of
from waiting import wait

from mjx_nero.tools.view import inner
from mjx_nero.tools.view.door import Door

KEY = "dGhlIHNhbXBsZSBub25jZQ=="


@pytest.fixture(scope="module")
def page():
    """An empty page behind its socket."""
    shown = inner.Inner()
    yield shown
    shown.close()


@pytest.fixture(scope="module")
def doors(page):
    """One for this machine, one for its network."""
    both = {host: Door(host, 0, page.path) for host in ("127.0.0.1", "0.0.0.0")}
    yield both
    for door in both.values():
        door.close()


def raw(port, data, seconds=120.0, end=False):
    """What comes back for these bytes."""
    with socket.create_connection(("127.0.0.1", port), timeout=seconds) as client:
        with contextlib.suppress(OSError):
            client.sendall(data)
            if end:
                client.shutdown(socket.SHUT_WR)
        answer = b""
        with contextlib.suppress(OSError):
            while b"\r\n\r\n" not in answer and (more := client.recv(1 << 16)):
                answer += more
        return answer


def knock(port, host, origin=None, cookie=None, socket_=False, path="/"):
    """Status of a request for the page, or for a websocket."""
    lines = [f"GET {path} HTTP/1.1", f"Host: {host}"]
    lines += [f"Origin: {origin}"] if origin else []
    lines += [f"Cookie: {cookie}"] if cookie else []
    if socket_:
        lines += ["Upgrade: websocket", "Connection: Upgrade", "Sec-WebSocket-Version: 13", f"Sec-WebSocket-Key: {KEY}"]
        lines += [f"Sec-WebSocket-Protocol: {SPOKEN}"]
    return int(raw(port, "\r\n".join([*lines, "", ""]).encode()).split(b" ")[1])


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
@pytest.mark.parametrize("socket_", [False, True], ids=["page", "websocket"])
def test_who_gets_in(doors, host, socket_):
    """Every Host with every Origin with every token, and by which rule the few get in that do."""
    door = doors[host]
    port, name = door.port, socket.gethostname()
    hosts = {f"127.0.0.1:{port}": True, f"localhost:{port}": True, f"LOCALHOST:{port}": True, "localhost:9000": True}
    hosts |= {f"[::1]:{port}": True, f"192.0.2.7:{port}": host == "0.0.0.0", f"{name}:{port}": host == "0.0.0.0"}
    hosts |= dict.fromkeys((f"evil.example:{port}", "evil.example", f"localhost.evil:{port}", "127.0.0.1.evil"), False)
    cookies = {cookie_of(door): True, "a={b}; " + cookie_of(door): True, None: False, f"mjx_nero_view_{port}=x": False}
    cookies |= {f"mjx_nero_view_{port}=": False, f"mjx_nero_view={token_of(door)}": False}
    for sent, mine in hosts.items():
        others = (
            "null",
            f"https://{sent}",
            "http://evil.example",
            f"http://{sent}1",
            f"http://{sent}.evil",
            "http://127.0.0.1:1",
        )
        origins = {f"http://{sent}": True, None: not socket_, "file://": False} | dict.fromkeys(others, False)
        for origin, own in origins.items():
            for cookie, known in cookies.items():
                expected = (101 if socket_ else 200) if mine and own and known else 403
                assert knock(port, sent, origin, cookie, socket_) == expected, (sent, origin, cookie)
            given = knock(port, sent, origin, None, socket_, f"/?token={token_of(door)}")
            assert given == (303 if mine and own else 403), (sent, origin)


def test_the_token_comes_once_and_a_cookie_keeps_it(doors):
    door = doors["127.0.0.1"]
    assert len(token_of(door)) >= 20
    for path in ("/?token=wrong", "/?token=", "/?token=%00", "/?token=%C3%A4", f"/?token={token_of(door)}&websocket=ws://evil"):
        assert knock(door.port, "localhost", path=path) == 403
    # viser's page would connect to a server, or play a file, that its address names
    for path in ("/?websocket=ws://evil.example", "/?playbackPath=http://evil.example/a", "/?"):
        assert knock(door.port, "localhost", path=path, cookie=cookie_of(door)) == (200 if path == "/?" else 403)
    connection = http.client.HTTPConnection("127.0.0.1", door.port, timeout=120)
    connection.request("GET", f"/?token={token_of(door)}")
    answer = connection.getresponse()
    given = answer.getheader("Set-Cookie")
    assert answer.status == 303 and answer.getheader("Location") == "/" and "HttpOnly" in given and "SameSite=Strict" in given
    connection = http.client.HTTPConnection("127.0.0.1", door.port, timeout=120)
    connection.request("GET", "/", headers={"Cookie": given.partition(";")[0]})
    answer = connection.getresponse()
    assert answer.status == 200 and len(answer.read()) > 100_000
    assert answer.getheader("X-Frame-Options") == "DENY"


def test_nobody_else_reaches_the_inner_server(page):
    folder = page.path.parent
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700 and folder.stat().st_uid == os.getuid()
    mine = {os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}")}

    def listening():
        for table in ("tcp", "tcp6"):
            for line in open(f"/proc/self/net/{table}").read().splitlines()[1:]:
                _, local, _, state, *_, inode = line.split()[:10]
                if state == "0A" and f"socket:[{inode}]" in mine:
                    yield int(local.rpartition(":")[2], 16)

    before = set(listening())
    another = inner.Inner()
    try:
        mine = {os.readlink(f"/proc/self/fd/{fd}") for fd in os.listdir("/proc/self/fd") if os.path.exists(f"/proc/self/fd/{fd}")}
        assert set(listening()) == before
    finally:
        folder = another.path.parent
        another.close()
    assert not folder.exists()


BAD_HEADS = [
    b"GET http://[::1/x HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET /?token=[::1 HTTP/1.1\r\nHost: [::1\r\n\r\n",
    b"GET //[::1/ HTTP/1.1\r\nHost: [\r\n\r\n",
    b"GET / HTTP/1.1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: a\r\nHost: b\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: user@localhost\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost:99999999\r\n\r\n",
    b"GET / HTTP/1.0\r\nHost: localhost\r\n\r\n",
    b"GET / HTTP/9.9\r\nHost: localhost\r\n\r\n",
    b"GET\r\n\r\n",
    b"\r\n\r\n",
    b"GET /\x00 HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET /../../etc/passwd HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET /%2e%2e/ HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"POST / HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"CONNECT localhost:1 HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: h2c\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\n folded: x\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nA: \x07\r\n\r\n",
    b"GET / HTTP/1.1\nHost: localhost\n\n\r\n\r\n",
    b"GET /?token=" + b"a" * 100_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\nA: " + b"a" * 1_000_000 + b"\r\n\r\n",
    b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"".join(b"A%d: 1\r\n" % i for i in range(5000)) + b"\r\n",
    b"GET / HTTP/1.1\r\n" + b"a" * 20_000,
    b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\x00" * 500,
]


@pytest.mark.usefixtures("silence")
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_odd_requests_get_400(doors, host):
    port = doors[host].port
    for head in BAD_HEADS:
        assert raw(port, head, end=True).startswith(b"HTTP/1.1 400 Bad Request\r\n"), head[:80]
    assert knock(port, "localhost", cookie=cookie_of(doors[host])) == 200


@pytest.mark.usefixtures("silence")
def test_a_thousand_random_requests(doors):
    door, draw = doors["127.0.0.1"], random.Random(43)
    requests, statuses = odd_requests(door, draw), set()
    for _ in range(1000):
        statuses.add(raw(door.port, next(requests), end=True).split(b" ")[1])
    assert statuses <= {b"200", b"303", b"400", b"403", b"404"} and {b"400", b"403"} <= statuses
    assert knock(door.port, "localhost", cookie=cookie_of(door)) == 200


def test_slow_clients_go_when_others_come(doors, monkeypatch):
    from mjx_nero.tools.view import door as module

    monkeypatch.setattr(module, "PATIENCE_S", 2.0)
    port = doors["127.0.0.1"].port
    slow = [socket.create_connection(("127.0.0.1", port)) for _ in range(2 * module.GUESTS)]
    try:
        for each in slow:
            with contextlib.suppress(OSError):
                each.sendall(b"GET / HT")
        assert knock(port, "localhost", cookie=cookie_of(doors["127.0.0.1"])) == 200  # at once
        slow[-1].settimeout(120)
        assert slow[-1].recv(100) == b""  # a browser's early connection: no page yet
        assert len(doors["127.0.0.1"]._waiting) <= module.GUESTS
    finally:
        for each in slow:
            each.close()


def test_what_is_read_of_a_request():
    asked = request.parse(b"GET /?token=a%20b HTTP/1.1\r\nhOST: [::1]:80\r\nOrigin: http://[::1]:80\r\nCookie: a=1; b=2\r\n\r\n")
    assert (asked.host, asked.query, asked.cookie("b"), asked.cookie("c")) == ("[::1]", {"token": "a b"}, "2", "")
    assert asked.own_origin and not asked.upgrades
    assert asked.head() == b"GET / HTTP/1.1\r\nhost: [::1]:80\r\norigin: http://[::1]:80\r\ncookie: a=1; b=2\r\n\r\n"


EVIL = """<!doctype html><title>evil</title><body><script>
const seen = {};
const done = (name, what) => { seen[name] = what; document.title = JSON.stringify(seen); };
function tryAll(port, version, update) {
  for (const host of ["127.0.0.1", "localhost", "evil.example"])
    for (const path of ["/", "/?token=", "/x"]) {
      const name = "ws " + host + path;
      const socket = new WebSocket(`ws://${host}:${port}${path}`, [version]);
      socket.onopen = () => {
        done(name, "open");
        for (const each of update) socket.send(Uint8Array.from(each));
      };
      socket.onerror = () => seen[name] || done(name, "refused");
    }
  for (const mode of ["cors", "no-cors"])
    fetch(`http://127.0.0.1:${port}/`, {mode, credentials: "include"})
      .then(r => r.text()).then(t => done("fetch " + mode, t.length)).catch(() => done("fetch " + mode, "refused"));
  const frame = document.createElement("iframe");
  frame.onload = () => done("frame", "tried");
  frame.src = `http://127.0.0.1:${port}/`;
  document.body.append(frame);
}
</script>"""


@pytest.fixture
def evil():
    """A web page of somebody else's on this machine: every port is another origin."""

    class Page(http.server.BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html")
            self.end_headers()
            self.wfile.write(EVIL.encode())

        def log_message(self, *args):
            pass

    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_port
    server.shutdown()
    server.server_close()


@pytest.mark.slow
@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_page_of_another_origin_neither_steers_nor_shares(browser, evil, host, monkeypatch, tmp_path):
    """While the user has the view open in the same browser, whose cookie goes along where the other page is of the same site."""
    from selenium.webdriver.common.by import By
    from viser import _viser

    opened = []
    monkeypatch.setattr(_viser, "ViserTunnel", lambda *args, **kwargs: opened.append(args))
    shown = opening.open_view(env_name="nero_lift", agent="zero", port=18500, host=host)
    try:
        port = shown._door.port
        browser.get(f"http://127.0.0.1:{port}/?token={token_of(shown._door)}")
        own = browser.current_window_handle
        wait(lambda: shown.server.get_clients(), 120)
        wait(lambda: "Agent" in browser.find_element(By.TAG_NAME, "body").text, 120)
        named = controls(shown)
        orders = [{"type": "ViewerCameraMessage"} | CAMERA]
        orders += [{"type": "GuiUpdateMessage", "uuid": named["Speed"][0], "updates": {"value": 4.0}}]
        orders += [{"type": "GuiUpdateMessage", "uuid": named["Pause"][0], "updates": {"value": True}}]
        orders += [{"type": "ShareUrlRequest"}]
        packed = [list(msgspec.msgpack.encode(each)) for each in orders]
        for origin in (f"http://127.0.0.1:{evil}", f"http://localhost:{evil}", f"http://evil.example:{evil}"):
            browser.switch_to.new_window("tab")
            browser.get(origin)
            browser.execute_script("tryAll(...arguments)", port, SPOKEN, packed)
            wait(lambda: len(seen := browser.execute_script("return seen")) == 12 and seen, 60)
            seen = browser.execute_script("return seen")
            assert {what for name, what in seen.items() if name.startswith("ws")} == {"refused"}, seen
            assert seen["fetch cors"] == "refused" and seen["fetch no-cors"] in ("refused", 0), seen
        time.sleep(3)  # a framed page would be a client by now
        assert len(shown.server.get_clients()) == 1
        for handle in set(browser.window_handles) - {own}:
            browser.switch_to.window(handle)
            browser.close()
        browser.switch_to.window(own)
        browser.switch_to.new_window("tab")
        browser.get(f"http://evil.example:{port}/?token={token_of(shown._door)}")  # a name that is made to lead here
        assert "Open the address that the program printed" in browser.find_element(By.TAG_NAME, "body").text
        browser.close()
        browser.switch_to.window(own)
        assert len(shown.server.get_clients()) == 1 and opened == []
        assert shown.session.running and shown.session.speed == 1.0
        # The page itself steers, and it draws.
        browser.find_element(By.XPATH, "//button[.//*[text()='Pause'] or text()='Pause']").click()
        wait(lambda: not shown.session.running)
        browser.save_screenshot(str(tmp_path / "view.png"))
        errors = [line["message"] for line in browser.get_log("browser") if line["level"] == "SEVERE"]
        assert not [e for e in errors if "Content Security Policy" in e and "frame-ancestors" not in e]
    finally:
        shown.close()
