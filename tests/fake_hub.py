"""A Hugging Face Hub on the loopback: repositories, commits, downloads, and the refusals of the real one."""

import base64
import hashlib
import json
import re
import threading
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from urllib.parse import urlparse

TOKEN = "hf_secretSecretSecret1234567890"


class Hub:
    """Repositories by (kind, OWNER/NAME), each a dictionary of file -> content; kinds are models and datasets."""

    def __init__(self) -> None:
        self.repos: dict[tuple[str, str], dict[str, bytes]] = {}
        self.private: set[str] = set()
        self.failing: tuple[int, str] | None = None
        """A status and words that answer every request."""
        self.asked: list[str] = []
        self.created: list[dict] = []
        hub = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def respond(self) -> None:
                body = self.rfile.read(int(self.headers.get("Content-Length") or 0))
                hub.asked.append(f"{self.command} {self.path}")
                hub.answer(self, urlparse(self.path).path, body)

            do_GET = do_HEAD = do_POST = respond

            def log_message(self, *args) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.http.server_port}"

    def close(self) -> None:
        self.http.shutdown()
        self.http.server_close()

    def commit(self, kind: str, name: str) -> str:
        files = self.repos[kind, name]
        return hashlib.sha1(repr(sorted((file, content) for file, content in files.items())).encode()).hexdigest()

    def answer(self, handler: BaseHTTPRequestHandler, path: str, body: bytes) -> None:
        may = handler.headers.get("Authorization") == f"Bearer {TOKEN}"
        if self.failing:
            return _send(handler, {"error": self.failing[1]}, self.failing[0])
        if path == "/api/validate-yaml":
            return _send(handler, {"errors": [], "warnings": []})
        if path == "/api/repos/create":
            if not may:
                return _send(handler, {"error": f"no write access for {handler.headers['Authorization']}"}, 403)
            wanted = json.loads(body)
            name = f"{wanted.get('organization')}/{wanted['name']}"
            self.created.append(wanted)
            self.repos.setdefault((f"{wanted.get('type', 'model')}s", name), {})
            return _send(handler, {"url": f"{self.url}/{name}"})
        found = re.fullmatch(r"/api/(models|datasets)/([^/]+/[^/]+)(?:/(\w+)/([^/]+).*)?", path)
        if not found:
            found = re.fullmatch(r"/(datasets/)?([^/]+/[^/]+)/(resolve)/([^/]+)/(.*)", path)
        if not found:
            return _send(handler, {"error": "no such address"}, 404)
        kind = found[1] if path.startswith("/api/") else (found[1] or "models/")[:-1]
        name, verb, revision = found[2], found[3] or "revision", found[4] or "main"
        if (kind, name) not in self.repos or (name in self.private and not may):
            return _send(handler, {"error": "not found"}, 404, {"X-Error-Code": "RepoNotFound"})
        files, commit = self.repos[kind, name], self.commit(kind, name)
        if revision not in ("main", commit):
            return _send(handler, {"error": "no revision"}, 404, {"X-Error-Code": "RevisionNotFound"})
        if verb == "revision":
            siblings = [{"rfilename": file, "size": len(content)} for file, content in files.items()]
            return _send(handler, {"id": name, "sha": commit, "siblings": siblings, "private": False, "tags": []})
        if verb == "tree":
            return _send(handler, [{"type": "file", "path": file, "size": 1, "oid": "0" * 40} for file in files])
        if verb == "preupload":
            listed = [entry["path"] for entry in json.loads(body)["files"]]
            modes = [{"path": file, "uploadMode": "regular", "shouldIgnore": False} for file in listed]
            return _send(handler, {"files": modes})
        if verb == "commit":
            for entry in map(json.loads, body.decode().splitlines()):
                if entry["key"] == "file":
                    files[entry["value"]["path"]] = base64.b64decode(entry["value"]["content"])
                elif entry["key"] == "deletedFile":
                    del files[entry["value"]["path"]]
            commit = self.commit(kind, name)
            return _send(handler, {"commitUrl": f"{self.url}/{name}/commit/{commit}", "commitOid": commit})
        content = files[found[5]]
        head = {"ETag": f'"{hashlib.sha1(content).hexdigest()}"', "X-Repo-Commit": commit}
        return _send(handler, content, 200, head)


def _send(handler: BaseHTTPRequestHandler, content: object, status: int = 200, headers: dict | None = None) -> None:
    body = content if isinstance(content, bytes) else json.dumps(content).encode()
    handler.send_response(status)
    for name, value in (headers or {}).items():
        handler.send_header(name, value)
    handler.send_header("Content-Length", str(len(body)))
    handler.end_headers()
    if handler.command != "HEAD":
        handler.wfile.write(body)
