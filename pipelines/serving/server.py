"""A service on a TCP or Unix socket or on standard input, one tracker, stopped within bounded time.

A service on a TCP or Unix socket: any number of clients, one tracker.

    clients --lines--> worker thread: the stream --answers--> clients

Each client has a task that reads its lines and gives the worker one at a time. So clients take turns line by line, and
a flood waits in the socket of its sender. Long lines have a tenth of the worker's time while short ones wait: a few
megabytes of JSON take longer to read than many frames. The event loop is never in the tracker: it accepts, reads and
sends while a frame is worked on. A client that does not read its answers delays nobody and is dropped.
"""

import asyncio
import errno
import logging
import os
import queue
import resource
import select
import signal
import socket
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import FrameType, TracebackType
from typing import IO, Any, Self, cast

from pipelines.serving.messages import LineSplitter, encode
from pipelines.serving.settings import Address, LogLimit
from pipelines.serving.stream import StreamTracker
from saga_fg.errors import InputError

SAVING = 1.0  # s


class StopRequest:
    """A context in which SIGINT and SIGTERM do not interrupt but request to stop; `number`: of the first signal.

    timeout  time to finish, s; then the process ends in spite of its other threads
    save     called before that end, for at most `SAVING` s
    clear    called last, to remove unfinished files
    """

    def __init__(
        self, timeout: float, save: Callable[[], object] = lambda: None, clear: Callable[[], object] = lambda: None
    ) -> None:
        self.number: int | None = None
        self._timeout = timeout
        self._save = save
        self._clear = clear
        self._callbacks: list[Callable[[], object]] = []
        self._requests: queue.SimpleQueue[int] = queue.SimpleQueue()  # a signal handler may put into this kind
        self._finished = threading.Event()
        self._before: dict[int, object] = {}

    def notify(self, callback: Callable[[], object]) -> None:
        """Call `callback` on a request to stop, in a signal handler; at once if there was one."""
        self._callbacks.append(callback)
        if self.number is not None:
            callback()

    def __enter__(self) -> Self:
        threading.Thread(target=self._watch, name="stop", daemon=True).start()
        for number in (signal.SIGINT, signal.SIGTERM):
            self._before[number] = signal.signal(number, self._request)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._finished.set()
        self._requests.put(0)
        for number, before in self._before.items():
            signal.signal(number, before)  # type: ignore[arg-type]

    def _request(self, number: int, frame: FrameType | None) -> None:
        if self.number is None:
            self.number = number
            self._requests.put(number)
            for callback in self._callbacks:
                callback()

    def _watch(self) -> None:
        number = self._requests.get()
        if not self._finished.wait(self._timeout):
            saving = threading.Thread(target=self._save, daemon=True)
            with suppress(Exception):
                saving.start()
                saving.join(SAVING)
            with suppress(Exception):
                self._clear()
            os._exit(128 + number)


log = logging.getLogger(__name__)

PIECE = 2**16  # bytes read at once
LONG = 2**16  # bytes; frames of a few hundred objects have fewer
LONG_SHARE = 0.1  # of the worker's time for long lines, while short ones wait
FILES_IN_RESERVE = 192  # that the process may open besides its connections; a backlog of them comes at once
MAX_UNFINISHED = 64 * 2**20  # size of unread input of all clients, bytes; beyond it the client with most is closed


class _Reader(asyncio.StreamReader):
    """Ends where the connection is lost, after the bytes received before."""

    def set_exception(self, exc: Exception) -> None:
        self.feed_eof()


