"""What each kind of cell costs: seconds of processor time and bytes, from stores of finished cells.

Writes the rates from which `rapid reproduce` predicts, and prints them as a table. What these stores lack keeps the
rate that it had; `--anew` forgets it. Give stores of the scales `quick` or `full`: in a tiny cell, starting is most of
the time.

    python benchmarks/reproduce_rates.py runs/store
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from rapid.evaluation.summary import aligned
from rapid.experiments.cells import inputs, key
from rapid.experiments.compute import work_of
from rapid.experiments.costs import rates
from rapid.experiments.costs import sizes as sizes_on_disk
from rapid.experiments.exhibits import ALL, cells_of
from rapid.experiments.learned import EFFORTS
from rapid.experiments.store import Store
from rapid.files import write_text

RATES = Path(__file__).resolve().parents[1] / "src" / "rapid" / "experiments" / "rates.toml"
HEAD = "# Seconds of processor time and bytes per unit of work, measured; by `python benchmarks/reproduce_rates.py`.\n"


def main() -> None:
    """Read the stores and write the rates."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("stores", type=Path, nargs="+", help="stores of finished cells")
    parser.add_argument("--anew", action="store_true", help="forget the rates of what these stores lack")
    chosen = parser.parse_args()
    seen: dict[str, list[tuple[float, float, float]]] = defaultdict(list)
    for path in chosen.stores:
        store, done = Store(path), set[str]()
        for exhibit in ALL.values():
            for recipe in exhibit.recipes:
                for scale in EFFORTS:
                    waiting = cells_of(exhibit, recipe, scale)
                    while waiting:
                        cell = waiting.pop()
                        if key(cell) in done:
                            continue
                        done.add(key(cell))
                        waiting += inputs(cell)
                        if not store.is_here(cell):
                            continue
                        name, amount = work_of(cell)
                        size = sum(each.stat().st_size for each in store.place(cell).rglob("*") if each.is_file())
                        seen[name].append((store.provenance(cell).get("cpu_seconds", 0.0), amount, size))
    rows = [["work", "cells", "seconds a unit", "bytes a unit"]]
    seconds, sizes = ({}, {}) if chosen.anew else (dict(rates()), dict(sizes_on_disk()))
    for name, found in sorted(seen.items()):
        cpu, amount, size = np.array(found).T
        seconds[name], sizes[name] = cpu.sum() / amount.sum(), size.sum() / amount.sum()
        rows.append([name, str(len(found)), f"{seconds[name]:.3g}", f"{sizes[name]:.3g}"])
    parts = (("seconds", seconds), ("bytes", sizes))
    text = (f"\n[{part}]\n" + "".join(f'"{k}" = {v:.3g}\n' for k, v in sorted(of.items())) for part, of in parts)
    write_text(RATES, HEAD + "".join(text))
    print(aligned(rows))


if __name__ == "__main__":
    main()
