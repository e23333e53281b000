"""A service on a TCP or Unix socket: any number of clients, one tracker.

    connections --lines--> in turn --> worker thread: the stream --answers--> connections

Every connection keeps its own lines, a few of them; the worker takes one of each in turn, so that nobody's flood holds
up the others, and reading pauses where too many lines wait. Long lines have a tenth of its time while short ones wait:
a few megabytes of JSON take longer to read than many frames. The event loop is never in the tracker: it accepts, reads
and sends while a frame is worked on. A client that does not read its answers delays nobody and is dropped.
"""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import resource
import socket
import stat
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import Any

from pipelines.serving.address import Address
from pipelines.serving.connection import Connection
from pipelines.serving.messages import encode
from pipelines.serving.seldom import Seldom
from pipelines.serving.stopping import StopRequest
from pipelines.serving.stream import StreamTracker
from saga_fg.errors import InputError

log = logging.getLogger(__name__)

LONG_SHARE = 0.1  # of the worker's time for long lines, while short ones wait
FILES_IN_RESERVE = 192  # that the process may open besides its connections; a backlog of them comes at once


class SocketServer:
    """Serves `stream` at `address` until it is stopped; `ready` is called with the address once clients may come."""

    def __init__(
        self, stream: StreamTracker[Any], address: Address, ready: Callable[[Address], None] | None = None
    ) -> None:
        self.settings = stream.settings
        self._stream = stream
        self._address = address
        self._ready = ready
        self._clients: set[Connection] = set()
        self._served = 0
        self._closed: Counter[str] = Counter()  # by reason
        self._unfinished = 0  # bytes that clients have sent and nobody has worked on
        self._turns: list[Connection] = []  # clients whose lines wait
        self._long_after = 0.0  # time of the event loop before which long lines let short ones pass
        self._wake = asyncio.Event()
        self._idle = asyncio.Event()
        self._stop = asyncio.Event()
        self._thread = ThreadPoolExecutor(1, "tracker")
        self._seldom = Seldom()

    def run(self, stop: StopRequest) -> None:
        """Serve until `stop` is asked for; what was received by then is taken in and answered, as far as time allows.

        Raises `InputError` where the address cannot be had.
        """
        asyncio.run(self._run(stop))

    async def _run(self, stop: StopRequest) -> None:
        loop = asyncio.get_running_loop()
        loop.set_exception_handler(self._complain)
        server = await self._listen()
        stop.notify(lambda: loop.call_soon_threadsafe(self._stop.set))
        tasks = [asyncio.create_task(self._work()), asyncio.create_task(self._close_idle())]
        try:
            await self._stop.wait()
            server.close()
            for client in self._clients:
                client.stop_reading()
            with suppress(TimeoutError):
                async with asyncio.timeout(self.settings.stop_timeout / 2):
                    await self._idle.wait()
        finally:
            for task in tasks:
                task.cancel()
            self._deliver(await loop.run_in_executor(self._thread, self._stream.flush))
            for client in list(self._clients):
                client.close()
            await self._all_gone()
            self._thread.shutdown()
            if self._address.path is not None:
                self._address.path.unlink(missing_ok=True)

    # what connections tell

    def connected(self, client: Connection) -> None:
        """Count it in, or send it away."""
        self._served += 1
        client.name = f"client {self._served}"
        if len(self._clients) >= self._most_clients():
            client.refuse("rejected", f"expected at most {self._most_clients()} connections")
            return
        log.info("%s: connected", client.name)
        self._clients.add(client)

    def arrived(self, client: Connection) -> None:
        """It takes its turns while it has lines; where all lines take too much memory the largest client goes."""
        if client.lines:
            self._take_turns(client)
        if self._unfinished > self.settings.max_unfinished:
            largest = max({*self._clients, *self._turns}, key=lambda each: each.size)
            limit = self.settings.max_unfinished
            largest.refuse(
                "memory", f"expected unfinished lines of all clients of at most {limit} bytes, most are here"
            )
        self._part(client)

    def resized(self, difference: int) -> None:
        """So many bytes more, or fewer, are waiting."""
        self._unfinished += difference

    def lost(self, client: Connection) -> None:
        """Its lines are still worked on."""
        self._clients.discard(client)

    def dropped(self, client: Connection, reason: str, text: str) -> None:
        """Count it."""
        self._closed[reason] += 1
        if self._seldom.due(reason):
            log.warning("%s: %s: closed; the status counts more of these", client.name, text)

    # work

    async def _work(self) -> None:
        loop = asyncio.get_running_loop()
        while True:
            while not self._turns:
                self._idle.set()
                self._wake.clear()
                await self._wake.wait()
            client = self._next_client(loop.time())
            if not client.lines:  # refused meanwhile
                continue
            start, long = loop.time(), client.long_line_next
            line, received = client.next_line()
            client.working = True
            answers = await loop.run_in_executor(self._thread, self._answers, line, client, received)
            client.working = False
            if long:
                self._long_after = loop.time() + (loop.time() - start) / LONG_SHARE
            self._deliver(answers)
            if client.lines:
                self._take_turns(client)
            self._part(client)

    def _next_client(self, now: float) -> Connection:
        """The one that has waited longest, of those with short lines if it is not yet time for a long one."""
        ready = self._turns if now >= self._long_after else [each for each in self._turns if not each.long_line_next]
        client = (ready or self._turns)[0]
        self._turns.remove(client)
        client.queued = False
        return client

    def _take_turns(self, client: Connection) -> None:
        if not client.queued and not client.working:
            client.queued = True
            self._turns.append(client)
            self._idle.clear()
            self._wake.set()

    def _answers(self, line: bytes | None, client: Connection, received: float) -> list[tuple[Connection, Any]]:
        """What the stream answers, in the worker's thread. Whatever happens, there is an answer."""
        try:
            answers = self._stream.handle(line, client, received)
        except Exception as error:
            if self._seldom.due(type(error).__name__):
                log.exception("internal error, the service goes on")
            return [(client, {"type": "error", "message": f"internal error: {type(error).__name__}"})]
        for _, answer in answers:
            if answer["type"] == "status":
                answer.update(clients=len(self._clients), closed=dict(self._closed))
        return answers

    def _deliver(self, answers: list[tuple[Connection, Any]]) -> None:
        for client, answer in answers:
            try:
                line = encode(answer)
            except ValueError as error:
                log.debug("an answer that is no JSON", exc_info=error)
                line = encode({"type": "error", "message": f"internal error: {error}"})
            client.hears_all |= answer["type"] == "subscribe"
            client.send(line)
            if answer["type"] == "tracks":
                for hearer in [each for each in self._clients if each.hears_all and each is not client]:
                    hearer.send(line)

    def _part(self, client: Connection) -> None:
        """From a client that has ended, when all is answered."""
        if client.ended and not client.lines and not client.working:
            client.close()

    async def _close_idle(self) -> None:
        limit = self.settings.idle_timeout
        while True:
            await asyncio.sleep(min(limit / 4, 60.0))
            now = time.monotonic()
            for client in [each for each in self._clients if now - each.active > limit]:
                client.refuse("idle", f"expected a message within {limit:g} s")

    async def _all_gone(self) -> None:
        """Clients have read their answers, or had time to."""
        with suppress(TimeoutError):
            async with asyncio.timeout(2 * self.settings.client_timeout):
                while self._clients:
                    await asyncio.sleep(0.01)

    def _most_clients(self) -> int:
        files, _ = resource.getrlimit(resource.RLIMIT_NOFILE)
        return max(1, min(self.settings.max_clients, files - FILES_IN_RESERVE))

    def _complain(self, loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
        """An error in the event loop: where no more files can be opened, asyncio tries again after a second."""
        error = context.get("exception")
        if isinstance(error, OSError) and error.errno in (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM):
            if self._seldom.due(error.errno):
                log.warning("a connection cannot be accepted: %s", error.strerror)
        else:
            log.error("%s", context.get("message"), exc_info=error)

    async def _listen(self) -> asyncio.Server:
        loop, address = asyncio.get_running_loop(), self._address
        try:
            if address.path is not None:
                _clear_stale(address)
                old = os.umask(0o177)  # for the owner alone
                try:
                    server = await loop.create_unix_server(lambda: Connection(self), str(address.path))
                finally:
                    os.umask(old)
            else:
                server = await loop.create_server(lambda: Connection(self), address.host, address.port)
                address = replace(address, port=server.sockets[0].getsockname()[1])
        except OSError as error:
            raise InputError(f"{address}: cannot listen there: {error.strerror or error}") from error
        if self._ready is not None:
            self._ready(address)
        return server


def _clear_stale(address: Address) -> None:
    """Remove the socket a killed server has left behind. Raises `InputError` for one in use, and for anything else."""
    path = address.path
    assert path is not None
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
