"""Offline CQL of d3rlpy on a dataset of RAPID's; the policy comes back as an agent that `rapid evaluate` drives.

d3rlpy pins an old Gymnasium, so it has an environment of its own, and this script runs twice:

    python d3rlpy_dqn.py export shipped:lane-3-density-2/rule data.h5        # where RAPID is installed
    pip install d3rlpy onnx && python d3rlpy_dqn.py train data.h5 d3rlpy.onnx   # where d3rlpy is
    rapid evaluate d3rlpy.onnx idle faster                                   # where RAPID is

The second part imports nothing of RAPID. The file holds observations of 15 vehicles x 5 columns, flattened.
"""

import argparse
import warnings

WIDTH, ACTIONS = 75, 5
UNITS = [1.0, 100.0, 12.0, 20.0, 5.0] * 15
"""What the columns presence, x, y, vx, vy are divided by; m and m/s."""


def export(source: str, path: str) -> None:
    """Write a dataset as d3rlpy reads it."""
    import rapid
    from rapid.data.exchange import export_d3rlpy

    dataset = rapid.load_dataset(source)
    export_d3rlpy(dataset, path)
    print(f"{path}: {dataset!r}")


def train(path: str, out: str, steps: int, seed: int) -> None:
    """Train on the file and write the mean of the Q-functions as ONNX."""
    import d3rlpy
    import numpy as np
    import torch

    d3rlpy.seed(seed)
    with open(path, "rb") as file:
        buffer = d3rlpy.dataset.ReplayBuffer.load(file, d3rlpy.dataset.InfiniteBuffer())
    scale = d3rlpy.preprocessing.MinMaxObservationScaler(
        minimum=-np.array(UNITS, np.float32), maximum=np.array(UNITS, np.float32)
    )
    learner = d3rlpy.algos.DiscreteCQLConfig(
        learning_rate=3e-4, batch_size=128, gamma=0.95, target_update_interval=500, observation_scaler=scale
    ).create(device="cpu:0")
    learner.fit(buffer, n_steps=steps, n_steps_per_epoch=max(steps // 10, 1), save_interval=10**9, show_progress=False,
                logger_adapter=d3rlpy.logging.NoopAdapterFactory())  # fmt: skip

    class Policy(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.functions = learner.impl.modules.q_funcs
            self.register_buffer("units", torch.tensor(UNITS))

        def forward(self, rows: torch.Tensor) -> torch.Tensor:
            return torch.stack([function(rows / self.units).q_value for function in self.functions]).mean(0)

    policy = Policy().eval()
    rows = torch.randn(64, WIDTH)
    assert (policy(rows).argmax(1).numpy() == learner.predict(rows.numpy())).all()  # d3rlpy's own decisions
    batch = {"obs": {0: "batch"}, "q": {0: "batch"}}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # torch's newer exporter needs one more package
        torch.onnx.export(
            policy, (rows,), out, input_names=["obs"], output_names=["q"], dynamic_axes=batch, dynamo=False
        )
    print(f"{out} is an agent: rapid evaluate {out}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parts = parser.add_subparsers(dest="part", required=True)
    first = parts.add_parser("export")
    first.add_argument("dataset")
    first.add_argument("path")
    second = parts.add_parser("train")
    second.add_argument("path")
    second.add_argument("out")
    second.add_argument("--steps", type=int, default=10_000)
    second.add_argument("--seed", type=int, default=0)
    chosen = parser.parse_args()
    if chosen.part == "export":
        export(chosen.dataset, chosen.path)
    else:
        train(chosen.path, chosen.out, chosen.steps, chosen.seed)
