"""A live page that is served, and one small agent that is saved."""

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from rapid.agents.saved import save_agent
from rapid.config import NetworkConfig
from rapid.networks.q_network import build_network
from rapid.play.roster import Roster
from rapid.play.server import LivePage

SCENARIO = "lane-3-density-2"


@pytest.fixture(scope="session")
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A small mixture of policies, untrained, with an open gate."""
    folder = tmp_path_factory.mktemp("runs") / "tiny" / "adapt" / "rapid" / "agent"
    network = build_network(NetworkConfig(kind="rapid", width=16, layers=1, decoder_layers=1, heads=2), 3, seed=1)
    network.gate.data.fill_(0.5)  # type: ignore[union-attr]
    save_agent(folder, network, {"name": "<b>mixture</b>", "scenario": SCENARIO})
    return folder


@pytest.fixture(scope="session")
def roster(saved: Path) -> Roster:
    """Who can be chosen in these tests."""
    return Roster((str(saved),))


@pytest.fixture
def live(roster: Roster, saved: Path) -> Iterator[LivePage]:
    """A live page that answers."""
    page = LivePage(roster, {"scenario": SCENARIO, "spawn": "900000", "left": str(saved), "right": "slower"})
    thread = threading.Thread(target=page.serve_forever, daemon=True)
    thread.start()
    yield page
    page.close()
    thread.join(5)
