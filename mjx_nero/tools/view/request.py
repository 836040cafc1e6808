"""Parses the head of an HTTP request strictly: anything unusual is refused."""

import dataclasses
import re
import urllib.parse

LONGEST = 16384  # maximum bytes of a head
_MOST = 100  # maximum lines of a head
_FIRST = re.compile(r"GET (/[A-Za-z0-9._/-]*)(?:\?([!-~]*))? HTTP/1\.1")
_HEADER = re.compile(r"([!#$%&'*+.^_`|~0-9A-Za-z-]+):[ \t]*([\t -~\x80-\xff]*)")
_HOST = re.compile(r"(\[[0-9A-Fa-f:.]+\]|[A-Za-z0-9._-]+)(?::[0-9]{1,5})?")


@dataclasses.dataclass(frozen=True)
class Request:
    """A request for a page or for a websocket.

    Attributes:
        path: without the query.
        query: name -> value; no name appears twice.
        headers: name in lower case -> value.
        host: name or address that the client requested, without the port.
    """

    path: str
    query: dict[str, str]
    headers: dict[str, str]
    host: str

    @property
    def upgrades(self) -> bool:
        """Whether it asks for a websocket."""
        return "upgrade" in self.headers

    @property
    def own_origin(self) -> bool:
        """Whether it comes from a page of this address."""
        origin = self.headers.get("origin")
        return not self.upgrades if origin is None else origin.lower() == f"http://{self.headers['host'].lower()}"

    def cookie(self, name: str) -> str:
        """Returns the value of a cookie; empty if there is none."""
        pairs = (each.strip().partition("=") for each in self.headers.get("cookie", "").split(";"))
        return next((value for key, _, value in pairs if key == name), "")

    def head(self) -> bytes:
        """Returns the bytes of the request to pass on, without its query."""
        lines = [f"GET {self.path} HTTP/1.1", *(f"{name}: {value}" for name, value in self.headers.items())]
        return "\r\n".join([*lines, "", ""]).encode("latin-1")


def parse(head: bytes) -> Request:
    """Parses a request from its bytes, up to and including the empty line.

    Raises:
        ValueError: it is not a plain GET with one host, or it is malformed.
    """
    first, *lines = head.decode("latin-1").removesuffix("\r\n\r\n").split("\r\n")
    start, found = _FIRST.fullmatch(first), [_HEADER.fullmatch(line) for line in lines]
    if start is None or not all(found) or len(found) > _MOST:
        raise ValueError("not a plain request")
    headers = {line[1].lower(): line[2].strip() for line in found if line}
    host = _HOST.fullmatch(headers.get("host", ""))
    if host is None or len(headers) < len(lines):
        raise ValueError("a header twice, or no host")
    if {"content-length", "transfer-encoding"} & set(headers) or headers.get("upgrade", "websocket") != "websocket":
        raise ValueError("a body, or an upgrade to something else")
    pairs = urllib.parse.parse_qsl(start[2] or "", keep_blank_values=True, max_num_fields=4)
    if ".." in start[1] or len(dict(pairs)) < len(pairs):
        raise ValueError("an odd address")
    return Request(path=start[1], query=dict(pairs), headers=headers, host=host[1].lower())
