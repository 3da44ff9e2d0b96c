"""The server of the live page: this machine only, behind a secret in the address, for the page's own script alone."""

import errno
import hmac
import http
import json
import logging
import os
import secrets
import socket
import sys
import threading
import traceback
import webbrowser
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from urllib.parse import parse_qsl, urlencode

from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response
from websockets.sync.server import Server, ServerConnection
from websockets.sync.server import serve as serve_sockets

from rapid.errors import RapidError
from rapid.pages import PLAYER, fill_page
from rapid.pages.episodes import ACTION_WORDS
from rapid.pages.markup import tag
from rapid.play.ride import ALONG, KINDS, MOST_METRES
from rapid.play.roster import Roster
from rapid.play.session import Session
from rapid.scenarios import PAPER_SCENARIOS, SCENARIOS, get_scenario

HOST = "127.0.0.1"
MOST_TABS = 8
"""Tabs that are answered at the same time."""
MOST_BYTES = 1 << 16
"""Of one message; the page's own have a few hundred."""


@dataclass
class LivePage:
    """The live page and who answers it.

    Args:
        roster: who can be chosen.
        start: what is chosen at first: `scenario`, `spawn`, `left`, `right`, and what else a link to a moment has.
        port: 0 for a free one.
        seed: decides the noise of attacks and drivers that draw.

    Raises:
        RapidError: the port cannot be had.
    """

    roster: Roster
    start: Mapping[str, str] = field(default_factory=dict[str, str])
    port: int = 0
    seed: int = 0

    def __post_init__(self) -> None:
        self.token = secrets.token_urlsafe(24)
        self._lock, self._tabs = threading.Lock(), threading.BoundedSemaphore(MOST_TABS)
        try:
            self._listening = socket.create_server((HOST, self.port))
        except (OSError, OverflowError) as error:
            taken = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
            why = "is in use by another program" if taken else f"cannot be had: {error}"
            raise RapidError(
                f"Port {self.port} {why}. Choose another with --port, or leave it out for a free one."
            ) from error
        self._serving = False
        self.port = int(self._listening.getsockname()[1])
        self._hosts = (f"{HOST}:{self.port}", f"localhost:{self.port}")
        # What a browser does wrong is answered; it is no news for a terminal.
        quiet = logging.getLogger("rapid.play")
        quiet.setLevel(logging.CRITICAL)
        self._server: Server = serve_sockets(
            self._talk,
            sock=self._listening,
            origins=[f"http://{host}" for host in self._hosts],  # type: ignore[arg-type]
            process_request=self._page_or_socket,
            compression=None,
            max_size=MOST_BYTES,
            server_header=None,
            logger=quiet,
        )

    @property
    def address(self) -> str:
        """Where the page is; whoever knows it may use it."""
        moment = f"#{urlencode(self.start)}" if self.start else ""
        return f"http://{HOST}:{self.port}/{self.token}/{moment}"

    def serve_forever(self) -> None:
        """Answer until :meth:`close` is called."""
        self._serving = True
        self._server.serve_forever()

    def close(self) -> None:
        """Stop answering and close what is open."""
        if self._serving:
            self._server.shutdown()
        else:
            self._listening.close()  # shutdown would wait for a loop that never began

    def _talk(self, connection: ServerConnection) -> None:
        if not self._tabs.acquire(blocking=False):
            words = f"{MOST_TABS} tabs drive already. Close one, and load this page again."
            connection.send(json.dumps({"type": "error", "pane": None, "ride": None, "message": words}))
            connection.close(1013, "too many tabs")
            return
        try:
            session = Session(self.roster, self._lock, self.seed)
            for text in connection:
                connection.send(session.answer(text if isinstance(text, str) else ""))
        except ConnectionClosed:
            # A tab may go at any time, in the middle of an episode too; its episodes go with it.
            pass
        except Exception:
            traceback.print_exc()  # a fault of ours: the tab says that the connection was lost, and tries again
            raise
        finally:
            self._tabs.release()

    def _page_or_socket(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request, or return None to let a WebSocket be opened."""
        if request.headers.get("Host") not in self._hosts:
            # Another name that leads here is how a page of somebody else would reach us.
            return _response(http.HTTPStatus.FORBIDDEN, "This page is for this machine only.\n")
        path = request.path.partition("?")[0]
        if path == "/favicon.ico":
            return _response(http.HTTPStatus.NO_CONTENT, "")
        token, _, rest = path.removeprefix("/").partition("/")
        if not hmac.compare_digest(token.encode(), self.token.encode()):
            return _response(http.HTTPStatus.NOT_FOUND, "There is no such page. `rapid play` printed the address.\n")
        if rest == "live":
            return None
        if rest:
            return _response(http.HTTPStatus.NOT_FOUND, "There is no such page.\n")
        return _response(http.HTTPStatus.OK, self.page(), "text/html")

    def page(self) -> str:
        """Return the page as HTML."""
        entries = self.roster.entries.values()
        sockets = " ".join(f"ws://{host}" for host in self._hosts)
        body = tag("div", id="live")
        return fill_page(
            "RAPID, live",
            body,
            {
                "actions": ACTION_WORDS,
                "agents": [vars(entry) for entry in entries],
                "scenarios": [{"name": name, "lanes": get_scenario(name).lanes} for name in SCENARIOS],
                "attacks": [{"key": kind.key, "label": kind.label} for kind in KINDS.values()],
                "along": ALONG,
                "metres": MOST_METRES,
            },
            scripts=(*PLAYER, "moment.js", "live.js"),
            styles=("base.css", "player.css", "live.css"),
            connect=sockets,
        )


def _response(status: http.HTTPStatus, body: str, kind: str = "text/plain") -> Response:
    content = body.encode()
    headers = Headers(
        {
            "Content-Type": f"{kind}; charset=utf-8",
            "Content-Length": str(len(content)),
            "Connection": "close",
            "Cache-Control": "no-store",
            "Referrer-Policy": "no-referrer",
            "X-Content-Type-Options": "nosniff",
            "X-Frame-Options": "DENY",
            "Cross-Origin-Opener-Policy": "same-origin",
            "Cross-Origin-Resource-Policy": "same-origin",
        }
    )
    return Response(status.value, status.phrase, headers, content)


def first_moment(
    roster: Roster, agents: Sequence[str], scenario: str = "", spawn: int = 900_000, moment: str = ""
) -> dict[str, str]:
    """Return what the page shows first, as :class:`LivePage` takes it.

    Args:
        roster: who can be chosen.
        agents: who drives above and below, as far as they are named; without any, an agent of one's own or a
            shipped one, and a rule.
        scenario: where; empty for where the first of them was trained.
        spawn: the spawn seed.
        moment: what a link to a moment has behind its ``#``, which goes before all else.

    Raises:
        RapidError: an unknown driver, in the moment too.
    """
    if moment:
        words = dict(parse_qsl(moment.rpartition("#")[2]))
        for pane in ("left", "right"):
            if pane in words:
                roster.entry(words[pane])
        if "scenario" not in words:
            raise RapidError(f"'{moment:.80}' is no moment. Give what a link of the page has behind its #.")
        return words | {"scenario": get_scenario(words["scenario"]).name}
    learned = [entry.key for entry in roster.entries.values() if entry.group in ("learned", "shipped")]
    place = scenario or PAPER_SCENARIOS[0]
    # The newest of one's own, else the package's own for this road.
    best = sorted(learned, key=lambda key: (roster.entry(key).group == "shipped", key != f"shipped:{place}/rapid"))
    left, right = [*agents, *([] if agents else best[:1]), "rule-foresight", "rule"][:2]
    own = roster.entry(left).scenario or roster.entry(right).scenario or PAPER_SCENARIOS[0]
    return {"scenario": scenario or own, "spawn": str(spawn), "left": left, "right": right}


def serve(
    roster: Roster,
    start: Mapping[str, str],
    port: int = 0,
    seed: int = 0,
    show: bool = True,
    say: Callable[[str], None] = print,
    opener: Callable[[str], Any] | None = None,
) -> None:
    """Serve the live page until interrupted.

    Args:
        roster: who can be chosen.
        start: what is chosen at first; see :class:`LivePage`.
        port: 0 for a free one.
        seed: decides the noise of attacks and drivers that draw.
        show: whether a browser is asked to open the page.
        say: receives a line at a time.
        opener: opens an address in a browser, and says whether it could; by default the desktop's own.

    Raises:
        RapidError: the port cannot be had.
    """
    live = LivePage(roster, dict(start), port, seed)
    say(f"The live page: {live.address}")
    say("It answers this machine only. End it with Ctrl-C.")
    if show and not _opens(opener or _desktop, live.address):
        say("No browser could be opened from here: open the address above in one.")
    try:
        live.serve_forever()
    except KeyboardInterrupt:
        say("\nThe live page has ended.")
    finally:
        live.close()


def _desktop(address: str) -> bool:
    # Without a desktop Python would start a browser for terminals in this one.
    if sys.platform.startswith("linux") and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        return False
    return webbrowser.open(address)


def _opens(opener: Callable[[str], Any], address: str) -> bool:
    try:
        return bool(opener(address))
    except Exception:  # whatever a desktop's own programs raise, the address is there to be opened by hand
        return False