class Client:
    """One connection.

    subscribed  True if it gets the tracks of all frames
    size        bytes it has sent of an unfinished line, or of one that waits for its turn
    active      time of its last message or answer, by `time.monotonic()`
    finished    True once all it will send is answered
    """

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, name: str) -> None:
        self.writer, self.transport, self.name = writer, cast(asyncio.Transport, writer.transport), name
        self.subscribed = self.finished = False
        self.size = 0
        self.active = time.monotonic()
        self.task = cast("asyncio.Task[None]", asyncio.current_task())
        self._reader = reader
        self._reading: asyncio.Timeout | None = None
        self._sent = 0
        self._progress = (0, self.active)  # bytes that have left, and since when

    async def read(self, stopping: bool) -> bytes:
        """Return the next bytes; none at the end, and when stopping only received ones."""
        try:
            async with asyncio.timeout(0 if stopping else None) as self._reading:
                piece = await self._reader.read(PIECE)
        except TimeoutError:
            return b"" if stopping else await self.read(stopping=True)
        finally:
            self._reading = None
        self.active = time.monotonic()
        return piece

    def stop_reading(self) -> None:
        """Take in no more."""
        self.transport.pause_reading()
        if self._reading is not None:
            self._reading.reschedule(0.0)

    def send(self, line: bytes) -> None:
        """Send a line, now or when the client reads on."""
        if not self.transport.is_closing():
            self.active = time.monotonic()
            self._sent += len(line)
            self.writer.write(line)

    def stalled(self, now: float) -> float:
        """Return the time, s, without progress while answers pile up, or while the client is being closed."""
        waiting = self.transport.get_write_buffer_size()
        delivered = self._sent - waiting
        piled_up = waiting > PIECE or (waiting > 0 and self.transport.is_closing())
        if not piled_up or delivered > self._progress[0]:
            self._progress = (delivered, now)
        return now - self._progress[1]


