"""One HTTP exchange: the only place where bytes from outside enter, under one deadline and one limit of size.

Every wait, whether for a name, a connection, a handshake, a header or a byte of the body, is a wait of
:meth:`rapid.teacher.patience.Flight.remaining`, so that no server can hold it up by sending slowly. Everything that is
read is counted, compressed or not. Each exchange has a connection of its own: what a new one costs is little beside
what a model takes to answer, and none can be found dead.
"""

import contextlib
import http.client
import io
import os
import queue
import selectors
import socket
import ssl
import threading
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from rapid.teacher.address import Address
from rapid.teacher.patience import POLL, Flight

_HEAD = 1 << 18
"""Bytes that may come before an answer's body: its status, its headers, interim answers, those of a proxy."""


class WireError(Exception):
    """No answer came. `lasting` says that trying again would not help."""

    def __init__(self, message: str, lasting: bool = False) -> None:
        super().__init__(message)
        self.lasting = lasting


@dataclass(frozen=True)
class Response:
    """What a server answered."""

    status: int
    headers: Mapping[str, str]
    """With names in small letters; of equal names the first."""
    body: bytes
    """Decompressed."""


def exchange(
    method: str, address: Address, name: str, headers: Mapping[str, str], body: bytes, flight: Flight, limit: int
) -> Response:
    """Send one request and read the whole answer.

    Args:
        method: GET or POST.
        address: the server.
        name: what is asked for, below the base address.
        headers: those that open the server; the rest is set here.
        body: JSON.
        flight: how long it may take.
        limit: bytes that the answer may have, before and after decompression.

    Raises:
        WireError: the server cannot be reached, breaks off, or sends what is no HTTP or too much.
        StoppedError: it is not waited for any longer.
    """
    sent = {**headers, "connection": "close", "accept": "application/json"}
    if body:
        sent["content-type"] = "application/json"
    target = address.target(name)
    proxy = address.proxy
    if proxy and not address.tls:
        target = address.origin + target
        sent |= {"proxy-authorization": proxy.authorization} if proxy.authorization else {}
    wire: _Wire | None = None
    try:
        wire = _connect(address, flight)
        connection = http.client.HTTPConnection(address.host, address.port)
        connection.sock = wire  # pyright: ignore[reportAttributeAccessIssue]
        connection.default_port = 443 if address.tls else 80  # pyright: ignore[reportAttributeAccessIssue]
        connection.request(method, target, body or None, sent)
        response = connection.getresponse()
        wire.allow(limit)
        content = _read(response, limit)
        seen: dict[str, str] = {}
        for header, value in response.getheaders():
            seen.setdefault(header.lower(), value)
        return Response(response.status, seen, _decompressed(content, seen.get("content-encoding", ""), limit))
    except TimeoutError as error:
        raise WireError(_told(str(error), address)) from None
    except ssl.SSLCertVerificationError as error:
        raise WireError(_told(f"its certificate is refused: {error.verify_message}", address), True) from None
    except ssl.SSLError as error:
        hint = "; does it speak http:// only?" if error.reason == "WRONG_VERSION_NUMBER" else ""
        raise WireError(_told(f"no encrypted connection: {error.reason or error}{hint}", address), bool(hint)) from None
    except (http.client.HTTPException, EOFError) as error:
        said = str(error) or type(error).__name__
        raise WireError(_told(f"the connection broke off or was no HTTP: {said}", address)) from None
    except OSError as error:
        raise WireError(_told(f"no connection: {error.strerror or error}", address)) from None
    except ValueError as error:
        raise WireError(_told(f"what it sent is no HTTP: {error}", address)) from None
    finally:
        if wire is not None:
            wire.end()


def _told(fault: str, address: Address) -> str:
    return f"{fault} (through the proxy of {address.proxy.variable})" if address.proxy else fault


def _connect(address: Address, flight: Flight) -> "_Wire":
    proxy = address.proxy
    host, port = (proxy.host, proxy.port) if proxy else (address.host, address.port)
    wire = _Wire(_dial(host, port, flight), flight)
    if not address.tls:
        return wire
    try:
        if proxy:
            _open_tunnel(wire, address, proxy.authorization)
        wire.encrypt(address.host)
    except BaseException:
        wire.end()
        raise
    return wire


def _open_tunnel(wire: "_Wire", address: Address, authorization: str) -> None:
    place = address.origin.partition("//")[2]
    opening = f"CONNECT {place} HTTP/1.1\r\nHost: {place}\r\n"
    if authorization:
        opening += f"Proxy-Authorization: {authorization}\r\n"
    wire.sendall(f"{opening}\r\n".encode())
    response = http.client.HTTPResponse(wire, method="CONNECT")  # pyright: ignore[reportArgumentType]
    response.begin()
    if response.status != 200:
        raise WireError(_told(f"the proxy opens no way: HTTP {response.status} {response.reason}", address))


def _dial(host: str, port: int, flight: Flight) -> socket.socket:
    """Return a connected socket that never blocks, trying every address that the name has."""
    found = _resolve(host, port, flight)
    fault: OSError = OSError(f"the name '{host}' has no address")
    for place, (family, kind, protocol, _, where) in enumerate(found):
        connecting = socket.socket(family, kind, protocol)
        try:
            connecting.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                connecting.connect(where)
            # The time that is left is shared with the addresses behind, which may be those that answer.
            _until(connecting, selectors.EVENT_WRITE, flight, flight.remaining() / (len(found) - place))
            if code := connecting.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR):
                raise OSError(code, os.strerror(code).lower())
            connecting.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        except OSError as error:
            connecting.close()
            fault = error
        except BaseException:
            connecting.close()
            raise
        else:
            return connecting
    raise fault


