"""Measures a trained agent over the test spawns, clean and under the paper's attacks, and puts it into the package.

The agent's directory is copied to ``src/rapid/shipped/SCENARIO/agents/NAME`` with its card and, where its network can
be exported, its ONNX file.

    python benchmarks/ship_agents.py runs/adapted/agent rapid "Best clean return: 300,000 steps, then 700,000 by PPO"

An adversary is measured on its victim, and goes to ``src/rapid/shipped/SCENARIO/adversaries/NAME``.
What cards say beside the scores is written anew from committed rows by ``--cards``.

    python benchmarks/ship_agents.py runs/adversary adversary "..." --victim shipped:lane-3-density-2/robust
"""

import argparse
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import rapid
from rapid.agents.monitored import CALM, WARY, is_monitored
from rapid.agents.onnx import driven_observations, export_onnx
from rapid.agents.saved import CONFIG_FILE, WEIGHTS_FILE, load_agent
from rapid.agents.shipped import CARD_FILE, ONNX_FILE, agent_folder, shipped_adversaries, shipped_agents
from rapid.attacks.spec import parse_attack
from rapid.errors import RapidError
from rapid.evaluation.metrics import EpisodeRow, column, load_rows, save_rows
from rapid.evaluation.rollouts import evaluate_agent
from rapid.evaluation.statistics import estimate
from rapid.files import read_json, sha256, write_bytes, write_json
from rapid.progress import task
from rapid.runs import commit
from rapid.scenarios import get_scenario
from rapid.spawns import spawn_seeds

ATTACKS = ("none", "uniform", "gaussian", "fgsm", "pgd")
PACKAGE = Path(__file__).resolve().parents[1] / "src" / "rapid" / "shipped"
SIZES = "Attacks are the paper's: noise of 0.2, gradients of 0.1 in normalised features (20 m along the road)."
FLOORS = ("slower", "immune", "blind")
FLOOR_ROWS = Path(__file__).resolve().parents[1] / "results" / "cells" / "floors-full.parquet"


class Made(NamedTuple):
    """How the agents of a name were made."""

    label: str
    """What tables call one."""
    recipe: str
    data: str


_MIXED = "{} teacher and random, 15,000 transitions of each"
_HOME = "shipped:lane-3-density-2"
MADE = {
    "distilled": Made("RAPID, distilled", "strong, phase 2", _MIXED),
    "rapid-10k": Made("RAPID, 10K online", "strong, plan careful", _MIXED + "; 10,000 online steps"),
    "rapid": Made("RAPID, 300K + 700K PPO", "strong, plan ppo", _MIXED + "; 1,000,000 online steps"),
    "mlp": Made("MLP, 300K + 700K PPO", "strong, plan ppo, from new weights", "1,000,000 online steps"),
    "robust": Made(
        "RAPID, robust",
        "strong, plan robust",
        _MIXED.format(_HOME) + "; 600,000 online steps under attack in lane-3-density-2",
    ),
    "guided": Made(
        "RAPID, guided",
        "strong, plan guided",
        _MIXED + "; 1,000,000 online steps, then 153,600 under attack in which it was shown what to do",
    ),
    "squeezed": Made(
        "RAPID, squeezed features",
        "strong, plan squeezed",
        _MIXED + "; 1,000,000 online steps, then 600,000 by squeezed features, two thirds of them under attack",
    ),
    "wary": Made(
        "RAPID, wary",
        "strong, plan wary",
        _MIXED + "; 1,000,000 online steps, then 500,000 by squeezed features, 85 % of the episodes under attack",
    ),
    "monitored": Made(
        "RAPID, monitored",
        "strong, plans ppo and wary",
        _MIXED + "; 1,000,000 online steps, then another policy for 500,000 more, 85 % of the episodes under attack",
    ),
}
LIMITS = (
    "It drives HighwayEnv's straight highway in the scenario named, and nothing else. It is no driver of real cars. "
    "Stronger attacks than those measured may fool it."
)


