"""Training on a GPU; skipped where there is none."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from rapid.agents.saved import load_agent, save_agent
from rapid.config import Config, LossConfig, OptimizerConfig
from rapid.data.batch import with_rows
from rapid.data.dataset import load_dataset, mix
from rapid.data.replay import OfflineSampler
from rapid.networks.conversions import widened
from rapid.networks.q_network import build_network, set_phase
from rapid.presets import preset
from rapid.training import offline
from rapid.training.learner import Learner
from rapid.training.machinery.capture import WARM_UP
from rapid.training.online import adapt
from rapid.training.ppo import adapt_by_ppo

pytestmark = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")

SCENARIO = "lane-3-density-2"
STRONG, PAPER = preset("strong", "full"), preset("paper", "full")
UPDATES = WARM_UP + 12


@pytest.fixture(scope="module")
def transitions():
    """300 transitions, half of them the teacher's."""
    parts = [load_dataset(f"shipped:{SCENARIO}/{name}") for name in ("teacher", "random")]
    return mix(*parts, 0.5, 300, 0).transitions


def learner_on(device: str, config: Config, loss: LossConfig, optimizer: OptimizerConfig, phase: str) -> Learner:
    """Return a learner at the beginning of a phase; while adapting with the gate open."""
    network = build_network(config.network, 3, 0).to(device)
    set_phase(network, phase)
    if phase == "adapt":
        torch.nn.init.constant_(network.gate, 0.3)
    return Learner(network, optimizer, loss, 4 * UPDATES, torch.Generator(device).manual_seed(0))


