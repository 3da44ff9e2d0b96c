"""What each kind of cell costs: seconds of processor time and bytes, from stores of finished cells.

Writes the rates from which `rapid reproduce` predicts, and prints them as a table.

    python benchmarks/reproduce_rates.py runs/store
"""

import argparse
from collections import defaultdict
from pathlib import Path

import numpy as np

from rapid.evaluation.summary import aligned
from rapid.experiments.cells import key
from rapid.experiments.compute import work_of
from rapid.experiments.exhibits import ALL, cells_of
from rapid.experiments.methods import EFFORTS
from rapid.experiments.store import Store
from rapid.files import write_text

RATES = Path(__file__).resolve().parents[1] / "src" / "rapid" / "experiments" / "rates.toml"
HEAD = "# Seconds of processor time per unit of work, measured; by `python benchmarks/reproduce_rates.py`.\n[seconds]\n"


def main() -> None:
    """Read the stores and write the rates."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("stores", type=Path, nargs="+", help="stores of finished cells")
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
                        waiting += [
                            each
                            for each in vars(cell).values()
                            if hasattr(each, "__dataclass_fields__")
                            and type(each).__module__ == type(cell).__module__
                            and type(each).__name__ != "Shipped"
                            and type(each).__name__ != "Driver"
                        ]
                        if not store.is_here(cell):
                            continue
                        name, amount = work_of(cell)
                        size = sum(each.stat().st_size for each in store.place(cell).rglob("*") if each.is_file())
                        seen[name].append((store.provenance(cell).get("cpu_seconds", 0.0), amount, size))
    rows = [["work", "cells", "seconds a unit", "kB a cell"]]
    lines: list[str] = []
    for name, found in sorted(seen.items()):
        cpu, amount, size = np.array(found).T
        rate = float(cpu.sum() / amount.sum())
        rows.append([name, str(len(found)), f"{rate:.3g}", f"{size.mean() / 1e3:.0f}"])
        lines.append(f'"{name}" = {rate:.3g}\n')
    write_text(RATES, HEAD + "".join(lines))
    print(aligned(rows))


if __name__ == "__main__":
    main()
