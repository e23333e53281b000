"""Clients of a service on a socket can do little to it, and to each other."""

import asyncio
import json
import resource
import signal
import socket
import threading
import time
from contextlib import ExitStack, suppress
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from pipelines.serving import Address, SocketServer, StreamClient, StreamSettings
from saga_fg.errors import InputError
from tests.pipelines.command import COMMAND
from tests.pipelines.running_service import frame, limits, serving, status, wait_for


def connected(address: Address) -> socket.socket:
    return socket.create_connection((address.host, address.port))


def memory(pid: int) -> float:
    """Resident, MB."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * resource.getpagesize() / 1e6


def test_one_client_more_than_allowed_is_told_and_sent_away(tmp_path):
    with serving("--listen", "127.0.0.1:0", *limits(tmp_path, max_clients=2)) as (address, _):
        with StreamClient(address) as first, StreamClient(address) as second:
            assert first.ask({"type": "status"})["clients"] in (1, 2)
            with connected(address) as third:
                told = third.makefile("rb").readlines()
                assert [json.loads(line)["type"] for line in told] == ["error"]
                assert b"at most 2 connections" in told[0]
            second.send(frame(0))
            assert second.receive()["type"] == "tracks"
            assert first.ask({"type": "status"})["closed"] == {"rejected": 1}
        wait_for(lambda: status(address)["clients"] == 1)


def test_a_silent_client_is_told_and_closed_and_a_listener_is_not(tmp_path):
    impatient = limits(tmp_path, idle_timeout=0.5)
    with ExitStack() as stack:
        address, _ = stack.enter_context(serving("--listen", "127.0.0.1:0", *impatient))
        silent, listener, sender = (stack.enter_context(StreamClient(address)) for _ in range(3))
        listener.ask({"type": "subscribe"})
        for seq in range(20):
            sender.send(frame(seq))
            assert sender.receive()["type"] == listener.receive()["type"] == "tracks"
            time.sleep(0.05)
        assert "within 0.5 s" in silent.receive()["message"]


def test_a_client_waits_for_its_turn_where_many_connect_at_once(tmp_path):
    address = Address(path=tmp_path / "full.sock")
    with ExitStack() as stack:
        server = stack.enter_context(socket.socket(socket.AF_UNIX))
        server.bind(str(address.path))
        server.listen(1)
        with suppress(BlockingIOError):
            while True:
                other = stack.enter_context(socket.socket(socket.AF_UNIX))
                other.setblocking(False)
                other.connect(str(address.path))
        with pytest.raises(InputError, match=r"full\.sock: nobody answers there"):
            StreamClient(address, timeout=0.1)
        later = threading.Timer(0.2, lambda: stack.enter_context(server.accept()[0]))
        later.start()
        stack.enter_context(StreamClient(address))
        later.join()


def test_unfinished_lines_of_all_clients_share_a_budget():
    with serving("--listen", "127.0.0.1:0", "--verbose") as (address, server), ExitStack() as stack:
        good = stack.enter_context(StreamClient(address))
        good.send(frame(0))
        good.receive()
        # the good client has the shortest unfinished line, and keeps it
        good.send(frame(1)[:20])
        before = memory(server.pid)
        hogs = [stack.enter_context(connected(address)) for _ in range(100)]
        peak = 0.0
        for hog in hogs:
            with suppress(OSError):  # closed by the service
                hog.sendall(b"[" * (4 * 2**20 - 1))
            peak = max(peak, memory(server.pid))
        good.send(frame(1)[20:])
        assert good.receive()["type"] == "tracks"
        closed = good.ask({"type": "status"})["closed"]["memory"]
        assert closed >= 80
        assert peak - before < 250
        assert sum(b"unfinished lines" in received(hog) for hog in hogs) > 0


def received(client: socket.socket) -> bytes:
    client.setblocking(False)
    try:
        return client.recv(10000)
    except OSError:
        return b""


FEW_FILES = partial(resource.setrlimit, resource.RLIMIT_NOFILE, (1024, 1024))


def test_more_connections_than_files_do_not_end_the_service(tmp_path):
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (min(hard, 4096), hard))
    try:
        many = limits(tmp_path, max_clients=100000)
        with serving("--listen", "127.0.0.1:0", *many, before=FEW_FILES) as (address, server), ExitStack() as stack:
            good = stack.enter_context(StreamClient(address))
            for _ in range(1100):
                stack.enter_context(connected(address))
            for seq in range(3):
                good.send(frame(seq))
                assert good.receive()["type"] == "tracks"
            told = good.ask({"type": "status"})
            assert told["closed"]["rejected"] >= 1100 - 1024 + 100
            assert told["clients"] <= 1024 - 100
            assert server.poll() is None
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))


def test_a_service_without_files_left_takes_connections_again_later():
    """The limit is lowered under the open connections: accepting fails until some are closed."""
    with serving("serve", "--listen", "127.0.0.1:0", command=COMMAND) as (address, server):
        with StreamClient(address) as good:
            good.ask({"type": "status"})
            used = len(list(Path(f"/proc/{server.pid}/fd").iterdir()))
            _, most = resource.prlimit(server.pid, resource.RLIMIT_NOFILE)
            resource.prlimit(server.pid, resource.RLIMIT_NOFILE, (used, most))
            with connected(address):
                for seq in range(3):
                    good.send(frame(seq))
                    assert good.receive()["type"] == "tracks"
            resource.prlimit(server.pid, resource.RLIMIT_NOFILE, (most, most))
        assert status(address)["frames"] == 3


CROWD = [{"label": "car", "x": 30.0 * k, "y": 0.0} for k in range(200)]


def told_of_crowds(sender: StreamClient, seq: int) -> None:
    """Twenty frames of many objects, each with its answer."""
    for k in range(seq, seq + 20):
        sender.send({"seq": k, "timestamp": k / 10, "detections": CROWD})
        assert sender.receive()["type"] == "tracks"


def stalled(address: Address, sender: StreamClient) -> socket.socket:
    """A connection that listens to all tracks and does not read them."""
    listener = socket.socket()
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    listener.connect((address.host, address.port))
    listener.sendall(b'{"type": "subscribe"}\n')
    wait_for(lambda: sender.ask({"type": "status"})["clients"] == 2)
    return listener


def test_a_listener_that_stops_reading_is_dropped():
    with ExitStack() as stack:
        address, _ = stack.enter_context(serving("--listen", "127.0.0.1:0"))
        sender = stack.enter_context(StreamClient(address))
        stack.enter_context(stalled(address, sender))
        seqs = iter(range(0, 10**6, 20))
        while not sender.ask({"type": "status"})["closed"]:
            told_of_crowds(sender, next(seqs))
        assert sender.ask({"type": "status"})["closed"] == {"slow": 1}


def test_a_listener_that_stops_reading_delays_nobody(tmp_path):
    """Here it may stall for an hour; nobody waits for it."""
    patient = limits(tmp_path, client_timeout=3600.0, stop_timeout=1.0, max_outbox=10**6)
    with ExitStack() as stack:
        address, _ = stack.enter_context(serving("--listen", "127.0.0.1:0", *patient))
        sender = stack.enter_context(StreamClient(address))
        stack.enter_context(stalled(address, sender))
        seqs = iter(range(0, 10**6, 20))
        while not sender.ask({"type": "status"})["closed"]:  # a million bytes wait for it
            told_of_crowds(sender, next(seqs))


def test_lines_of_clients_are_taken_in_turn():
    """One that has sent a lot at once is not in front of all others."""
    with ExitStack() as stack:
        address, _ = stack.enter_context(serving("--listen", "127.0.0.1:0"))
        flood, good = (stack.enter_context(StreamClient(address)) for _ in range(2))
        for k in range(60):
            flood.send({"timestamp": k / 10, "sensor": "flood", "detections": CROWD})
        wait_for(lambda: good.ask({"type": "status"})["frames"] > 0)
        assert good.ask({"type": "status"})["frames"] < 60
        for _ in range(60):
            assert flood.receive()["type"] == "tracks"


def test_a_flood_of_late_frames_is_no_flood_of_warnings():
    """Nobody may be reading the warnings: a pipe that is full would hold up the service."""
    with serving("--listen", "127.0.0.1:0") as (address, server), StreamClient(address) as client:
        for seq in range(300):
            client.send({"timestamp": 100.0 if seq == 0 else 95.0 + seq % 2, "sensor": str(seq), "detections": []})
            client.receive()
        server.send_signal(signal.SIGTERM)
        _, errors = server.communicate(timeout=60)
        assert sum(" late and is left out" in line for line in errors.splitlines()) <= 1


def test_long_lines_let_short_ones_pass_until_it_is_their_time():
    """Two long lines and twenty short ones, each of which takes 20 ms: the second long one is the last of all."""
    order: list[str] = []

    class Slow:
        settings = StreamSettings()

        def handle(self, line: bytes, client: str, received: float) -> list[Any]:
            time.sleep(0.02)
            order.append(client)
            return []

    class Silent:
        async def drain(self) -> None: ...

    async def clients() -> None:
        server: Any = SocketServer(Slow(), Address())  # type: ignore[arg-type]

        def line(size: int, name: str) -> Any:
            client = type("client", (str,), {"writer": Silent()})(name)
            return server._take_turn(b" " * size, client, 0.0)

        async def short(name: str) -> None:
            for _ in range(10):
                await line(100, name)

        first = asyncio.create_task(line(10**6, "long"))
        await asyncio.sleep(0)
        await asyncio.gather(line(10**6, "long"), short("a"), short("b"), first)

    asyncio.run(clients())
    assert order[0] == "long"
    assert order.index("long", 1) >= 8  # a tenth of the time is theirs
    assert order[1:5] in (list("abab"), list("baba"))  # clients take turns
