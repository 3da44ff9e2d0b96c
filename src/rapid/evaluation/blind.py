"""The search for the plans of the driver `blind`: so many SLOWER, LANE_RIGHT and FASTER, then IDLE, whatever is seen.

Every plan is driven over tuning spawns, the best ones over more of them, and the best of those is taken; test spawns
are never looked at. `blind` is a floor: who cannot see, or is lied to, can always have that much.

    python -m rapid.evaluation.blind                       # the paper's scenarios, both rewards, written to the package
    python -m rapid.evaluation.blind lane-6-density-2      # shown only, to be named as blind:SLOWER,RIGHT,FASTER
"""

import argparse
import math
from collections.abc import Sequence
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rapid.evaluation.statistics import estimate
from rapid.files import write_json
from rapid.progress import task
from rapid.runs import commit
from rapid.scenarios import IDLE, PAPER_SCENARIOS, get_scenario
from rapid.simulator import make_vec
from rapid.simulator.compile import kernel_stamp
from rapid.spawns import spawn_seeds
from rapid.teacher.scripted import PLANS, Plan, plan_actions

SLOWER_UP_TO, FASTER_UP_TO = 16, 8
FIRST, FINALISTS, MORE = 60, 16, 340
"""Spawns on which every plan is driven; how many go on; further spawns for those."""
SCENARIOS = tuple(scenario + reward for scenario in PAPER_SCENARIOS for reward in ("", ":progress"))


def plans_for(lanes: int) -> list[Plan]:
    """Return every plan that is tried on a road with so many lanes."""
    return list(product(range(SLOWER_UP_TO + 1), range(lanes), range(FASTER_UP_TO + 1)))


def returns(scenario: str, plans: Sequence[Plan], seeds: Sequence[int]) -> NDArray[np.float64]:
    """Return what each plan earns in each episode, (plans, seeds)."""
    worlds: Any = make_vec(scenario, len(seeds), autoreset=False)
    worlds.reset(seed=list(seeds))
    steps = math.ceil(worlds.settings.duration / worlds.settings.decision_time)
    earned = np.empty((len(plans), len(seeds)))
    for number, plan in enumerate(plans):
        actions_T = np.array((plan_actions(plan) + [IDLE] * steps)[:steps], np.int64)
        foreseen = worlds.forecast(np.tile(actions_T, (len(seeds), 1)))
        # Forecasts drive on after an end; what comes after the first does not count.
        ended_ST = foreseen.terminated | foreseen.truncated
        counts_ST = np.cumsum(ended_ST, 1) - ended_ST == 0
        earned[number] = (foreseen.rewards * counts_ST).sum(1)
    worlds.close()
    return earned


def search(scenario: str) -> dict[str, Any]:
    """Return the best plan for a scenario, and what it earns on the tuning spawns it was chosen on."""
    plans = plans_for(get_scenario(scenario).lanes)
    seeds = spawn_seeds("tune", FIRST + MORE)
    with task(f"blind, {scenario}", 2, "rounds") as progress:
        first_PS = returns(scenario, plans, seeds[:FIRST])
        progress.advance()
        best = np.argsort(-first_PS.mean(1), kind="stable")[:FINALISTS]
        all_PS = np.concatenate([first_PS[best], returns(scenario, [plans[i] for i in best], seeds[FIRST:])], 1)
        progress.advance()
    winner = int(all_PS.mean(1).argmax())
    found = estimate(all_PS[winner], seeds)
    return {
        "plan": list(plans[best[winner]]),
        "return": round(found.value, 3),
        "interval": [round(found.low, 3), round(found.high, 3)],
        "spawns": len(seeds),
        "plans": len(plans),
    }


def main() -> None:
    """Search, and write the plans of the paper's scenarios into the package."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("scenarios", nargs="*", help="show the plans of these instead of writing those of the package")
    scenarios: list[str] = parser.parse_args().scenarios
    found = {scenario: search(scenario) for scenario in scenarios or SCENARIOS}
    for scenario, result in found.items():
        print(f"{scenario}: blind:{','.join(map(str, result['plan']))} earns {result['return']} {result['interval']}")
    if not scenarios:
        made = {
            "command": "python -m rapid.evaluation.blind",
            "commit": commit(),
            "kernels": kernel_stamp().hex()[:12],
            "spawns": f"tune, {FIRST} for every plan, {FIRST + MORE} for the best {FINALISTS}",
        }
        write_json(PLANS, {"made": made, "plans": found})


if __name__ == "__main__":
    main()
