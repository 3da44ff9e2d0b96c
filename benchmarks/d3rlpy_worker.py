"""d3rlpy's side of the comparison; runs in d3rlpy's own environment and imports nothing of RAPID.

Reads one JSON request a line on the standard input and answers each with one line of JSON; files carry the arrays.
"""

import json
import logging
import sys
import time
from importlib.metadata import version

import d3rlpy
import numpy as np
import structlog
import torch
from d3rlpy.torch_utility import TorchMiniBatch

KINDS = {
    "dqn": d3rlpy.algos.DQNConfig,
    "ddqn": d3rlpy.algos.DoubleDQNConfig,
    "cql": d3rlpy.algos.DiscreteCQLConfig,
}


def make(kind, learning_rate, batch_size, target_update, discount, hidden):
    """Return an algorithm for observations of 75 numbers and 5 actions."""
    config = KINDS[kind](
        learning_rate=learning_rate,
        batch_size=batch_size,
        target_update_interval=target_update,
        gamma=discount,
        encoder_factory=d3rlpy.models.VectorEncoderFactory(hidden),
    )
    algorithm = config.create(device="cpu:0")
    algorithm.create_impl((75,), 5)
    return algorithm


def linears(modules):
    """Return the linear layers of a Q-function from the input to the output."""
    return [module for module in modules.modules() if isinstance(module, torch.nn.Linear)]


def load(modules, file, prefix):
    """Copy weights out of an .npz file."""
    with torch.no_grad():
        for index, layer in enumerate(linears(modules)):
            layer.weight.copy_(torch.from_numpy(file[f"{prefix}.weight{index}"]))
            layer.bias.copy_(torch.from_numpy(file[f"{prefix}.bias{index}"]))


def losses(request):
    """Return the terms of the loss on a given batch with given weights."""
    file = np.load(request["file"])
    algorithm = make(**request["settings"])
    modules = algorithm.impl.modules
    load(modules.q_funcs, file, "online")
    load(modules.targ_q_funcs, file, "target")
    column = {name: torch.from_numpy(file[name])[:, None] for name in ("actions", "rewards", "terminals")}
    batch = TorchMiniBatch(
        observations=torch.from_numpy(file["observations"]),
        actions=column["actions"],
        rewards=column["rewards"],
        next_observations=torch.from_numpy(file["next_observations"]),
        next_actions=column["actions"],
        returns_to_go=torch.zeros_like(column["rewards"]),
        terminals=column["terminals"],
        intervals=torch.ones_like(column["rewards"]),
        device="cpu:0",
    )
    loss = algorithm.impl.compute_loss(batch, algorithm.impl.compute_target(batch))
    loss.loss.backward()
    np.savez(
        request["out"],
        **{f"weight{index}": layer.weight.grad.numpy() for index, layer in enumerate(linears(modules.q_funcs))},
        **{f"bias{index}": layer.bias.grad.numpy() for index, layer in enumerate(linears(modules.q_funcs))},
    )
    return {
        name: getattr(loss, name).item() for name in ("loss", "td_loss", "conservative_loss") if hasattr(loss, name)
    }


class Worker:
    """Holds the algorithm and the data between requests."""

    def start(self, request):
        """Make an algorithm, and load data once."""
        d3rlpy.seed(request["seed"])
        with open(request["data"], "rb") as stream:
            self.data = d3rlpy.dataset.ReplayBuffer.load(stream, d3rlpy.dataset.InfiniteBuffer())
        self.algorithm = make(**request["settings"])
        return {"transitions": self.data.transition_count}

    def fit(self, request):
        """Train for some steps and return the seconds."""
        start = time.perf_counter()
        self.algorithm.fit(
            self.data,
            n_steps=request["steps"],
            n_steps_per_epoch=request["steps"],
            show_progress=False,
            logger_adapter=d3rlpy.logging.NoopAdapterFactory(),
        )
        return {"seconds": time.perf_counter() - start}

    def weights(self, request):
        """Write the Q-network's weights."""
        layers = linears(self.algorithm.impl.modules.q_funcs)
        arrays = {f"online.weight{index}": layer.weight.detach().numpy() for index, layer in enumerate(layers)}
        arrays |= {f"online.bias{index}": layer.bias.detach().numpy() for index, layer in enumerate(layers)}
        np.savez(request["out"], **arrays)
        return {}

    def versions(self, request):
        """Return the versions that matter."""
        return {name: version(name) for name in ("d3rlpy", "torch", "numpy")}

    losses = staticmethod(losses)


def main():
    """Answer requests until the input ends."""
    torch.set_num_threads(1)
    structlog.configure(wrapper_class=structlog.make_filtering_bound_logger(logging.ERROR))
    answers, sys.stdout = sys.stdout, sys.stderr
    worker = Worker()
    for line in sys.stdin:
        request = json.loads(line)
        print(json.dumps(getattr(worker, request["do"])(request)), file=answers, flush=True)


if __name__ == "__main__":
    main()