CASES = {
    "strong": (STRONG, STRONG.distill.loss, STRONG.distill.optimizer, "distill"),
    "paper": (PAPER, PAPER.distill.loss, PAPER.distill.optimizer, "distill"),
    "adapt": (STRONG, preset("strong", "full", "ppo").adapt.loss, STRONG.adapt.optimizer, "adapt"),
    "mirror": (
        replace(STRONG, network=replace(STRONG.network, mirror=True)),
        STRONG.distill.loss,
        STRONG.distill.optimizer,
        "distill",
    ),
    "bc": (STRONG, STRONG.distill.loss, replace(STRONG.distill.optimizer, algorithm="bc"), "distill"),
    "mlp": (
        replace(PAPER, network=replace(PAPER.network, kind="mlp")),
        replace(PAPER.distill.loss, robust_weight=0.0),
        PAPER.distill.optimizer,
        "distill",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_a_recorded_update_is_the_update(case, transitions):
    config, loss, optimizer, phase = CASES[case]
    recorded = learner_on("cuda", config, loss, optimizer, phase)
    plain = learner_on("cuda", config, loss, optimizer, phase)
    plain._step = plain._take_step
    sampler = OfflineSampler(transitions, loss.discount, loss.n_step, "cuda")
    rng = np.random.default_rng(0)
    for _ in range(UPDATES):
        batch = sampler.sample(32, rng)
        recorded.update(batch)
        plain.update(batch)
    torch.testing.assert_close(recorded.means(), plain.means(), rtol=1e-4, atol=1e-6)
    start = build_network(config.network, 3, 0).state_dict()
    for name, weight in recorded.network.state_dict().items():
        torch.testing.assert_close(weight, plain.network.state_dict()[name], rtol=1e-3, atol=1e-5)
    moved = [name for name, weight in plain.network.state_dict().items() if not torch.equal(weight.cpu(), start[name])]
    assert moved


@pytest.mark.parametrize(("case", "runs"), [("strong", False), ("adapt", True)])
def test_a_recording_runs_the_adapter_only_where_its_gate_is_open(case, runs, transitions):
    learner = learner_on("cuda", *CASES[case])
    adapter = learner.network.head.mixture.policies[1]
    recorded = []
    adapter.register_forward_hook(lambda *_: recorded.append(torch.cuda.is_current_stream_capturing()))
    sampler, rng = OfflineSampler(transitions, 0.9, 1, "cuda"), np.random.default_rng(0)
    for _ in range(UPDATES):
        learner.update(sampler.sample(32, rng))
    assert any(recorded) == runs


@pytest.mark.parametrize("case", ["paper", "mlp"])
def test_it_learns_what_the_cpu_learns(case, transitions):
    config, loss, optimizer, phase = CASES[case]
    learners = [learner_on(device, config, loss, optimizer, phase) for device in ("cpu", "cuda")]
    for learner, device in zip(learners, ("cpu", "cuda"), strict=True):
        sampler, rng = OfflineSampler(transitions, loss.discount, loss.n_step, device), np.random.default_rng(0)
        for _ in range(UPDATES):
            learner.update(sampler.sample(32, rng))
    # In raw metres the values are large, and float32 sums in another order differ.
    cpu, cuda = (learner.means() for learner in learners)
    assert cuda["td"] == pytest.approx(cpu["td"], rel=0.02)
    assert cuda["total"] == pytest.approx(cpu["total"], rel=0.02)


def test_other_batches_than_the_recorded_are_computed(transitions):
    recorded, plain = (learner_on("cuda", *CASES["adapt"]) for _ in range(2))
    plain._step = plain._take_step
    sampler, rng = OfflineSampler(transitions, 0.9, 1, "cuda"), np.random.default_rng(0)
    for size in (*[32] * (WARM_UP + 2), 7, 32):
        batch = sampler.sample(size, rng)
        before = {name: weight.clone() for name, weight in recorded.network.state_dict().items()}
        recorded.update(batch)
        plain.update(batch)
        # A batch that a recording does not hold must move the weights too, and as a plain step does.
        assert any(not torch.equal(weight, before[name]) for name, weight in recorded.network.state_dict().items())
        for name, weight in recorded.network.state_dict().items():
            torch.testing.assert_close(weight, plain.network.state_dict()[name], rtol=1e-3, atol=1e-5)


def test_a_frozen_policy_stays_bit_equal_while_the_adapter_learns(transitions):
    learner = learner_on("cuda", *CASES["adapt"])
    before = {name: weight.clone() for name, weight in learner.network.state_dict().items()}
    sampler, rng = OfflineSampler(transitions, 0.9, 1, "cuda"), np.random.default_rng(0)
    for _ in range(UPDATES):
        learner.update(sampler.sample(32, rng))
    for name, weight in learner.network.state_dict().items():
        if name.startswith("head.mixture.policies.0."):
            assert torch.equal(weight, before[name])
        elif name.startswith("head.mixture.policies.1.") and name.endswith("weight"):
            assert not torch.equal(weight, before[name])


@pytest.mark.parametrize("stop", [2, WARM_UP + 20])
def test_resumed_equals_uninterrupted(transitions, tmp_path, monkeypatch, stop):
    monkeypatch.setattr(offline, "LOG_EVERY", 1)
    config = replace(STRONG.distill, iterations=40, evaluate_every=0)

    def train(home: str) -> dict[str, torch.Tensor]:
        network = build_network(STRONG.network, 3, 0).to("cuda")
        offline.distill(transitions, network, config, tmp_path / home, 0, checkpoint_seconds=0.0)
        return network.state_dict()

    def dying(self, batch):
        if self.updates == stop:
            raise KeyboardInterrupt
        update(self, batch)

    whole = train("whole")
    update = Learner.update
    with monkeypatch.context() as patch:
        patch.setattr(Learner, "update", dying)
        with pytest.raises(KeyboardInterrupt):
            train("cut")
    for name, weight in train("cut").items():
        torch.testing.assert_close(weight, whole[name], rtol=1e-3, atol=1e-5)


def test_phase_3_trains_there_and_the_agent_drives_on_a_cpu(transitions, tmp_path):
    config = replace(preset("strong", "tiny").adapt, evaluate_every=0)
    network = widened(build_network(STRONG.network, 3, 0).to("cuda"), 20)
    adapt(network, config, SCENARIO, tmp_path / "adapt", 0, transitions)
    ppo = replace(config.ppo, steps=200, num_envs=4, rollout=10, batch_size=16, critic_steps=40)
    before = {name: weight.clone() for name, weight in network.state_dict().items()}
    adapt_by_ppo(network, replace(config, ppo=ppo), SCENARIO, tmp_path / "ppo", 0)
    same = {name for name, weight in network.state_dict().items() if torch.equal(weight, before[name])}
    assert {name for name in before if name.startswith("head.mixture.policies.0.")} <= same
    assert "head.mixture.gate_NV" not in same
    save_agent(tmp_path / "agent", network, {})
    there, here = load_agent(tmp_path / "agent", "cuda"), load_agent(tmp_path / "agent")
    obs_BVF = with_rows(torch.from_numpy(transitions.obs_NVF[:20]), 20).numpy()
    np.testing.assert_allclose(there.q_values(obs_BVF), here.q_values(obs_BVF), rtol=1e-3, atol=1e-3)
