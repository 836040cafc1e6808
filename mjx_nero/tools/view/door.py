"""A door before a page server: whoever comes from another machine needs the token of the printed address."""

import asyncio
import contextlib
import hmac
import http.cookies
import secrets
import socket
import threading
import urllib.parse

from mjx_nero.types import UserError

_COOKIE = "mjx_nero_view"
_LONGEST = 65536  # bytes of a request's head
_REFUSED = b"HTTP/1.1 403 Forbidden\r\nContent-Type: text/plain\r\nContent-Length: %d\r\nConnection: close\r\n\r\n%s"


class Door:
    """Listens at ``host:port`` and lets through, to a server on this machine, connections whose first request has the token.

    The token comes with the address once; a cookie keeps it. What comes in is not encrypted: use it in a network that you trust,
    or a tunnel.

    Args:
        behind: port of the server at 127.0.0.1.

    Raises:
        UserError: the address cannot be listened at.
    """

    def __init__(self, host: str, port: int, behind: int):
        self.token, self._behind = secrets.token_urlsafe(16), behind
        self._loop = asyncio.new_event_loop()
        try:
            self._server = self._loop.run_until_complete(asyncio.start_server(self._come, host, port, limit=_LONGEST))
        except OSError as error:
            self._loop.close()
            raise UserError(f"cannot listen at {host}:{port}: {error.strerror or error}; pass another --port") from None
        self.port = self._server.sockets[0].getsockname()[1]
        name = socket.gethostname() if host in ("0.0.0.0", "::", "") else host
        self.url = f"http://{name}:{self.port}/?token={self.token}"
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends all connections."""
        asyncio.run_coroutine_threadsafe(self._end(), self._loop).result(timeout=5)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(timeout=5)
        self._loop.close()

    async def _end(self) -> None:
        self._server.close()
        open_ones = asyncio.all_tasks() - {asyncio.current_task()}
        for task in open_ones:
            task.cancel()
        await asyncio.gather(*open_ones, return_exceptions=True)

    async def _come(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError):
            try:
                head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), timeout=10)
                if self._knows(_cookie(head)):
                    await self._through(head, reader, writer)
                elif self._knows(_query(head)):
                    cookie = f"{_COOKIE}={self.token}; HttpOnly; SameSite=Strict; Path=/"
                    answer = f"HTTP/1.1 303 See Other\r\nLocation: /\r\nSet-Cookie: {cookie}\r\nContent-Length: 0\r\n"
                    writer.write(f"{answer}Connection: close\r\n\r\n".encode())
                else:
                    text = b"Open the address that the program printed, with its token.\n"
                    writer.write(_REFUSED % (len(text), text))
                await writer.drain()
            except TimeoutError:
                pass
            finally:
                writer.close()

    def _knows(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self.token.encode())

    async def _through(self, head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        inner, outer = await asyncio.open_connection("127.0.0.1", self._behind)
        outer.write(head)
        try:
            ways = [asyncio.create_task(_pump(reader, outer)), asyncio.create_task(_pump(inner, writer))]
            await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            for way in ways:
                way.cancel()
        finally:
            outer.close()


async def _pump(source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
    while data := await source.read(1 << 16):
        sink.write(data)
        await sink.drain()


def _lines(head: bytes) -> list[str]:
    return head.decode("latin-1").split("\r\n")


def _query(head: bytes) -> str:
    target = _lines(head)[0].split(" ")[1:2]
    return urllib.parse.parse_qs(urllib.parse.urlsplit("".join(target)).query).get("token", [""])[0]


def _cookie(head: bytes) -> str:
    for line in _lines(head)[1:]:
        name, _, value = line.partition(":")
        if name.lower() == "cookie":
            with contextlib.suppress(http.cookies.CookieError):
                found = http.cookies.SimpleCookie(value).get(_COOKIE)
                return found.value if found else ""
    return ""
