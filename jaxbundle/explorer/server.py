"""One page for one browser, from the loopback address.

The address contains a random token: without it another user of the machine, or a page of another
site that guesses the port, gets status 403; so does a request that the browser says comes from
another site (`Origin`), or for another host. A request must arrive within `REQUEST_TIMEOUT`. Bodies
are JSON of limited size. Errors of the view are returned as `{"error": …}`, one line, with status
400; program faults with status 500 and a line on the terminal.

| request | answer |
|---|---|
| `GET /TOKEN/` | the page |
| `POST /TOKEN/answer` | what follows from the values of the controls, JSON |
| `POST /TOKEN/save` | the page with these values, as a copy to keep |
| `POST /TOKEN/export/NAME` | a file of the view |
"""

import json
import math
import secrets
import socket
import threading
from collections.abc import Callable
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, NoReturn

from jaxbundle.errors import InputError, NotSolvedError
from jaxbundle.explorer.view import ExplorerView, File, Given
from jaxbundle.io.results.result_json import without_nan
from jaxbundle.report.page import write

HOST = "127.0.0.1"
# Maximum bytes of the body of a request: about 2000 stations of a network, moved, each an id and
# six numbers of up to 18 characters.
MOST_BYTES = 256 * 1024
# Seconds in which a request must arrive, all of it: a sender that trickles bytes must not hold a
# connection.
REQUEST_TIMEOUT = 30.0
METHODS = "GET, POST"
HTML, JSON = "text/html; charset=utf-8", "application/json"


class Refused(Exception):
    """A refused request: status and reason."""

    def __init__(self, status: HTTPStatus, why: str):
        super().__init__(why)
        self.status = status


class Server(ThreadingHTTPServer):
    """Serves a view at `address`, until `shutdown`; one request is computed at a time.

    **Arguments:** `port`: 0 for any that is free; `tell`: gets lines for the terminal.

    **Raises:** `InputError` where the port is taken.
    """

    daemon_threads = True

    def __init__(
        self, view: ExplorerView, port: int = 0, tell: Callable[[str], object] = lambda _: None
    ):
        self.view, self.tell = view, tell
        self.token = secrets.token_urlsafe(24)
        self.computing = threading.Lock()
        try:
            super().__init__((HOST, port), Handler)
        except (OSError, OverflowError) as error:
            why = getattr(error, "strerror", None) or error
            raise InputError(f"port {port} of {HOST} cannot be used: {why}") from None

    @property
    def address(self) -> str:
        """Where the page is."""
        return f"http://{HOST}:{self.server_port}/{self.token}/"

    def handle_error(self, *_: Any) -> None:
        """Ignore closed connections of the browser."""


