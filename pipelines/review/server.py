"""The server of a review: HTTP on 127.0.0.1, for pages that know its token.

    GET  /TOKEN/                   the page
    GET  /TOKEN/state?scene=NAME   the answer for a scene (`pipelines.review.session`)
    GET  /TOKEN/points?scene=NAME&moment=K&x=X&y=Y   LiDAR points near a place, m
    POST /TOKEN/correct            {"version", "correction": RECORD}
    POST /TOKEN/undo               {"version", "scene"}

Every error is {"error": one line} with its status: 400 a broken request, 403 without the token or by another name of
the host (DNS rebinding), 404, 405 neither GET nor POST, 409 the corrections were changed elsewhere, 411, 413, 415, 422
an action that can't be done.
"""

import hmac
import json
import logging
import math
import secrets
from collections.abc import Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any
from urllib.parse import parse_qs, urlsplit

from data_tools.files import parsed_json
from pipelines.review.session import ReviewSession
from saga_fg.errors import InputError, SagaError
from saga_fg.types import MAX_POSITION

LARGEST = 65536  # bytes of a request's body
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

log = logging.getLogger(__name__)


class _RefusedError(Exception):
    """A request that is answered with a status and a reason."""

    def __init__(self, status: HTTPStatus, reason: str) -> None:
        super().__init__(reason)
        self.status = status


class ReviewServer(ThreadingHTTPServer):
    """Serves a session at `url` until `shutdown`. Raises `InputError` for a port that is not free."""

    daemon_threads = True

    def __init__(self, session: ReviewSession, port: int = 0) -> None:
        self.session, self.token = session, secrets.token_urlsafe(16)
        try:
            super().__init__(("127.0.0.1", port), _Handler)
        except (OSError, OverflowError) as error:
            raise InputError(f"--port {port}: cannot be used: {getattr(error, 'strerror', None) or error}") from error

    @property
    def url(self) -> str:
        """The address of the page, with the token."""
        return f"http://127.0.0.1:{self.server_port}/{self.token}/"

    def handle_error(self, request: Any, client_address: Any) -> None:
        """A connection that broke is no error of the server."""
        log.debug("connection broken", exc_info=True)


class _Handler(BaseHTTPRequestHandler):
    server: ReviewServer
    server_version, sys_version = "saga-fg", ""
    timeout = 10.0  # s, of a client that sends nothing

    def do_GET(self) -> None:
        self._answer()

    do_POST = do_GET

    def send_error(self, code: int, message: str | None = None, explain: str | None = None) -> None:
        """Answer requests that are no HTTP, or of another method."""
        status = HTTPStatus.METHOD_NOT_ALLOWED if code == HTTPStatus.NOT_IMPLEMENTED else HTTPStatus(code)
        self._send(status, {"error": message or status.phrase})

    def log_message(self, format: str, *args: Any) -> None:  # noqa: A002 (the name in the base class)
        log.debug(format, *args)

    def _answer(self) -> None:
        try:
            content: Any = self._content()
            status = HTTPStatus.OK
        except (_RefusedError, SagaError) as error:
            status, content = getattr(error, "status", HTTPStatus.UNPROCESSABLE_ENTITY), {"error": str(error)}
        except OSError:  # the connection broke
            raise
        except Exception as error:  # the page has to say so, and the file is as before
            log.exception("request failed")
            status, content = HTTPStatus.INTERNAL_SERVER_ERROR, {"error": f"{type(error).__name__}: {error}"}
        self._send(status, content)

    def _content(self) -> Any:
        """The answer to the request."""
        hosts = {f"{name}:{self.server.server_port}" for name in ("127.0.0.1", "localhost")}
        host, origin = self.headers.get("Host", ""), self.headers.get("Origin")
        if host not in hosts or origin not in (None, f"http://{host}"):
            raise _RefusedError(HTTPStatus.FORBIDDEN, "expected a request by 127.0.0.1 or localhost, from its own page")
        try:
            url, session = urlsplit(self.path), self.server.session
        except ValueError as error:  # an IPv6 address without its bracket
            raise _RefusedError(HTTPStatus.BAD_REQUEST, f"expected an address: {error}") from error
        _, token, name, *deeper = f"{url.path}//".split("/")
        if not hmac.compare_digest(token.encode(), self.server.token.encode()):
            raise _RefusedError(HTTPStatus.FORBIDDEN, "expected the address that saga-fg review printed")
        asked = {key: values[0] for key, values in parse_qs(url.query).items()}
        match self.command, name, any(deeper):
            case "GET", "", False:
                return session.page(server=True)
            case "GET", "state", False:
                return session.state(asked.get("scene", ""))
            case "GET", "points", False:
                moment, x, y = (_number(asked, key) for key in ("moment", "x", "y"))
                return session.points(asked.get("scene", ""), int(moment), x, y)
            case "POST", "correct", False:
                body = self._body()
                return session.correct(_text(body, "version"), body.get("correction"))
            case "POST", "undo", False:
                body = self._body()
                return session.undo(_text(body, "version"), _text(body, "scene"))
        raise _RefusedError(HTTPStatus.NOT_FOUND, "expected GET state or points, POST correct or undo")

    def _body(self) -> dict[str, Any]:
        """The body of the request, an object of JSON."""
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdigit()):
            raise _RefusedError(HTTPStatus.LENGTH_REQUIRED, "expected Content-Length")
        if len(length) > len(str(LARGEST)) or int(length) > LARGEST:
            raise _RefusedError(HTTPStatus.REQUEST_ENTITY_TOO_LARGE, f"expected a request of at most {LARGEST} bytes")
        if self.headers.get_content_type() != "application/json":
            raise _RefusedError(HTTPStatus.UNSUPPORTED_MEDIA_TYPE, "expected Content-Type: application/json")
        try:
            body = parsed_json(self.rfile.read(int(length)), "request")
        except InputError as error:
            raise _RefusedError(HTTPStatus.BAD_REQUEST, str(error)) from error
        if not isinstance(body, dict):
            raise _RefusedError(HTTPStatus.BAD_REQUEST, f"request: expected an object, got {type(body).__name__}")
        return body

    def _send(self, status: HTTPStatus, content: Any) -> None:
        page = isinstance(content, str)
        raw = (content if page else json.dumps(content, allow_nan=False)).encode()
        self.send_response(status)
        self.send_header("Content-Type", "text/html; charset=utf-8" if page else "application/json")
        self.send_header("Content-Length", str(len(raw)))
        for name, value in HEADERS.items():
            self.send_header(name, value)
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(raw)


def _number(asked: Mapping[str, str], name: str) -> float:
    try:
        number = float(asked.get(name, ""))
    except ValueError:
        number = math.nan
    if not abs(number) <= MAX_POSITION:
        raise _RefusedError(HTTPStatus.BAD_REQUEST, f"{name}: expected a number, got {asked.get(name, '')!r:.40}")
    return number


def _text(body: Mapping[str, Any], name: str) -> str:
    value = body.get(name)
    if not isinstance(value, str):
        raise _RefusedError(HTTPStatus.BAD_REQUEST, f"request: {name}: expected a text, got {value!r:.40}")
    return value
