"""A real server, llama.cpp's with a small model, end to end: loaded, asked, killed in the middle and started again."""

import socket
import subprocess
import sys
import threading
import time

import pytest

from rapid.config import TeacherConfig
from rapid.teacher import make_teacher, models
from rapid.teacher.chat import Request
from rapid.teacher.endpoint import Endpoint

pytestmark = pytest.mark.slow

MODEL = "smollm2-135m"
SERVE = """
import sys, time, xllamacpp
settings = xllamacpp.CommonParams()
settings.model.path, settings.port = sys.argv[1], int(sys.argv[2])
settings.n_ctx, settings.n_parallel, settings.cpuparams.n_threads, settings.use_jinja = 16384, 4, 1, True
settings.warmup, settings.model_alias = False, {"small"}
server = xllamacpp.Server(settings)
while True:
    time.sleep(1)
"""


class Llama:
    """The server in a process of its own, at a port that stays."""

    def __init__(self) -> None:
        self.path = models.verify(MODEL)
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.start()

    def start(self) -> None:
        command = [sys.executable, "-c", SERVE, str(self.path), str(self.port)]
        self.process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def restart_after(self, seconds: float) -> None:
        time.sleep(seconds)
        self.kill()
        self.start()

    def kill(self) -> None:
        self.process.kill()
        self.process.wait()


@pytest.fixture(scope="module")
def llama():
    pytest.importorskip("xllamacpp")
    if not models.is_present(MODEL):
        pytest.skip(f"needs a model: rapid models pull {MODEL}")
    server = Llama()
    yield server
    server.kill()


def config_for(llama: Llama, **changes) -> TeacherConfig:
    values = {"timeout_s": 120.0, "max_retries": 8, "concurrency": 4, "max_answer_tokens": 12, **changes}
    url = f"http://127.0.0.1:{llama.port}/v1"
    return TeacherConfig(backend="endpoint", model="small", base_url=url, api_key_env="", **values)


def test_its_models_are_listed_once_it_is_there(llama):
    # Nobody listens yet: the connection is refused, and tried again.
    assert "small" in Endpoint(config_for(llama)).models()


def test_probabilities_and_numbers_of_tokens_are_its_own(llama, capsys):
    question = [{"role": "system", "content": "Answer with one word."}, {"role": "user", "content": "Left or right?"}]
    reply = Endpoint(config_for(llama)).ask(Request(question, [], None, logprobs=True))
    assert (reply.estimated, reply.model) == (False, "small")
    assert 10 < reply.tokens_in < 60
    assert len(reply.tokens) == reply.tokens_out or len(reply.tokens) == reply.tokens_out - 1
    assert all(len(token.alternatives) >= 20 for token in reply.tokens)
    assert not capsys.readouterr().err


@pytest.mark.parametrize("style", ["digest", "react"])
def test_both_styles_go_on_over_a_kill_and_a_restart(llama, crowd, style, capsys):
    teacher = make_teacher(config_for(llama, style=style, max_turns=1), 3)
    before = teacher.decide(crowd[:1], [None])
    seen = threading.Thread(target=llama.restart_after, args=(0.5,))
    seen.start()
    after = teacher.decide(crowd[1:4], [None] * 3)
    seen.join()
    decisions = [*before, *after, *teacher.decide(crowd[4:5], [None])]
    # So small a model decides little; but it was heard out each time, and nothing was made up for it.
    assert [decision.error for decision in decisions if decision.unanswered] == []
    assert any(decision.retries for decision in after)
    assert all(decision.tokens_in > 100 and decision.tokens_out >= 1 and decision.answer for decision in decisions)
    said = capsys.readouterr().err
    assert "estimated" not in said
    assert "refused" not in said.replace("connection refused", "")
