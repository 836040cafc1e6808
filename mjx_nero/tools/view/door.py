"""A proxy that guards a page's server: it lets in only requests with the printed token, from the printed address."""

import asyncio
import contextlib
import errno
import hmac
import ipaddress
import pathlib
import secrets
import socket
import threading
from typing import TYPE_CHECKING

from mjx_nero.tools.view import request
from mjx_nero.tools.view.log import LOG
from mjx_nero.types import UserError

if TYPE_CHECKING:
    from mjx_nero.tools.view import inner

PATIENCE_S = 10.0  # time limit for a request's head
GUESTS = 64  # maximum number of connections that wait for admission, and of admitted ones
PORTS = 100  # number of ports to try
RATE = 1 << 18  # bytes per second that a page may send
_LOCAL = ("localhost", "127.0.0.1", "[::1]")
_ANSWER = (
    "HTTP/1.1 {status}\r\nContent-Type: text/plain\r\nContent-Length: {length}\r\nX-Frame-Options: DENY\r\n"
    "Cache-Control: no-store\r\nReferrer-Policy: no-referrer\r\n{more}Connection: close\r\n\r\n{text}"
)
_STRANGER = "Open the address that the program printed, with its token.\n"


def open_page(host: str, port: int) -> "tuple[inner.Inner, Door]":
    """Opens a page's server and its ``Door``.

    Raises:
        UserError: the program cannot listen on the address, or this version of viser cannot be served.
    """
    from mjx_nero.tools.view import inner  # needs viser

    page = inner.Inner()
    try:
        return page, Door(host, port, page.path)
    except UserError:
        page.close()
        raise


class Door:
    """Listens on ``host:port`` and passes requests with the token to a server on this machine. The first request has the token
    in its address; after that a cookie holds it.

    Browsers name the address that they request (Host) and the page that makes the request (Origin). Both must be this page's.
    This keeps out other pages that the user has open, and pages whose name resolves to this machine (DNS rebinding). Traffic is
    not encrypted: use it in a network that you trust, or through a tunnel.

    Args:
        host: address to listen on. If it is not local, IP addresses and this machine's name are accepted as well.
        port: first port to try; 0: any free port.
        behind: Unix socket of the server.

    Attributes:
        url: address to open, with the token.

    Raises:
        UserError: the program cannot listen on the address.
    """

    def __init__(self, host: str, port: int, behind: pathlib.Path):
        self.token, self._behind = secrets.token_urlsafe(16), behind
        self._waiting: dict[asyncio.StreamWriter, None] = {}
        self._open: set[asyncio.Task | None] = set()  # the event loop itself keeps only weak references
        self._inside = 0
        self._loop = asyncio.new_event_loop()
        self._loop.set_exception_handler(lambda _, context: LOG.warning("the door: %s", context["message"]))
        try:
            self._server = self._loop.run_until_complete(self._listen(host, port))
        except OSError as error:
            self._loop.close()
            raise UserError(f"cannot listen on {host}:{port}: {error.strerror or error}; pass another --host or --port") from None
        self.port = self._server.sockets[0].getsockname()[1]
        self._cookie = f"mjx_nero_view_{self.port}"  # cookies are shared by all ports
        self._everywhere = not _is_local(host)
        name = socket.gethostname() if host in ("0.0.0.0", "::", "") else f"[{host}]" if ":" in host else host
        # The name localhost may resolve to another address of this machine, where another user listens.
        self.url = f"http://{'127.0.0.1' if name == 'localhost' else name}:{self.port}/?token={self.token}"
        self._names = {name.lower(), *_LOCAL, *([socket.gethostname().lower()] if self._everywhere else [])}
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends all connections."""
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(timeout=5)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=5)
        self._loop.close()

    async def _listen(self, host: str, port: int) -> asyncio.Server:
        last = min(port + PORTS - 1, 65535) if port else 0
        while True:
            try:
                where = "127.0.0.1" if host == "localhost" else host
                return await asyncio.start_server(self._come, where, port, limit=request.LONGEST)
            except OSError as error:
                if error.errno != errno.EADDRINUSE or port == last:
                    raise
                port += 1

    async def _end(self) -> None:
        self._server.close()
        open_ones = [task for task in self._open if task]
        for task in open_ones:
            task.cancel()
        await asyncio.gather(*open_ones, return_exceptions=True)

    async def _come(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        self._open.add(task)
        with contextlib.suppress(OSError, asyncio.CancelledError):
            try:
                await self._serve(reader, writer)
            finally:
                self._open.discard(task)
                self._waiting.pop(writer, None)
                writer.close()

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._waiting[writer] = None
        if len(self._waiting) > GUESTS:  # drop the connection that has waited longest
            longest = next(iter(self._waiting))
            del self._waiting[longest]
            longest.transport.abort()
        try:
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), PATIENCE_S)
            asked = request.parse(head)
        except TimeoutError:  # browsers connect in advance and would show an answer before the request as the page
            return
        except (asyncio.IncompleteReadError, asyncio.LimitOverrunError, ValueError):
            await _answer(reader, writer, "400 Bad Request", "This is not a request for a page.\n")
            return
        if not self._is_mine(asked):
            await _answer(reader, writer, "403 Forbidden", _STRANGER)
        elif not asked.query and self._knows(asked.cookie(self._cookie)):
            await self._through(asked, reader, writer)
        elif set(asked.query) == {"token"} and self._knows(asked.query["token"]):
            cookie = f"Set-Cookie: {self._cookie}={self.token}; HttpOnly; SameSite=Strict; Path=/\r\n"
            await _answer(reader, writer, "303 See Other", "", f"Location: /\r\n{cookie}")
        else:  # also other queries: some make viser's page talk to another server
            await _answer(reader, writer, "403 Forbidden", _STRANGER)

    def _is_mine(self, asked: request.Request) -> bool:
        """Returns whether a request is for this address and comes from it."""
        known = asked.host in self._names or (self._everywhere and _is_address(asked.host))  # an IP address cannot be rebound
        return known and asked.own_origin

    def _knows(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self.token.encode())

    async def _through(self, asked: request.Request, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._waiting.pop(writer, None)
        if self._inside >= GUESTS:
            await _answer(reader, writer, "503 Service Unavailable", "Too many pages are open.\n")
            return
        self._inside += 1
        try:
            inner, outer = await asyncio.open_unix_connection(self._behind)
            outer.write(asked.head())
            ways = [asyncio.create_task(_pump(inner, writer))]
            if asked.upgrades:  # otherwise the client sends nothing more
                ways.append(asyncio.create_task(_pump(reader, outer, RATE)))
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                outer.close()
                await asyncio.gather(*ways, return_exceptions=True)
        finally:
            self._inside -= 1


async def _answer(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, status: str, text: str, more: str = "") -> None:
    """Answers, and reads on for a moment, because closing with unread data would discard the answer."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(1.0):
            writer.write(_ANSWER.format(status=status, length=len(text), more=more, text=text).encode())
            await writer.drain()
            writer.write_eof()
            while await reader.read(1 << 16):
                pass


async def _pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter, rate: float = float("inf")) -> None:
    while data := await source.read(1 << 12 if rate < float("inf") else 1 << 16):
        sink.write(data)
        await sink.drain()
        await asyncio.sleep(len(data) / rate)


def _is_address(name: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(ipaddress.ip_address(name.strip("[]")))
    return False


def _is_local(host: str) -> bool:
    return host == "localhost" or (_is_address(host) and ipaddress.ip_address(host).is_loopback)
