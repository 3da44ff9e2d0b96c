"""A server on the loopback that sends bytes, whatever they are, for as long as the other side listens."""

import contextlib
import socket
import threading
from collections.abc import Callable, Iterator


class RawServer:
    """Gives each connection, once its request was read, to `act`; counts what `act` could send."""

    def __init__(self, act: Callable[[socket.socket], None]) -> None:
        self._act = act
        self.requests: list[bytes] = []
        self.ended = threading.Event()
        self._listening = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listening.getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/v1"
        threading.Thread(target=self._serve, daemon=True).start()

    def _serve(self) -> None:
        while True:
            try:
                connection, _ = self._listening.accept()
            except OSError:
                return
            threading.Thread(target=self._one, args=(connection,), daemon=True).start()

    def _one(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.settimeout(30)
            self.requests.append(read_request(connection))
            self._act(connection)
        self.ended.set()

    def close(self) -> None:
        self._listening.close()


def read_request(connection: socket.socket) -> bytes:
    """Read one request, its body too."""
    seen = b""
    while b"\r\n\r\n" not in seen:
        piece = connection.recv(1 << 16)
        if not piece:
            return seen
        seen += piece
    head, _, body = seen.partition(b"\r\n\r\n")
    length = next((int(line[15:]) for line in head.lower().split(b"\r\n") if line.startswith(b"content-length:")), 0)
    while len(body) < length:
        piece = connection.recv(1 << 16)
        if not piece:
            break
        seen, body = seen + piece, body + piece
    return seen


@contextlib.contextmanager
def serving(act: Callable[[socket.socket], None]) -> Iterator[RawServer]:
    server = RawServer(act)
    try:
        yield server
    finally:
        server.close()