class Handler(BaseHTTPRequestHandler):
    """One request."""

    server: Server
    server_version, sys_version = "jaxbundle", ""
    timeout = REQUEST_TIMEOUT

    def handle_one_request(self) -> None:
        """As usual, with a deadline for all that is read: `timeout` is that of one read."""
        self.deadline = threading.Timer(REQUEST_TIMEOUT, self._stop_reading)
        self.deadline.daemon = True
        self.deadline.start()
        try:
            super().handle_one_request()
        finally:
            self.deadline.cancel()

    def _stop_reading(self) -> None:
        try:
            self.connection.shutdown(socket.SHUT_RD)
        except OSError:
            pass  # closed meanwhile

    def __getattr__(self, name: str) -> Callable[[], None]:
        """Every other method is refused like any other request, not by the page of the library."""
        if name.startswith("do_"):
            return lambda: self._respond(_refuse_method, b"")
        raise AttributeError(name)

    def do_GET(self) -> None:
        """The page."""
        self._respond(self._get, b"")

    def do_POST(self) -> None:
        """The answer to values, or a file made from them."""
        length = self.headers.get("Content-Length", "")
        is_number = length.isascii() and length.isdigit() and len(length) < 10
        # Read before it is answered, or the browser would lose the answer; of an oversized one at
        # most 16 times what is allowed.
        expected = min(int(length), 16 * MOST_BYTES) if is_number else 0
        body = self.rfile.read(expected) if is_number else None
        if body is not None and len(body) < expected:
            return self._respond(_refuse_incomplete, b"")
        self._respond(self._post, body)

    def log_message(self, *_: Any) -> None:
        """Requests are not listed on the terminal."""

    def _respond(self, act: Callable[[str, bytes], File], body: bytes | None) -> None:
        self.deadline.cancel()
        try:
            action = self._action()
            if body is None:
                raise Refused(HTTPStatus.LENGTH_REQUIRED, "expected a body with its length")
            if len(body) > MOST_BYTES:
                raise Refused(
                    HTTPStatus.REQUEST_ENTITY_TOO_LARGE,
                    f"expected a body of at most {MOST_BYTES} bytes",
                )
            # A view has caches, and JAX uses all cores for one.
            with self.server.computing:
                file = act(action, body)
            status = HTTPStatus.OK
        except Refused as refused:
            status, file = refused.status, _error(refused)
        except (InputError, NotSolvedError) as error:
            status, file = HTTPStatus.BAD_REQUEST, _error(error)
        except Exception as error:
            self.server.tell(f"internal error: {type(error).__name__}: {_line(error)}")
            status, file = HTTPStatus.INTERNAL_SERVER_ERROR, _error(error)
        self.send_response(status)
        self.send_header("Content-Type", file.type)
        self.send_header("Content-Length", str(len(file.content)))
        for name, value in (
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
            ("Allow", METHODS),
        ):
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(file.content)

    def _action(self) -> str:
        """What the address names after the token.

        **Raises:** `Refused` without the token, and for another name of this machine: a site whose
        name leads here must not speak with it."""
        hosts = [f"{name}:{self.server.server_port}" for name in (HOST, "localhost")]
        hosts_given, origins = self.headers.get_all("Host", []), self.headers.get_all("Origin", [])
        if len(hosts_given) != 1 or hosts_given[0] not in hosts:
            raise Refused(HTTPStatus.FORBIDDEN, f"this page is served at {HOST} only")
        if any(origin not in [f"http://{host}" for host in hosts] for origin in origins):
            raise Refused(HTTPStatus.FORBIDDEN, "a page of another site may not ask")
        _, token, *path_after_token = [*self.path.partition("?")[0].split("/"), ""]
        # In constant time: how long it takes tells nothing about the token.
        if not secrets.compare_digest(token.encode(), self.server.token.encode()):
            raise Refused(
                HTTPStatus.FORBIDDEN, "the address is incomplete: copy all of it from the terminal"
            )
        return "/".join(path_after_token).rstrip("/")

    def _get(self, action: str, _: bytes) -> File:
        if action or not self.path.endswith("/"):
            raise Refused(HTTPStatus.NOT_FOUND, "the only page is at /TOKEN/")
        return page_file(self.server.view, {}, live=True)

    def _post(self, action: str, body: bytes) -> File:
        return respond(self.server.view, action, _parse(body))


def respond(view: ExplorerView, action: str, given: Given) -> File:
    """The reply of a view to the values of its page: `answer`, `save`, or `export/NAME`.

    **Raises:** `Refused` for anything else, and what the view raises."""
    if action == "answer":
        return _json(view.answer(given))
    if action == "save":
        return page_file(view, given, live=False)
    room, _, name = action.partition("/")
    if room == "export" and name:
        return view.export(name, given)
    raise Refused(HTTPStatus.NOT_FOUND, f"there is no {action:.100}")


def _parse(body: bytes) -> Given:
    """The values of a body, a JSON object."""
    try:
        given = json.loads(
            body, parse_constant=_no_number, parse_int=_whole_number, parse_float=_finite_number
        )
    except (ValueError, RecursionError) as error:
        raise InputError(f"the body is not JSON: {_line(error)}") from None
    if not isinstance(given, dict):
        raise InputError("the body must be an object of values by name")
    return given


def page_file(view: ExplorerView, given: Given, live: bool) -> File:
    """The page of a view with these values."""
    content = "".join(write(view.page(given, live)))
    return File("page.html", HTML, content.encode("utf-8", "replace"))


def _json(value: dict) -> File:
    text = json.dumps(without_nan(value), allow_nan=False)
    return File("answer.json", JSON, text.encode())


def _error(error: Exception) -> File:
    return _json({"error": _line(error)})


def _line(error: Exception) -> str:
    return " ".join(str(error).split())[:1000] or type(error).__name__


def _no_number(word: str) -> NoReturn:
    raise ValueError(f"{word} is not a JSON number")


def _finite_number(word: str) -> float:
    if not math.isfinite(number := float(word)):
        raise ValueError(f"{word[:20]}… is larger than any number of 64 bits")
    return number


def _whole_number(word: str) -> int:
    _finite_number(word)
    return int(word)


def _refuse_method(_: str, __: bytes) -> File:
    raise Refused(HTTPStatus.METHOD_NOT_ALLOWED, f"expected one of the methods {METHODS}")


def _refuse_incomplete(_: str, __: bytes) -> File:
    raise Refused(HTTPStatus.REQUEST_TIMEOUT, "the body ended before its announced length")
