"""Where a server is, how it is reached, and what is shown to it; nothing secret may stand in the settings."""

import base64
import os
import re
import urllib.request
from collections.abc import Mapping
from dataclasses import dataclass, field
from ipaddress import ip_address
from typing import NoReturn
from urllib.parse import parse_qsl, quote, unquote, urlsplit

from rapid.config import TeacherConfig
from rapid.errors import RapidError

_VARIABLE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")
_NAME = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_TELLTALE = re.compile(r"key|token|secret|pass|auth|sig|cred|code", re.IGNORECASE)
_OURS = {"host", "connection", "content-length", "content-type", "transfer-encoding", "accept-encoding", "expect"}


@dataclass(frozen=True)
class Proxy:
    """An HTTP proxy and the environment variable, or the system's setting, that asks for it."""

    host: str
    port: int
    variable: str
    authorization: str = field(default="", repr=False)


@dataclass(frozen=True)
class Address:
    """A server's base address, read once: its parts as they are sent."""

    tls: bool
    host: str
    port: int
    path: str = field(repr=False)
    """May hold a secret, as may the query."""
    query: str = field(repr=False)
    proxy: Proxy | None

    @property
    def origin(self) -> str:
        """Scheme, host and port, as a proxy wants them."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"{'https' if self.tls else 'http'}://{host}:{self.port}"

    def target(self, name: str) -> str:
        """Return what is asked for, such as ``/v1/models``; a query of the base address stays at the end."""
        return f"{self.path}/{name}{'?' if self.query else ''}{self.query}"


@dataclass(frozen=True)
class Access:
    """An address, the headers that open it, and the secrets that are in either."""

    address: Address
    headers: Mapping[str, str] = field(repr=False)
    secrets: tuple[str, ...] = field(repr=False)


def check_names(config: TeacherConfig) -> None:
    """Raise if a setting holds a secret itself, where the name of an environment variable belongs.

    Settings are written beside the data, printed and put on pages, so that this is looked at before anything else; the
    message does not repeat what was given.

    Raises:
        RapidError: a key, a password or a token in the address or in place of a variable's name.
    """
    for option, name in (("api-key-env", config.api_key_env), ("headers-env", config.headers_env)):
        if name and (not _NAME.fullmatch(name) or (_looks_secret(name) and name not in os.environ)):
            raise RapidError(
                f"--teacher.{option} holds no name of an environment variable; if it is a key, it must not be given "
                "here, where it would be written into the data. Put it into an environment variable, for example "
                f"MY_KEY, and give --teacher.{option} MY_KEY."
            )
    try:
        parts = urlsplit(config.base_url)
        password = "@" in parts.netloc
    except ValueError:
        return  # no address at all, which is said where it is used
    if password:
        raise RapidError(
            "The address in --teacher.base-url holds a user name or password, which would be written into the data. "
            "Leave it out, and put the key into the environment variable that --teacher.api-key-env names."
        )
    values = [value for name, value in parse_qsl(parts.query) if _TELLTALE.search(name) or _looks_secret(value)]
    values += [segment for segment in unquote(parts.path).split("/") if _looks_secret(segment)]
    if [value for value in values if not _VARIABLE.search(value)]:
        raise RapidError(
            "The address in --teacher.base-url holds what looks like a key, which would be written into the data. Put "
            "it into an environment variable, for example MY_KEY, and write '${MY_KEY}' in its place in the address, "
            "in single quotes."
        )


def open_access(config: TeacherConfig) -> Access:
    """Read the address, the key and the extra headers; no request is made.

    Raises:
        RapidError: the address is none or holds a secret, a variable that it names is not set, a header is none, or
            the proxy is of a kind that is not spoken.
    """
    check_names(config)
    secrets: list[str] = []

    def filled(match: re.Match[str]) -> str:
        value = os.environ.get(match[1], "").strip()
        if not value:
            raise RapidError(f"--teacher.base-url names the environment variable {match[1]}, which is not set.")
        secrets.append(value)
        return quote(value, safe="")

    address = _read_address(_VARIABLE.sub(filled, config.base_url), config.base_url)
    if address.proxy and address.proxy.authorization:
        coded = address.proxy.authorization.removeprefix("Basic ")
        secrets += [coded, *base64.b64decode(coded).decode().split(":", 1)]
    headers: dict[str, str] = {}
    key = os.environ.get(config.api_key_env, "").strip() if config.api_key_env else ""
    if key:
        _check_header("Authorization", key, f"The key in the environment variable {config.api_key_env}")
        headers["authorization"] = f"Bearer {key}"
        secrets.append(key)
    if config.headers_env:
        for name, value in _extra_headers(config.headers_env).items():
            headers[name] = value
            # What follows "Bearer" or the like may be repeated alone.
            secrets += [value, *value.split()]
    return Access(address, headers, tuple(secrets))


def _extra_headers(variable: str) -> dict[str, str]:
    """Read headers from a variable, one a line, as ``Name: value``."""
    headers: dict[str, str] = {}
    what = f"The environment variable {variable} (--teacher.headers-env)"
    for number, line in enumerate(os.environ.get(variable, "").splitlines(), 1):
        if not line.strip():
            continue
        name, colon, value = line.partition(":")
        name, value = name.strip().lower(), value.strip()
        if not colon:
            raise RapidError(f"{what} holds no header in line {number}. Write one a line, as Name: value.")
        _check_header(name, value, f"{what}, line {number},")
        if name in _OURS:
            raise RapidError(f"{what} must not hold the header '{name}', which the request sets itself.")
        headers[name] = value
    if not headers:
        raise RapidError(f"{what} holds no headers. Write one a line, as Name: value.")
    return headers


def _check_header(name: str, value: str, what: str) -> None:
    if not re.fullmatch(r"[A-Za-z0-9!#$%&'*+.^_`|~-]+", name) or not value.isascii() or not value.isprintable():
        raise RapidError(f"{what} holds characters that no header can carry. Was it copied whole, and nothing else?")


def _read_address(filled: str, given: str) -> Address:
    try:
        parts = urlsplit(filled)
        host, port = parts.hostname or "", parts.port
        usable = parts.scheme in ("http", "https") and bool(host) and port != 0
        host = host if host.isascii() else host.encode("idna").decode()
    except ValueError:
        usable = False
        parts, host, port = urlsplit(""), "", None
    if not usable or not filled.isprintable() or " " in filled:
        raise RapidError(
            f"The address '{given}' cannot be used. Give --teacher.base-url an address such as "
            "http://127.0.0.1:8000/v1."
        )
    tls = parts.scheme == "https"
    # People copy the whole address of an example.
    path = parts.path.rstrip("/").removesuffix("/chat/completions")
    safe = "/%:@!$&'()*+,;=~-._"
    return Address(
        tls, host, port or (443 if tls else 80), quote(path, safe), quote(parts.query, safe + "?"), _proxy(tls, host)
    )


def is_loopback(host: str) -> bool:
    """Say whether a host is this machine itself."""
    try:
        return ip_address(host.partition("%")[0]).is_loopback
    except ValueError:
        return host.lower().rstrip(".") in ("localhost", "localhost.localdomain") or host.lower().endswith(".localhost")


def _proxy(tls: bool, host: str) -> Proxy | None:
    """Return the proxy that the surroundings ask for; this machine itself is never reached through one."""
    if is_loopback(host) or urllib.request.proxy_bypass(host):
        return None
    proxies = urllib.request.getproxies()
    kind = "https" if tls else "http"
    kind = kind if proxies.get(kind) else "all"
    if not (value := proxies.get(kind)):
        return None
    names = (f"{kind.upper()}_PROXY", f"{kind}_proxy")
    variable = next((name for name in names if os.environ.get(name)), "the system's proxy setting")
    try:
        parts = urlsplit(value if "://" in value else f"http://{value}")
        port, name = parts.port or 80, parts.hostname or ""
    except ValueError:
        _refuse_proxy(variable, "is no address")
    if parts.scheme != "http" or not name:
        _refuse_proxy(variable, f"asks for a proxy of the kind '{parts.scheme}', and only http:// proxies are spoken")
    authorization = ""
    if parts.username is not None:
        words = f"{unquote(parts.username)}:{unquote(parts.password or '')}"
        authorization = f"Basic {base64.b64encode(words.encode()).decode()}"
    return Proxy(name, port, variable, authorization)


def _refuse_proxy(variable: str, why: str) -> NoReturn:
    raise RapidError(
        f"{variable} {why}. Set it to an address such as http://proxy:3128, or add the server's host to NO_PROXY."
    )


def _looks_secret(text: str) -> bool:
    """Say whether a text looks like a key: long, without a break, of letters and digits; names are made of words."""
    if re.match(r"(sk|pk|rk|gsk|hf|xai|ghp|glpat)[-_]\w{8,}", text):
        return True
    runs = re.findall(r"[A-Za-z0-9]{20,}", text)
    return any(re.search(r"[A-Za-z]", run) and re.search(r"\d", run) for run in runs)
