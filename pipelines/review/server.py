"""A review over HTTP: recordings with their labels, and the file of corrections, which is its only state.

An action is checked, the scene is solved again, the file is written whole, and then it is answered. Every action names
the version of the file that its page has seen: one that another page has changed since is refused.

    answer  {"version": of the file, "corrections": [{"number": of the line, "record", "problem": why it does not hold
             or ""}] of the scene, "rows": [row of review.csv] of the scene, "scene": parts of the page's data}

The server is on 127.0.0.1, for pages that know its token.

    GET  /TOKEN/                   the page
    GET  /TOKEN/state?scene=NAME   the answer for a scene
    GET  /TOKEN/points?scene=NAME&moment=K&x=X&y=Y   LiDAR points near a place, m
    POST /TOKEN/correct            {"version", "correction": RECORD}
    POST /TOKEN/undo               {"version", "scene"}

Every error is {"error": one line} with its status: 400 a broken request, 403 without the token or by another name of
the host (DNS rebinding), 404, 405 neither GET nor POST, 409 the corrections were changed elsewhere, 411, 413, 415, 422
an action that can't be done.
"""

import csv
import hashlib
import hmac
import json
import logging
import math
import secrets
import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs, urlsplit

import numpy as np

from data_tools.datasets.corrections import (
    check_classes,
    correction_lines,
    corrections_of_lines,
    write_correction_lines,
)
from data_tools.files import open_text, parsed_json
from data_tools.metrics import SceneBoxes
from pipelines.report import Report, ReportScene, report_page, scene_data, with_surroundings
from pipelines.review.exchange import LabelRun, ego_points, labelled_scenes
from pipelines.smoothing import label_model
from pipelines.tracking import one_thread, scene_with_frames
from saga_fg.errors import InputError, SagaError, error_context, unknown_name
from saga_fg.numerics import transform_points
from saga_fg.smoothing import Correction, LabelBuilder, Review, correction_from, corrections_in
from saga_fg.types import DEFAULT, MAX_POSITION, Scene

CORRECTIONS = "corrections.jsonl"  # in the folder of labels
CHANGED = ("labels", "methods", "detections")  # parts of a scene's data that follow from its classes and labels
LABELS = "labels"  # the name of labels as a method
BESIDE = 12.0  # m around a box, in which the points of a scan are shown
SPACING = 0.05  # m, to which they are thinned


class ChangedElsewhereError(InputError):
    """Another page has changed the corrections; status: as HTTP has it."""

    status = HTTPStatus.CONFLICT


