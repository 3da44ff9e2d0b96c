"""An OpenAI-compatible server on the loopback that plays every fault a real one has."""

import json
import threading
import time
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

KEEP = '{"explanation": "calm road", "action": "keep"}'


def completion(text: str | None = KEEP, logprobs: object = None, **message) -> dict:
    return {
        "id": "1",
        "object": "chat.completion",
        "created": 1,
        "model": "m",
        "choices": [
            {
                "index": 0,
                "finish_reason": "stop",
                "message": {"role": "assistant", "content": text, **message},
                "logprobs": logprobs,
            }
        ],
        "usage": {"prompt_tokens": 11, "completion_tokens": 7, "total_tokens": 18},
    }


class Server:
    """Plays a list of acts, one per request, the last one for ever; an act gets the handler and the request."""

    def __init__(self) -> None:
        self.acts: list = [answer(completion())]
        self.requests: list[dict] = []
        self.authorization: list[str | None] = []
        server = self

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
                server.requests.append(request)
                server.authorization.append(self.headers["Authorization"])
                server.play(self, request)

            def do_GET(self) -> None:
                server.play(self, {})

            def log_message(self, *args) -> None:
                pass

        self.http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.http.daemon_threads = True
        threading.Thread(target=self.http.serve_forever, kwargs={"poll_interval": 0.01}, daemon=True).start()
        self.url = f"http://127.0.0.1:{self.http.server_port}/v1"

    def play(self, handler: BaseHTTPRequestHandler, request: dict) -> None:
        act = self.acts.pop(0) if len(self.acts) > 1 else self.acts[0]
        act(handler, request)

    def close(self) -> None:
        self.http.shutdown()
        self.http.server_close()


def answer(body, status=200, headers=None):
    def act(handler, request) -> None:
        content = body.encode() if isinstance(body, str) else json.dumps(body).encode()
        handler.send_response(status)
        for name, value in {"Content-Type": "application/json", **(headers or {})}.items():
            handler.send_header(name, value)
        handler.send_header("Content-Length", str(len(content)))
        handler.end_headers()
        handler.wfile.write(content)

    return act


def drop(handler, request) -> None:
    handler.close_connection = True
    handler.connection.close()


def hang(handler, request) -> None:
    time.sleep(1.0)
    drop(handler, request)


def refuse(status, text="no", **headers):
    return answer({"error": {"message": text}}, status, headers)