class SocketServer:
    """Serves `stream` at `address` until it is stopped; `ready` is called with the address once clients may come."""

    def __init__(
        self, stream: StreamTracker[Client], address: Address, ready: Callable[[Address], None] | None = None
    ) -> None:
        self.settings = stream.settings
        self._stream = stream
        self._address = address
        self._ready = ready
        self._clients: set[Client] = set()
        self._served = 0
        self._closed: Counter[str] = Counter()  # by reason
        self._thread = ThreadPoolExecutor(1, "tracker")
        self._short_lines = 0  # that wait for the worker, or are worked on
        self._long_line = asyncio.Lock()  # one of all clients at a time
        self._long_after = 0.0  # time before which a long line lets short ones pass
        self._stop = asyncio.Event()
        self._flushed = asyncio.Event()
        self._log_limit = LogLimit()

    def run(self, stop: StopRequest) -> None:
        """Serve until `stop` is requested; lines received by then are taken in and answered, as far as time allows.

        Raises `InputError` where the address cannot be had.
        """
        asyncio.run(self._run(stop))

    async def _run(self, stop: StopRequest) -> None:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._complain)
        server = await self._listen()
        stop.notify(lambda: loop.call_soon_threadsafe(self._stop.set))
        watching = asyncio.create_task(self._watch())
        try:
            await self._stop.wait()
            server.close()
            for client in self._clients:
                client.stop_reading()
            await _until(lambda: all(c.finished for c in self._clients), self.settings.stop_timeout / 2)
            self._deliver(await loop.run_in_executor(self._thread, self._stream.flush))
            self._flushed.set()
            await _until(lambda: not self._clients, 2 * self.settings.client_timeout)
        finally:
            watching.cancel()
            for client in self._clients:
                client.transport.abort()
            self._thread.shutdown()
            if self._address.path is not None:
                self._address.path.unlink(missing_ok=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Serve one connection to its end."""
        self._served += 1
        client = Client(reader, writer, f"client {self._served}")
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        most = max(1, min(self.settings.max_clients, files - FILES_IN_RESERVE))
        try:
            if len(self._clients) >= most:
                self._refuse(client, "rejected", f"expected at most {most} connections")
                return
            log.info("%s: connected", client.name)
            self._clients.add(client)
            await self._answer_lines(client)
            client.finished = True
            if self._stop.is_set():
                await self._flushed.wait()
        except asyncio.CancelledError:
            log.debug("%s: refused", client.name)
        finally:
            client.finished = True
            log.info("%s: done", client.name)
            writer.close()
            with suppress(OSError):
                await writer.wait_closed()
            self._clients.discard(client)

    async def _answer_lines(self, client: Client) -> None:
        """Work on the lines of a client until it ends, and when the service stops on those received by then."""
        splitter = LineSplitter(self.settings.max_message)
        while piece := await client.read(stopping=self._stop.is_set()):
            received = time.monotonic()
            for line in splitter.feed(piece):
                self._hold(client, len(line or b""))
                await self._take_turn(line, client, received)
            self._hold(client, len(splitter))
        if not self._stop.is_set():
            for line in splitter.finish():
                await self._take_turn(line, client, time.monotonic())

    async def _take_turn(self, line: bytes | None, client: Client, received: float) -> None:
        """Have the worker take in a line, then wait while too many answers wait for the client."""
        if len(line or b"") > LONG:
            async with self._long_line:
                while self._short_lines and time.monotonic() < self._long_after:
                    await asyncio.sleep(0.005)
                await self._work(line, client, received)
        else:
            self._short_lines += 1
            try:
                await self._work(line, client, received)
            finally:
                self._short_lines -= 1
        with suppress(OSError):  # a client that is gone: what it has sent counts
            await client.writer.drain()

    async def _work(self, line: bytes | None, client: Client, received: float) -> None:
        work = asyncio.get_running_loop().run_in_executor(self._thread, self._answers, line, client, received)
        work.add_done_callback(lambda done: self._deliver(done.result()))  # even if this client is refused meanwhile
        await asyncio.wait([work])

    def _answers(self, line: bytes | None, client: Client, received: float) -> list[tuple[Client, Any]]:
        """Return the stream's answers, in the worker's thread; an error is an answer, too."""
        start = time.monotonic()
        try:
            answers = self._stream.handle(line, client, received)
        except Exception as error:
            if self._log_limit.due(type(error).__name__):
                log.exception("internal error, the service goes on")
            return [(client, {"type": "error", "message": f"internal error: {type(error).__name__}"})]
        for _, answer in answers:
            if answer["type"] == "status":
                answer.update(clients=len(self._clients), closed=dict(self._closed))
        if len(line or b"") > LONG:
            now = time.monotonic()
            self._long_after = now + (now - start) / LONG_SHARE
        return answers

    def _deliver(self, answers: list[tuple[Client, Any]]) -> None:
        for client, answer in answers:
            try:
                line = encode(answer)
            except ValueError as error:
                log.debug("an answer that is no JSON", exc_info=error)
                line = encode({"type": "error", "message": f"internal error: {error}"})
            client.subscribed |= answer["type"] == "subscribe"
            self._send(client, line)
            if answer["type"] == "tracks":
                for subscriber in [each for each in self._clients if each.subscribed and each is not client]:
                    self._send(subscriber, line)

    def _send(self, client: Client, line: bytes) -> None:
        if client.transport.get_write_buffer_size() + len(line) > self.settings.max_outbox:
            self._drop(client)
        else:
            client.send(line)

    def _hold(self, client: Client, size: int) -> None:
        """Note how many bytes of a client wait; where all take too much memory the largest client goes."""
        client.size = size
        limit = MAX_UNFINISHED
        if sum(each.size for each in self._clients) > limit:
            largest = max(self._clients, key=lambda each: each.size)
            largest.size = 0
            text = f"expected unfinished lines of all clients of at most {limit} bytes, most are here"
            self._refuse(largest, "memory", text)

    async def _watch(self) -> None:
        """Drop clients that do not read their answers, and refuse silent ones."""
        idle, stalled = self.settings.idle_timeout, self.settings.client_timeout
        while True:
            await asyncio.sleep(stalled / 4)
            now = time.monotonic()
            for client in list(self._clients):
                if client.stalled(now) >= stalled:
                    self._drop(client)
                elif now - client.active > idle:
                    self._refuse(client, "idle", f"expected a message within {idle:g} s")

    def _refuse(self, client: Client, reason: str, text: str) -> None:
        """Send a client the reason, and close it; its lines are forgotten."""
        if not client.transport.is_closing():
            self._count(client, reason, text)
            client.send(encode({"type": "error", "message": f"{text}: the connection is closed"}))
            client.writer.close()
            if client in self._clients:
                client.task.cancel()

    def _drop(self, client: Client) -> None:
        """Close a client that does not read, at once."""
        self._count(client, "slow", "does not read its answers")
        client.transport.abort()

    def _count(self, client: Client, reason: str, text: str) -> None:
        self._closed[reason] += 1
        if self._log_limit.due(reason):
            log.warning("%s: %s: closed; the status counts more of these", client.name, text)

    def _complain(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """Log an error in the event loop; where no more files can be opened, asyncio tries again after a second."""
        error = context.get("exception")
        if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
            if self._log_limit.due(error.errno):
                log.warning("a connection cannot be accepted: %s", error.strerror)
        else:
            log.error("%s", context.get("message"), exc_info=error)

    async def _listen(self) -> asyncio.Server:
        loop, address = asyncio.get_running_loop(), self._address

        def connection() -> asyncio.Protocol:
            return asyncio.StreamReaderProtocol(_Reader(PIECE), self._serve)

        try:
            if address.path is not None:
                _clear_stale(address.path)
                old = os.umask(0o177)  # for the owner alone
                try:
                    server = await loop.create_unix_server(connection, str(address.path))
                finally:
                    os.umask(old)
            else:
                server = await loop.create_server(connection, address.host, address.port)
                address = replace(address, port=server.sockets[0].getsockname()[1])
        except OSError as error:
            raise InputError(f"{address}: cannot listen there: {error.strerror or error}") from error
        if self._ready is not None:
            self._ready(address)
        return server


async def _until(happened: Callable[[], bool], seconds: float) -> None:
    end = time.monotonic() + seconds
    while not happened() and time.monotonic() < end:
        await asyncio.sleep(0.01)


def _clear_stale(path: Path) -> None:
    """Remove the socket a killed server has left behind. Raises `InputError` for one in use, and for anything else."""
    try:
        mode = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise InputError(f"{path}: expected a place for a socket, there is something else")
    with socket.socket(socket.AF_UNIX) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except OSError:
            path.unlink(missing_ok=True)
            return
    raise InputError(f"{path}: another server listens there")


def serve_pipe(
    stream: StreamTracker[None], source: IO[bytes], sink: IO[bytes], stop: StopRequest | None = None
) -> None:
    """Answer lines until the source ends or `stop` is requested, then the frames that are held back.

    source: a file with a descriptor; nothing may have been read from its buffer. A slow reader of the answers slows the
    reading: nothing piles up. Raises `BrokenPipeError` when that reader goes away.
    """

    def send(answers: Iterable[tuple[None, dict[str, Any]]]) -> None:
        for _, answer in answers:
            sink.write(encode(answer))
        sink.flush()

    splitter, descriptor = LineSplitter(stream.settings.max_message), source.fileno()
    stopped, wake = os.pipe()  # stays open: a signal may come at any time
    if stop is not None:
        stop.notify(lambda: os.write(wake, b"."))
    ended = False
    while not ended:
        ready, _, _ = select.select([descriptor, stopped], [], [])
        ended = stopped in ready
        if descriptor in ready:
            piece = _read(descriptor)
            ended |= not piece
            for line in splitter.feed(piece) if piece else splitter.finish():
                send(stream.handle(line, None))
    send(stream.flush())


def _read(descriptor: int) -> bytes:
    """The next bytes, none at the end or where they cannot be read."""
    try:
        return os.read(descriptor, PIECE)
    except OSError as error:
        log.warning("standard input: %s", error)
        return b""