class ReviewSession:
    """The review of a folder of labels. Safe to call from several threads.

    file   of corrections, which may not be there yet
    who    their author

    Raises `InputError` where the recordings, the labels or the file of corrections can't be read.
    """

    def __init__(self, folder: Path, run: LabelRun, file: Path, who: str = "", images: int = 0) -> None:
        self.folder, self.file, self._run, self._who = folder, file, run, who
        self._lock = threading.Lock()
        self._builders: dict[str, LabelBuilder] = {}
        self._answers: dict[str, tuple[Sequence[Correction], dict[str, Any]]] = {}  # the latest, by scene
        with error_context(f"{folder}: its recordings ({run.dataset}) are needed"), run.open() as (source, dataset):
            scenes = {name: scene_with_frames(dataset, name) for name in dataset.scenes}
        shown = [_shown(found.scene, found.found, found.coasting, run) for found in labelled_scenes(folder, scenes)]
        self._shown = {each.scene.name: each for each in with_surroundings(source, shown, images)}
        self._scans = source.surroundings({name: each.scene for name, each in self._shown.items()}).scans()
        self._classes = source.written.classes
        self._title = f"Review of {folder.name}: {source}"
        corrections_of_lines(self._lines(), file)

    def page(self, server: bool) -> str:
        """The page, which sends its corrections to the server it came from, or keeps them to be saved as a file."""
        classes = Counter(dict.fromkeys(self._run.config.tracking.tracker.classes, 0))
        classes.update(label for each in self._shown.values() for label in each.tracks[LABELS].boxes.label.tolist())
        review = {
            "server": server,
            "who": self._who,
            "file": self.file.name,
            "folder": str(self.folder),
            "classes": [label for label, _ in classes.most_common() if label != DEFAULT],
            "scanned": list(self._scans) if server else [],
            "rows": [row for row in _listed(self.folder) if row.get("scene") in self._shown],
        }
        names = ", ".join([*self._shown][:3]) + ", ..." * (len(self._shown) > 3)
        facts = [names, f"{sum(len(each.scene) for each in self._shown.values())} moments"]
        return report_page(Report(self._title, facts, list(self._shown.values()), ghosts=True, review=review))

    def state(self, scene: str) -> dict[str, Any]:
        """The answer for a scene as corrected so far. Raises `InputError` for an unknown one."""
        with self._lock:
            return self._answer(scene, self._lines())

    def correct(self, version: str, record: Any) -> dict[str, Any]:
        """Add a correction, which has to name its scene, to the file.

        Raises `ChangedElsewhereError`, and `InputError` for one that is broken or does not hold; the file is unchanged.
        """
        with self._lock:
            lines, one = self._lines(version), correction_from(record, "correction")
            check_classes([one], self._classes)
            lines.append(json.dumps(record, allow_nan=False))
            answer = self._answer(one.scene, lines)
            if problem := answer["corrections"][-1]["problem"]:
                raise InputError(f"{one}: {problem}")
            write_correction_lines(self.file, lines)
            return answer

    def undo(self, version: str, scene: str) -> dict[str, Any]:
        """Take back the last correction of a scene, and answer. Raises `InputError` where there is none."""
        with self._lock:
            lines = self._lines(version)
            mine = corrections_in(scene, corrections_of_lines(lines, self.file))
            if not mine:
                raise InputError(f"undo: there is no correction of scene {scene} to take back")
            del lines[_line(mine[-1])]
            answer = self._answer(scene, lines)
            write_correction_lines(self.file, lines)
            return answer

    def points(self, scene: str, moment: int, x: float, y: float) -> list[list[int]]:
        """Points of the LiDAR's scan of a moment near a place (m), in cm about the scene's start; none without a scan.

        Raises `InputError` for a moment that the scene has not.
        """
        known = self._known(scene).scene
        if not 0 <= moment < len(known):
            raise InputError(f"moment: expected 0 to {len(known) - 1}, got {moment}")
        with self._lock:
            points = ego_points(self._scans.get(scene), float(known.timestamps[moment]))
        places = transform_points(known.world_T_ego[moment], points)[:, :2]
        near = places[np.hypot(*(places - [x, y]).T) < BESIDE] - known.world_T_ego[0, :2, 3]
        cells = np.unique(np.rint(near / SPACING), axis=0)
        thinned: list[list[int]] = np.rint(100 * SPACING * cells).astype(np.int64).tolist()
        return thinned

    def _lines(self, version: str | None = None) -> list[str]:
        """The lines of the file. Raises `ChangedElsewhereError` where they are not of this version."""
        lines = correction_lines(self.file)
        if version not in (None, _version(lines)):
            raise ChangedElsewhereError("the corrections were changed in another window: look again, and repeat")
        return lines

    def _known(self, scene: str) -> ReportScene:
        if scene not in self._shown:
            raise InputError(unknown_name("scene", scene, tuple(self._shown)))
        return self._shown[scene]

    def _answer(self, name: str, lines: Sequence[str]) -> dict[str, Any]:
        """The answer for a scene; it is solved again if its corrections are others than before."""
        scene, corrections = self._known(name).scene, corrections_in(name, corrections_of_lines(lines, self.file))
        if name not in self._answers or self._answers[name][0] != corrections:
            if name not in self._builders:
                self._builders[name] = _solved(scene, self._run)
            builder = self._builders[name]
            with one_thread():
                labels, _ = builder.corrected(corrections)
            tracks = [moment.tracks for part in labels for moment in part]
            coasting = np.concatenate([np.empty(0), *(each.coasting for each in tracks)])
            data = scene_data(_shown(scene, SceneBoxes.of_tracks(tracks), coasting, self._run))
            told = [
                {"number": _line(one) + 1, "record": parsed_json(lines[_line(one)], one.origin), "problem": why}
                for one, why in builder.outcomes
            ]
            changed = {part: data[part] for part in CHANGED}
            answer = {"corrections": told, "rows": _rows(name, labels.review()), "scene": changed}
            self._answers[name] = corrections, answer
        return {"version": _version(lines), **self._answers[name][1]}


def _solved(scene: Scene, run: LabelRun) -> LabelBuilder:
    """A scene solved whole, without corrections."""
    builder = LabelBuilder(run.config.tracking.new_tracker(run.method), label_model(run.config, run.method))
    with one_thread():
        builder.add(scene.frames, scene.timestamps)
        builder.finish()
    return builder


def _line(one: Correction) -> int:
    """Index of a correction's line in its file."""
    return int(one.origin.rpartition(" ")[2]) - 1


def _version(lines: Sequence[str]) -> str:
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:16]


def _shown(scene: Scene, found: SceneBoxes, coasting: Any, run: LabelRun) -> ReportScene:
    """A scene with labels; without edges, which take long to find."""
    bare = replace(scene, ground_truth=None)
    return ReportScene(bare, {LABELS: found}, {LABELS: coasting}, (), run.config.tracking.sensors)


def _listed(folder: Path) -> list[dict[str, str]]:
    """The rows of review.csv, or of the tables of a parallel run, as texts."""
    rows: list[dict[str, str]] = []
    for table in [*folder.glob("review.csv"), *sorted((folder / "review").glob("*.csv"))]:
        with open_text(table, newline="") as file:
            rows += csv.DictReader(file)
    return rows


def _rows(scene: str, review: Review) -> list[dict[str, Any]]:
    """The rows of a scene."""
    columns = {name: np.asarray(column).tolist() for name, column in review.table_columns().items()}
    return [{"scene": scene, **dict(zip(columns, row, strict=True))} for row in zip(*columns.values(), strict=True)]


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
