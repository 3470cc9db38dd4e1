"""The page and its arrays over HTTP, for browsers on this machine."""

import errno
import ipaddress
import json
import re
import socket
import sys
import traceback
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from typing import Any, NamedTuple
from urllib.parse import parse_qs, urlsplit

import numpy as np

from stereokit.errors import ConfigError, InputError, StereoKitError
from stereokit.viewer.desk import Desk, Gone
from stereokit.viewer.packing import with_head
from stereokit.viewer.standalone import PAGE_FILES

__all__ = ["PORT", "ViewServer", "host_is_allowed"]

PORT = 8765
"""Where the page is served unless told otherwise."""

_TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript"}
_HEADERS = {
    "Content-Security-Policy": "default-src 'self'; img-src 'self' blob: data:; frame-ancestors 'none'",
    "Cross-Origin-Resource-Policy": "same-origin",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cache-Control": "no-store",
}


class Answer(NamedTuple):
    """What a request gets."""

    content: bytes
    type: str = "application/octet-stream"
    status: int = 200
    name: str | None = None
    """Of the file that the browser saves."""


class _Refused(Exception):
    """A request that is not answered; the message is one line."""

    def __init__(self, status: int, message: str) -> None:
        super().__init__(message)
        self.status = status


class ViewServer(ThreadingHTTPServer):
    """Serves the viewer's page.

    Args:
        desk: what is shown.
        host: the address to listen on; 127.0.0.1 is for browsers on this machine alone.
        port: 0 for any that is free.

    Raises:
        InputError: the port is in use or may not be used, or the host is none of this machine.

    >>> from stereokit.data.pairs import ImagePair
    >>> from stereokit.viewer.sources import Album
    >>> from pathlib import Path
    >>> desk = Desk(Album([ImagePair("a", Path("l.png"), Path("r.png"))], [Path("d.npz")]))
    >>> with ViewServer(desk, port=0) as server:
    ...     server.url.startswith("http://127.0.0.1:")
    True
    """

    daemon_threads = True
    block_on_close = False

    def __init__(self, desk: Desk, host: str = "127.0.0.1", port: int = PORT) -> None:
        self.desk = desk
        self.host = host
        if ":" in host:
            self.address_family = socket.AF_INET6
        try:
            super().__init__((host, port), _Handler)
        except OverflowError as error:
            raise InputError(f"port {port} is none; expected 0 to 65535") from error
        except OSError as error:
            raise InputError(_reason(error, host, port)) from error

    @property
    def url(self) -> str:
        """Where the page is."""
        shown = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{shown}:{self.server_address[1]}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A browser that went away is no error."""
        if not isinstance(sys.exc_info()[1], ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


def host_is_allowed(host: str | None, served: str) -> bool:
    """Whether a request's Host header names this machine.

    A page of another site can have its own name resolved to 127.0.0.1, and would read what is served here; its requests
    carry that name. Addresses in numbers can't be had resolved to others.

    Args:
        host: the header.
        served: the host that the server was told to listen on.

    >>> [host_is_allowed(host, "127.0.0.1") for host in ("127.0.0.1:8765", "localhost", "evil.example", None)]
    [True, True, False, False]
    """
    match = re.fullmatch(r"(\[[0-9a-fA-F:.]+\]|[\w.-]+)(:\d{1,5})?", host or "")
    if match is None:
        return False
    name = match[1].strip("[]").lower()
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return name in {"localhost", served.lower()} or (
            served in ("0.0.0.0", "::") and name.partition(".")[0] == socket.gethostname().lower().partition(".")[0]
        )
    return True


class _Handler(BaseHTTPRequestHandler):
    protocol_version = "HTTP/1.1"
    server_version = "stereokit"
    sys_version = ""
    timeout = 60
    server: ViewServer

    def do_GET(self) -> None:
        """Answers with a file of the page, facts, an image or an array."""
        self._answer(self._checked())

    def do_HEAD(self) -> None:
        """The same without content."""
        self._answer(self._checked())

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """What the base class refuses, in our words."""
        if code == 501:
            self.close_connection = True
            self._answer(_refusal(405, f"the method {self.command[:20]} is not known here; use GET"))
            return
        self.close_connection = True
        self._answer(_refusal(code, message or "this request can't be understood"))

    def log_message(self, format: str, *args: Any) -> None:
        """Requests are not worth a line."""

    def _checked(self) -> Answer:
        if not host_is_allowed(self.headers.get("Host"), self.server.host):
            return _refusal(403, "the Host header names another machine; open the page by the address that was printed")
        try:
            parts = urlsplit(self.path)
            query = {key: values[-1] for key, values in parse_qs(parts.query, max_num_fields=8).items()}
        except ValueError:
            return _refusal(400, "the address can't be understood")
        if self.headers.get("Sec-Fetch-Site") == "cross-site" and parts.path != "/":
            return _refusal(403, "another site asked for this; open the page itself")
        try:
            return _route(self.server.desk, parts.path, query)
        except _Refused as refused:
            return _refusal(refused.status, str(refused))
        except Gone as error:
            return _refusal(410, str(error))
        except StereoKitError as error:
            return _refusal(422, str(error))
        except Exception:
            if self.server.desk.closed:
                return _refusal(503, "the viewer is ending")
            traceback.print_exc()
            return _refusal(500, "an error of the viewer itself; its output has the details")

    def _answer(self, answer: Answer) -> None:
        self.send_response(answer.status)
        self.send_header("Content-Type", answer.type)
        self.send_header("Content-Length", str(len(answer.content)))
        for name, value in _HEADERS.items():
            self.send_header(name, value)
        if answer.name is not None:
            self.send_header("Content-Disposition", f'attachment; filename="{answer.name}"')
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(answer.content)


def _route(desk: Desk, path: str, query: dict[str, str]) -> Answer:
    name = path.removeprefix("/") or "index.html"
    if name in PAGE_FILES:
        # by name from a list, and no path into the file system
        content = files("stereokit.viewer").joinpath("page").joinpath(name).read_bytes()
        return Answer(content, f"{_TYPES[name[name.rindex('.') :]]}; charset=utf-8")
    if path == "/facts":
        return _json(desk.facts())
    if path == "/entry":
        return _json(_wanted(lambda: desk.entry(_number(query, "index"))).facts())
    if path == "/next":
        shot = _wanted(lambda: desk.next(_number(query, "after", least=-1)))
        return Answer(with_head({"ended": True}) if shot is None else shot.packed())
    match = re.fullmatch(r"/shot/(\d{1,12})/(\w+)", path)
    if match is None or match[2] not in _PARTS:
        raise _Refused(404, f"there is nothing at {path[:80]!r}")
    return _PARTS[match[2]](desk, int(match[1]), query)


def _view(desk: Desk, number: int, view: str) -> Answer:
    return Answer(*desk.shot(number).image_bytes(view))


def _confidence(desk: Desk, number: int, query: dict[str, str]) -> Answer:
    content = desk.shot(number).confidence_bytes()
    if content is None:
        raise _Refused(404, "this result has no confidence")
    return Answer(content)


def _distribution(desk: Desk, number: int, query: dict[str, str]) -> Answer:
    """float32, little-endian: expectation, spread, then disparity, probability and kept (0 or 1) of each candidate."""
    found = _wanted(lambda: desk.distribution(number, _number(query, "x"), _number(query, "y")))
    rows = np.stack([found.disparities[0], found.probabilities[0], found.kept[0].astype(np.float32)], axis=1)
    values = np.concatenate([[found.expectation[0], found.spread[0]], rows.ravel()])
    return Answer(values.astype("<f4").tobytes())


def _archive(desk: Desk, number: int, query: dict[str, str]) -> Answer:
    shot = desk.shot(number)
    more = {}
    if desk.calibration is not None:
        more["calibration.json"] = (json.dumps(desk.calibration.to_dict(), indent=2) + "\n").encode()
    name = re.sub(r"[^A-Za-z0-9_.-]+", "_", shot.name).strip("._") or "frame"
    return Answer(shot.archive(more), "application/zip", name=f"{name[:100]}.zip")


_PARTS: dict[str, Callable[[Desk, int, dict[str, str]], Answer]] = {
    "left": lambda desk, number, query: _view(desk, number, "left"),
    "right": lambda desk, number, query: _view(desk, number, "right"),
    "disparity": lambda desk, number, query: Answer(desk.shot(number).disparity_bytes()),
    "confidence": _confidence,
    "occluded": lambda desk, number, query: Answer(_wanted(lambda: desk.occluded(number)).astype(np.uint8).tobytes()),
    "distribution": _distribution,
    "archive": _archive,
}
"""What of a shot can be asked for."""


def _number(query: dict[str, str], name: str, least: int = 0) -> int:
    text = query.get(name, "")
    if not re.fullmatch(r"-?\d{1,12}", text, re.ASCII) or int(text) < least:
        raise _Refused(400, f"expected {name} as a whole number from {least}, got {text[:40]!r}")
    return int(text)


def _wanted(find: Callable[[], Any]) -> Any:
    """What can't be had here is no fault of the request."""
    try:
        return find()
    except ConfigError as error:
        raise _Refused(404, str(error)) from error


def _json(values: dict[str, Any]) -> Answer:
    return Answer(json.dumps(values).encode(), "application/json")


def _refusal(status: int, message: str) -> Answer:
    return Answer(message.encode("utf-8", "replace"), "text/plain; charset=utf-8", status)


def _reason(error: OSError, host: str, port: int) -> str:
    if error.errno == errno.EADDRINUSE:
        return f"port {port} is in use; choose another with --port, or 0 for any that is free"
    if error.errno == errno.EACCES:
        return f"port {port} may not be used by this user; choose one from 1024 up with --port"
    return f"the page can't be served at {host}: {error.strerror or error}; --host is an address of this machine"
