"""What `rapid certify` writes: a table and, beside it, the numbers as JSON."""

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rapid import files
from rapid.agents.q_agent import QAgent
from rapid.certify.rate import CertifiedReturn, DecisionRates, Reach, certified_return, check_reward, decision_rates
from rapid.errors import RapidError
from rapid.evaluation.statistics import Estimate
from rapid.evaluation.summary import aligned
from rapid.networks.encoding import feature_scale
from rapid.progress import task
from rapid.spawns import spawn_seeds


def certify(
    agent: QAgent,
    scenario: str,
    radii: Sequence[float],
    decisions: int,
    spawns: int,
    returns: int,
    out: Path,
    width: int = 256,
) -> str:
    """Certify decisions and returns of an agent and write ``certificate.txt`` and ``certificate.json`` to `out`.

    Args:
        agent: an agent with a network.
        scenario: where it drives.
        radii: of the attacks, in features scaled to +-1.
        decisions: how many are certified for each radius, from as many episodes as there are `spawns`.
        spawns: test spawns.
        returns: of how many of them the return is bounded too, for each radius; 0 is none.
        out: the directory.
        width: of the trees; see :func:`rapid.certify.rate.certified_return`.

    Returns:
        The table.

    Raises:
        RapidError: an agent, a radius or a scenario that cannot be certified, found before anything is driven.
    """
    if not radii:
        raise RapidError("There is no radius to certify. Name one or more with --radii, such as 0.0005.")
    if returns > spawns:
        raise RapidError(f"Returns of {returns} episodes are asked for, but there are {spawns} spawns. Ask for more.")
    if returns:
        check_reward(scenario)
    for radius in radii:
        Reach(agent, radius)
    seeds = spawn_seeds("test", spawns)
    with task("certify decisions", decisions * len(radii), "decisions") as work:
        rates = decision_rates(agent, scenario, seeds, radii, decisions, work.advance)
    found: dict[float, list[CertifiedReturn]] = {}
    with task("certify returns", returns * len(radii), "episodes") as work:
        for radius in radii if returns else ():
            found[radius] = []
            for seed in seeds[:returns]:
                found[radius].append(certified_return(agent, scenario, seed, radius, width))
                work.advance()
    table = _table(agent, scenario, rates, found)
    files.write_text(out / "certificate.txt", table)
    files.write_json(
        out / "certificate.json",
        {
            "agent": agent.name,
            "scenario": scenario,
            "shield": agent.network.config.shield,
            "width": width,
            "decisions": [asdict(rate) for rate in rates],
            "returns": [{"radius": radius, **asdict(one)} for radius, all_ in found.items() for one in all_],
        },
    )
    return table


def _table(
    agent: QAgent, scenario: str, rates: Sequence[DecisionRates], returns: dict[float, list[CertifiedReturn]]
) -> str:
    _, x, y, v, _ = (float(unit) for unit in feature_scale(agent.network.lanes))
    lines = [
        f"{agent.name} in {scenario}: {rates[0].decisions} decisions on the way without attack",
        "",
    ]
    rows = [["radius", "in metres and m/s", "unchanged %", "safe %", "actions"]]
    for rate in rates:
        size = f"{x * rate.radius:.3g} m, {y * rate.radius:.2g} m, {v * rate.radius:.2g} m/s"
        shares = (_share(rate.unchanged), _share(rate.safe))
        rows.append([f"{rate.radius:g}", size, *shares, f"{rate.reachable:.2f}"])
    lines.append(aligned(rows))
    lines += [
        "",
        "unchanged: proven that no attack within the radius changes the action. safe: proven that whatever action an",
        "attack brings about passes the interval filter on the truth. actions: how many may be brought about, mean.",
        "What is not proven need not be false. 95 % intervals over spawns.",
    ]
    for radius, all_ in returns.items():
        count = len(all_)
        lines += [
            "",
            f"return under every attack within {radius:g}, {count} episodes: at least "
            f"{sum(one.least for one in all_) / count:.2f} of {sum(one.clean for one in all_) / count:.2f} without, "
            f"tree complete in {sum(one.complete for one in all_)}, no crash proven in "
            f"{sum(one.crash_free for one in all_)}",
        ]
    return "\n".join(lines) + "\n"


def _share(found: Estimate) -> str:
    return f"{100 * found.value:.0f} [{100 * found.low:.0f}, {100 * found.high:.0f}]"
