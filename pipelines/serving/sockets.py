"""A service on a TCP or Unix socket: any number of clients, one tracker.

Every connection has a reader; all of them fill one queue of limited length, one worker empties it, and answers. When
the queue is full the readers pause, the sockets fill up, and the clients feel it: back-pressure from end to end. A
client that does not read its answers holds up the others for `client_timeout` at most and is then let go; what it had
sent counts.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import signal
import socket
import stat
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

from pipelines.serving.address import Address
from pipelines.serving.messages import encode
from pipelines.serving.stream import StreamTracker
from saga_fg.errors import InputError

log = logging.getLogger(__name__)


@dataclass(eq=False)
class _Client:
    """A connection. `open` until it failed; `hears_all` after it has subscribed."""

    name: str
    writer: asyncio.StreamWriter
    open: bool = True
    hears_all: bool = False


@dataclass(frozen=True, eq=False)
class _Line:
    client: _Client
    text: bytes
    received: float = field(default_factory=time.monotonic)


class SocketServer:
    """Serves `stream` at `address` until it is stopped; `ready` is called with the address once clients may come."""

    def __init__(
        self, stream: StreamTracker[Any], address: Address, ready: Callable[[Address], None] | None = None
    ) -> None:
        self._stream = stream
        self._address = address
        self._ready = ready
        self._clients: set[_Client] = set()
        self._served = 0
        self._readers: set[asyncio.Task[None]] = set()
        self._queue: asyncio.Queue[_Line] = asyncio.Queue(stream.settings.max_queue)
        self._stop = asyncio.Event()

    def run(self) -> None:
        """Serve until SIGINT or SIGTERM; everything that was received by then is taken in and answered.

        Raises `InputError` where the address cannot be had.
        """
        asyncio.run(self._run())

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        for sign in (signal.SIGINT, signal.SIGTERM):
            loop.add_signal_handler(sign, self._stop.set)
        server = await self._listen()
        worker = asyncio.create_task(self._work())
        try:
            await self._stop.wait()
            server.close()
            for reader in self._readers:
                reader.cancel()
            await self._queue.join()
        finally:
            worker.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await worker
            for client, answer in self._stream.flush():
                await self._send(client, answer)
            for client in list(self._clients):
                client.writer.close()
            if self._address.path is not None:
                self._address.path.unlink(missing_ok=True)

    async def _listen(self) -> asyncio.Server:
        address, limit = self._address, self._stream.settings.max_message
        try:
            if address.path is not None:
                _clear_stale(address)
                old = os.umask(0o177)  # for the owner alone
                try:
                    server = await asyncio.start_unix_server(self._serve, str(address.path), limit=limit)
                finally:
                    os.umask(old)
            else:
                server = await asyncio.start_server(self._serve, address.host, address.port, limit=limit)
                address = replace(address, port=server.sockets[0].getsockname()[1])
        except OSError as error:
            raise InputError(f"{address}: cannot listen there: {error.strerror or error}") from error
        if self._ready is not None:
            self._ready(address)
        return server

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._served += 1
        client = _Client(f"client {self._served}", writer)
        self._clients.add(client)
        log.info("%s: connected", client.name)
        task = asyncio.current_task()
        assert task is not None
        self._readers.add(task)
        task.add_done_callback(self._readers.discard)
        try:
            while (line := await self._read_line(reader)) is not None:
                await self._queue.put(_Line(client, line))
        except ConnectionError as error:
            log.info("%s: %s", client.name, error)
        # its answers may still be on the way: the worker closes the connection behind them
        await self._queue.put(_Line(client, b""))

    async def _read_line(self, reader: asyncio.StreamReader) -> bytes | None:
        """The next line, None at the end. What exceeds the limit is cut, so that it is refused as too long."""
        try:
            return await reader.readuntil(b"\n")
        except asyncio.IncompleteReadError as error:
            return error.partial + b"\n" if error.partial.strip() else None
        except asyncio.LimitOverrunError:
            while True:  # the rest of an endless line goes by in pieces
                try:
                    await reader.readuntil(b"\n")
                    break
                except asyncio.LimitOverrunError as error:
                    await reader.readexactly(error.consumed)
                except asyncio.IncompleteReadError:
                    break
            return b" " * (self._stream.settings.max_message + 1)

    async def _work(self) -> None:
        while True:
            line = await self._queue.get()
            try:
                if line.text:
                    for client, answer in self._answers(line):
                        await self._send(client, answer)
                else:
                    self._close(line.client)
            finally:
                self._queue.task_done()
            await asyncio.sleep(0)  # let the readers go on

    def _answers(self, line: _Line) -> list[tuple[_Client, dict[str, Any]]]:
        if len(line.text) > self._stream.settings.max_message:
            error = InputError(f"message: expected at most {self._stream.settings.max_message} bytes")
            return [(line.client, self._stream.refused(error))]
        answers = self._stream.handle(line.text, line.client, line.received)
        for client, answer in answers:
            if answer["type"] == "subscribe":
                client.hears_all = True
            if answer["type"] == "status":
                answer["clients"] = len(self._clients)
        return answers

    async def _send(self, client: _Client, answer: dict[str, Any]) -> None:
        line = encode(answer)
        hearers = {client} | ({c for c in self._clients if c.hears_all} if answer["type"] == "tracks" else set())
        for hearer in hearers:
            if not hearer.open:
                continue
            try:
                hearer.writer.write(line)
                async with asyncio.timeout(self._stream.settings.client_timeout):
                    await hearer.writer.drain()
            except TimeoutError:
                log.warning("%s: does not read its answers and is let go", hearer.name)
                self._close(hearer, abort=True)
            except (ConnectionError, OSError) as error:
                log.info("%s: gone: %s", hearer.name, error)
                self._close(hearer)

    def _close(self, client: _Client, abort: bool = False) -> None:
        client.open = False
        self._clients.discard(client)
        if abort:
            client.writer.transport.abort()
        else:
            client.writer.close()


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