def scores(rows: list[EpisodeRow]) -> dict[str, Any]:
    """Return mean return with its interval and crash share under each attack, and the worst attack."""
    found = {attack: _score(rows, attack) for attack in ATTACKS if any(row.attack == attack for row in rows)}
    worst = min((attack for attack in found if attack != "none"), key=lambda name: found[name]["return"])
    return found | {"worst": {"attack": worst, **found[worst]}}


def _score(rows: list[EpisodeRow], attack: str) -> dict[str, Any]:
    here = [row for row in rows if row.attack == attack]
    returns = estimate(column(here, "episode_return"), [row.seed for row in here])
    return {
        "return": round(returns.value, 2),
        "interval": [round(returns.low, 2), round(returns.high, 2)],
        "crash_share": round(float(np.mean(column(here, "crashed"))), 3),
        "episodes": len(here),
    }


def made(scenario: str, name: str) -> dict[str, Any]:
    """Return how an agent was made, and the floors and attacks of its scenario."""
    how, rows = MADE[name], load_rows(FLOOR_ROWS)
    lanes = get_scenario(scenario).lanes
    here = {agent: [row for row in rows if (row.scenario, row.agent) == (scenario, agent)] for agent in FLOORS}
    return {
        "recipe": how.recipe,
        "data": how.data.format(f"shipped:{scenario}"),
        "floors": {agent: _score(found, "none") for agent, found in here.items()},
        "attacks": {attack: parse_attack(attack).describe(lanes) for attack in ATTACKS if attack != "none"},
    }


def renew_cards() -> None:
    """Write anew what cards say beside the scores, from what is committed."""
    for name in shipped_agents():
        home = agent_folder(f"shipped:{name}")
        config, scenario = read_json(home / CONFIG_FILE, "agent"), name.partition("/")[0]
        config["metadata"]["name"] = MADE[home.name].label
        write_json(home / CONFIG_FILE, config)
        about = made(scenario, home.name) | {"onnx": exported(home, scenario)}
        write_json(home / CARD_FILE, read_json(home / CARD_FILE, "card") | about)
    for name in shipped_adversaries():
        home = agent_folder(f"shipped:{name}")
        config, about = read_json(home / CONFIG_FILE, "agent"), read_json(home / CARD_FILE, "card")
        config["metadata"]["name"] = f"adversary of {load_agent(about['victim']).name}"
        write_json(home / CONFIG_FILE, config)


def exported(home: Path, scenario: str) -> dict[str, Any] | str:
    """Write an agent's ONNX file, and return its hash and how far it is from the agent, or why there is none."""
    agent = rapid.load_agent(home)
    try:
        seen = driven_observations(agent, scenario, spawn_seeds("test", 4))
        parity = export_onnx(agent, home / ONNX_FILE, *seen)
    except RapidError as error:
        return str(error)
    return {"sha256": sha256(home / ONNX_FILE), "largest_difference": float(f"{parity.difference:.2g}")}


def ship_adversary(folder: Path, metadata: dict[str, Any], name: str, summary: str, victim: str, spawns: int) -> None:
    """Measure an adversary on its victim and write its directory."""
    scenario, attack = str(metadata["scenario"]), f"adversary:{folder}"
    rows: list[EpisodeRow] = []
    with task(f"{scenario}/{name}", 2 * spawns, "episodes") as work:
        for seen in ("none", attack):
            rows += evaluate_agent(
                load_agent(victim), scenario, spawn_seeds("test", spawns), (seen,), progress=work.advance
            )
    home = PACKAGE / scenario.replace(":", "-") / "adversaries" / name
    for file in (WEIGHTS_FILE, CONFIG_FILE):
        write_bytes(home / file, (folder / file).read_bytes())
    found = {row.attack for row in rows} - {"none"}
    about = {
        "name": f"shipped:{home.parents[1].name}/{name}",
        "summary": summary,
        "scenario": scenario,
        "victim": victim,
        "attack": metadata["attack"],
        "steps": metadata["steps"],
        "scores": {"none": _score(rows, "none"), "adversary": _score(rows, found.pop())},
        "scores_are": f"The victim's, over {spawns} test spawns.",
        "weights_sha256": read_json(home / CONFIG_FILE, "agent")["weights_sha256"],
        "commit": commit(),
        "licence": "Apache-2.0",
        "limits": "It attacks the agent named, with these weights, in the scenario named, and is no driver.",
    }
    write_json(home / CARD_FILE, about)
    print(f"{home}: {about['scores']}")


