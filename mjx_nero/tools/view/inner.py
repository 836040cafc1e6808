"""viser's server, which only the door can reach and which reads only checked messages."""

import asyncio
import contextlib
import functools
import io
import pathlib
import shutil
import tempfile
from collections.abc import Callable, Iterator
from typing import Any

import viser
import websockets.asyncio.server as ws
from viser import _messages
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from mjx_nero.tools.view import gamepad, messages
from mjx_nero.tools.view.gamepad import Gamepad
from mjx_nero.tools.view.log import LOG
from mjx_nero.types import UserError

REST_S = 1 / 200  # minimum time between two messages of a page, which sends 20 per second while something is dragged
FRAGMENTS = 16  # maximum number of fragments of a message
_TOO_BIG = 1009  # a close code of websockets


class Inner:
    """A ``viser.ViserServer`` behind a Unix socket, in a folder that only this user can enter (mode 0700).

    viser itself listens on a port of this machine, which every user of it can reach, and so can every web page that one of them
    has open. A secret added by the door would also work, but it would have to be compared in viser's handshake and kept out of
    its log. The kernel enforces a folder's mode.

    Attributes:
        server: viser's server.
        path: path of the socket.
        gamepad: handles the gamepad states that pages send.

    Raises:
        UserError: this version of viser listens in another way.
    """

    def __init__(self) -> None:
        self.gamepad: Gamepad | None = None  # set later; until then its messages are ignored
        self._folder = pathlib.Path(tempfile.mkdtemp(prefix="mjx_nero_view_"))
        self.path = self._folder / "page"
        listening = _listening_at(self.path, self._read, self._hear_gamepad)
        with listening, contextlib.redirect_stdout(io.StringIO()):  # viser prints its address
            self.server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
        if not self.path.is_socket():
            self.close()
            raise UserError(f"viser {viser.__version__} is not supported: install the version that constraints.txt names")
        # With these messages a page could open a tunnel to a public address, past the door: ignore them.
        for share in (_messages.ShareUrlRequest, _messages.ShareUrlDisconnect):
            self.server._websock_server.unregister_handler(share)
        self.server._event_loop.set_exception_handler(tell)

    def close(self) -> None:
        """Ends the server."""
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints that it stops
            self.server.stop()
        shutil.rmtree(self._folder, ignore_errors=True)

    def _read(self, raw: bytes) -> bytes | None:
        """Returns the message for viser; None if viser must not see it."""
        try:
            return messages.checked(raw, self.server)
        except ValueError as error:
            LOG.warning("a message was ignored: %s", error)
            return None

    def _hear_gamepad(self, raw: bytes) -> None:
        if self.gamepad:
            self.gamepad.hear(raw)


def tell(_: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    """Logs errors of an event loop that no caller would see, at a limited rate."""
    LOG.warning("a connection failed: %s", context.get("exception") or context["message"])


@contextlib.contextmanager
def _listening_at(
    path: pathlib.Path, read: Callable[[bytes], bytes | None], hear_gamepad: Callable[[bytes], None]
) -> Iterator[None]:
    """Makes a viser server that starts in this context listen on ``path``. viser itself accepts only a host and a port."""
    original, version = ws.serve, f"viser-v{viser.__version__}"

    def serve(handler, host, port, **kwargs):
        async def handle(connection: Any) -> None:
            if getattr(connection.request, "path", "") != gamepad.PATH:
                return await handler(connection)
            connection.read = hear_gamepad  # it returns None, so recv ends only with the connection
            with contextlib.suppress(ConnectionClosed):
                await connection.recv()

        kwargs.update(
            create_connection=functools.partial(_Connection, read=read),
            max_size=messages.LONGEST,
            subprotocols=[version],
            select_subprotocol=None,  # a client that does not name it gets 400
            process_response=_guard,
            open_timeout=10,
            close_timeout=2,
            logger=LOG,
        )
        return original(handle, unix=True, path=str(path), **kwargs)

    ws.serve = serve  # type: ignore[assignment,misc]
    try:
        yield
    finally:
        ws.serve = original  # type: ignore[misc]


def _guard(connection: ws.ServerConnection, request: Request, response: Response) -> None:
    """Lets the page talk only to its own address, and forbids other pages to embed it."""
    own = "'self' 'unsafe-inline' 'unsafe-eval' data: blob:"
    socket = f"ws://{request.headers.get('Host', '')}"
    response.headers["Content-Security-Policy"] = (
        f"default-src {own}; connect-src {own} {socket}; frame-ancestors 'none'; base-uri 'none'; form-action 'none'"
    )
    response.headers["X-Frame-Options"] = "DENY"
    response.headers["Cross-Origin-Opener-Policy"] = "same-origin"
    response.headers["Cross-Origin-Resource-Policy"] = "same-origin"
    response.headers["Referrer-Policy"] = "no-referrer"
    response.headers["Cache-Control"] = "no-store"
    if response.headers.get("Content-Type", "").startswith("text/html"):
        response.body = gamepad.with_script(bytes(response.body))
        del response.headers["Content-Length"]
        response.headers["Content-Length"] = str(len(response.body))


class _Connection(ws.ServerConnection):
    """A page's connection that passes its messages through ``read``, at a limited rate."""

    def __init__(self, *args: Any, read: Callable[[bytes], bytes | None], **kwargs: Any):
        super().__init__(*args, **kwargs)
        self.read = read

    async def recv(self, decode: bool | None = None) -> Any:
        while True:
            await asyncio.sleep(REST_S)
            fragments: list[bytes] = []
            async for fragment in self.recv_streaming(decode=False):
                fragments.append(fragment)
                if len(fragments) > FRAGMENTS:  # a size limit does not stop empty fragments
                    await self.close(_TOO_BIG)
                    raise self.protocol.close_exc
            message = self.read(b"".join(fragments))
            if message is not None:
                return message
