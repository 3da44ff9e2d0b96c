"""The command as a user has it: a process that prints its address, answers, and ends at Ctrl-C though tabs are open."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from urllib.parse import urlsplit

from websockets.sync.client import connect

SCENARIO = "lane-3-density-2"


def test_ctrl_c_ends_it_while_a_tab_is_in_the_middle_of_an_episode(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "rapid.cli", "play", "slower", "rule", "--no-browser"]
    environment = dict(os.environ, PYTHONUNBUFFERED="1")
    with subprocess.Popen(
        command, cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            assert process.stdout is not None
            address = urlsplit(process.stdout.readline().split()[-1])
            assert f"scenario={SCENARIO}" in address.fragment
            assert "left=slower" in address.fragment
            place = f"ws://{address.netloc}{address.path}live"
            with connect(place, origin=f"http://{address.netloc}", proxy=None) as tab:  # type: ignore[arg-type]
                message = {"type": "open", "pane": 0, "ride": 1, "scenario": SCENARIO, "spawn": 1, "agent": "slower"}
                tab.send(json.dumps(message))
                assert json.loads(tab.recv(timeout=120))["type"] == "opened"
                process.send_signal(signal.SIGINT)
                words, errors = process.communicate(timeout=60)
            assert process.returncode == 0
            assert "has ended" in words
            assert "Traceback" not in errors
        finally:
            process.kill()