def main() -> None:
    """Measure one agent and write its directory."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n\n")[0])
    parser.add_argument("agent", type=Path, nargs="?", help="directory of the trained agent")
    parser.add_argument("name", nargs="?", choices=(*MADE, "adversary"), help="its name in the package")
    parser.add_argument("summary", nargs="?", default="", help="one sentence: what it is")
    parser.add_argument("--cards", action="store_true", help="only write the cards of all that are shipped anew")
    parser.add_argument("--scenario", default="", help="by default the one that it was trained in")
    parser.add_argument("--spawns", type=int, default=200, help="test spawns")
    parser.add_argument("--work", type=Path, default=Path("runs/ship"), help="where the rows are kept")
    parser.add_argument("--victim", default="", help="the agent that an adversary was trained against")
    chosen = parser.parse_args()
    if chosen.cards:
        renew_cards()
        return
    if chosen.agent is None or chosen.name is None or not chosen.summary:
        parser.error("give the directory of an agent, its name and what it is, or --cards")
    if (chosen.name == "adversary") != bool(chosen.victim):
        parser.error("an adversary has a --victim, and nothing else has")
    agent = rapid.load_agent(chosen.agent)
    if chosen.victim:
        ship_adversary(chosen.agent, agent.metadata, chosen.name, chosen.summary, chosen.victim, chosen.spawns)
        return
    scenario = chosen.scenario or str(agent.metadata["scenario"])
    rows: list[EpisodeRow] = []
    seeds = spawn_seeds("test", chosen.spawns)
    with task(f"{scenario}/{chosen.name}", len(seeds) * len(ATTACKS), "episodes") as work:
        for attack in ATTACKS:
            part = chosen.work / f"{scenario}-{chosen.name}-{attack}.parquet"
            if not part.exists():
                seed = agent.metadata.get("seed")
                save_rows(
                    part,
                    evaluate_agent(
                        agent,
                        scenario,
                        seeds,
                        (attack,),
                        training_seed=seed if isinstance(seed, int) else None,
                        commit=commit(),
                        progress=work.advance,
                    ),
                )
            rows += load_rows(part)
    home = PACKAGE / scenario.replace(":", "-") / "agents" / chosen.name
    policies = [CALM, WARY] if is_monitored(chosen.agent) else [""]
    for policy in policies:
        write_bytes(home / policy / WEIGHTS_FILE, (chosen.agent / policy / WEIGHTS_FILE).read_bytes())
    for part in dict.fromkeys(["", *policies]):
        config = read_json(chosen.agent / part / CONFIG_FILE, "agent")
        for name in ("from", "data"):  # where they lay on this machine is nobody's business
            if name in config["metadata"]:
                config["metadata"][name] = Path(config["metadata"][name]).name
        if not part:
            config["metadata"]["name"] = MADE[chosen.name].label
        write_json(home / part / CONFIG_FILE, config)
    write_json(
        home / CARD_FILE,
        {
            "name": f"shipped:{home.parents[1].name}/{chosen.name}",
            "summary": chosen.summary,
            "scenario": scenario,
            "seed": agent.metadata.get("seed"),
            "phase": agent.metadata.get("phase"),
            "scores": scores(rows),
            "scores_are": f"One training over {chosen.spawns} test spawns. {SIZES}",
            **made(scenario, chosen.name),
            "weights_sha256": " ".join(sha256(home / policy / WEIGHTS_FILE) for policy in policies),
            "onnx": exported(home, scenario),
            "commit": commit(),
            "licence": "Apache-2.0",
            "limits": LIMITS,
        },
    )
    print(f"{home}: {sum(path.stat().st_size for path in home.rglob('*')) / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