def _resolve(host: str, port: int, flight: Flight) -> list[Any]:
    """Return the addresses of a name; looking it up cannot be broken off, so a thread does it that may be left."""
    try:
        return socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_NUMERICHOST)
    except OSError:
        pass
    answers: queue.SimpleQueue[list[Any] | OSError] = queue.SimpleQueue()

    def look_up() -> None:
        try:
            answers.put(list(socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)))
        except (OSError, UnicodeError) as error:
            answers.put(OSError(f"the name '{host}' cannot be found ({error})"))

    threading.Thread(target=look_up, daemon=True).start()
    while True:
        try:
            found = answers.get(timeout=min(flight.remaining(), POLL))
        except queue.Empty:
            continue
        if isinstance(found, OSError):
            raise found
        return found


def _until(waiting: socket.socket, event: int, flight: Flight, seconds: float | None = None) -> None:
    """Wait until a socket is ready, at most so long."""
    with selectors.DefaultSelector() as selector:
        selector.register(waiting, event)
        left = seconds
        while True:
            piece = min(flight.remaining(), POLL)
            if selector.select(piece):
                return
            if left is not None and (left := left - piece) <= 0:
                raise TimeoutError("no connection in time")


class _Wire:
    """A socket as :mod:`http.client` uses one, which waits only as long as its flight and reads only so much."""

    def __init__(self, connected: socket.socket, flight: Flight) -> None:
        self._socket, self._flight = connected, flight
        self._read, self._limit = 0, _HEAD

    def allow(self, more: int) -> None:
        """Let so many bytes more be read: the head is over."""
        self._limit = self._read + more

    def encrypt(self, host: str) -> None:
        self._socket = _context().wrap_socket(self._socket, server_hostname=host, do_handshake_on_connect=False)
        while not self._tried(self._socket.do_handshake):
            pass

    def sendall(self, content: Any) -> None:
        left = memoryview(content)
        while left:
            sent: list[int] = []
            view = left
            if self._tried(lambda view=view, sent=sent: sent.append(self._socket.send(view)), selectors.EVENT_WRITE):
                left = left[sent[0] :]

    def receive(self, buffer: Any) -> int:
        got: list[int] = []
        while not self._tried(lambda: got.append(self._socket.recv_into(buffer))):
            pass
        self._read += got[0]
        if self._read > self._limit:
            raise WireError(f"its answer is larger than {self._limit / 1e6:.1f} MB", lasting=True)
        return got[0]

    def makefile(self, mode: str) -> io.BufferedReader:
        return io.BufferedReader(_Reader(self), 1 << 16)

    def close(self) -> None:
        """Do nothing: :mod:`http.client` closes it before the answer is read."""

    def end(self) -> None:
        self._socket.close()

    def _tried(self, action: Any, event: int = selectors.EVENT_READ) -> bool:
        """Do something with the socket, or wait until it may be tried again and say so."""
        self._flight.remaining()
        try:
            action()
        except ssl.SSLWantWriteError:
            _until(self._socket, selectors.EVENT_WRITE, self._flight)
        except ssl.SSLWantReadError:
            _until(self._socket, selectors.EVENT_READ, self._flight)
        except (BlockingIOError, InterruptedError):
            _until(self._socket, event, self._flight)
        else:
            return True
        return False


class _Reader(io.RawIOBase):
    def __init__(self, wire: _Wire) -> None:
        self._wire = wire

    def readable(self) -> bool:
        return True

    def readinto(self, buffer: Any) -> int:
        return self._wire.receive(buffer)


@cache
def _context() -> ssl.SSLContext:
    context = ssl.create_default_context()
    if not context.cert_store_stats()["x509_ca"]:
        # Some Pythons find no authorities of the system's; many packages bring certifi's.
        with contextlib.suppress(ImportError):
            import certifi

            context.load_verify_locations(certifi.where())
    return context


def _read(response: http.client.HTTPResponse, limit: int) -> bytes:
    pieces: list[bytes] = []
    size = 0
    while piece := response.read(1 << 16):
        pieces.append(piece)
        size += len(piece)
        if size > limit:
            raise WireError(f"its answer is larger than {limit / 1e6:.1f} MB", lasting=True)
    if response.length:
        raise http.client.IncompleteRead(b"", response.length)
    return b"".join(pieces)


def _decompressed(content: bytes, encoding: str, limit: int) -> bytes:
    """Undo a compression that nobody asked for."""
    kind = encoding.strip().lower()
    if kind in ("", "identity") or not content:
        return content
    if kind not in ("gzip", "x-gzip", "deflate"):
        raise WireError(f"its answer is encoded as '{kind[:20]}', which was not asked for", lasting=True)
    try:
        # 32 more: whichever of the two heads there is.
        plain = zlib.decompressobj(zlib.MAX_WBITS + 32)
        found = plain.decompress(content, limit + 1)
    except zlib.error as error:
        raise WireError(f"its answer is compressed, but damaged: {error}") from None
    if len(found) > limit:
        raise WireError(f"its answer is larger than {limit / 1e6:.1f} MB, decompressed", lasting=True)
    if not plain.eof:
        raise WireError("its answer is compressed, and was cut off")
    return found
