"""Exhibits in words: settings, prompts, seconds, and the sentences under the tables."""

from collections.abc import Mapping, Sequence
from typing import Any

from rapid.attacks.spec import parse_attack
from rapid.baselines import offline_baseline
from rapid.experiments.paper import paper_numbers
from rapid.experiments.tables import Facts
from rapid.presets import preset
from rapid.scenarios import PAPER_SCENARIOS, get_scenario

DATASETS = {"random": "random (D_rand)", "llm": "teacher (D_LLM)", "mixed": "mixed (D*)"}
READING = (
    "Random and teacher data are of the row's own scenario; D* is of lane-3-density-2 for every row, as in the paper. "
    "Each cell: mean and interquartile mean with 95 % intervals, crash share, trainings × spawns; the paper's; verdict."
)


def sizes(recipe: str) -> str:
    """Return what the attacks' sizes mean, in one sentence for each road."""
    presence = "may be attacked too" if recipe == "paper" else "is left true"
    roads = "; ".join(
        f"on {lanes} lanes, PGD: {parse_attack('pgd').units(lanes)}, noise: {parse_attack('uniform').units(lanes)}"
        for lanes in (get_scenario(name).lanes for name in PAPER_SCENARIOS)
    )
    return f"The presence of a vehicle {presence}. {roads[:1].upper()}{roads[1:]}."


def number(value: Any) -> str:
    """Return a number of metrics, or the numbers of a mapping."""
    if isinstance(value, Mapping):
        return ", ".join(f"{name} {number(each)}" for name, each in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def efficiency(caption: str, found: Sequence[Mapping[str, Any]], gap: str = "") -> Facts:
    """Return seconds per decision as a table, and below it what is missing."""
    rows = tuple(
        (
            str(each["agent"]),
            f"{each['median_seconds']:.2g} s",
            f"{each['mean_seconds']:.2g} s",
            str(each["decisions"]),
        )
        for each in found
        if each
    )
    notes = ["One world at a time, one thread; the first decision is not counted."]
    if len(rows) > 1:
        slow, fast = (each["median_seconds"] for each in found)
        notes.append(f"The first takes {slow / fast:.0f} times as long as the second.")
    if gap:
        notes.append(gap)
    return Facts("efficiency", caption, ("driver", "median", "mean", "decisions"), rows, tuple(notes))


def environment(recipe: str, caption: str) -> list[Facts]:
    """Return the environment's configuration beside the paper's table."""
    paper = paper_numbers()["environment"]
    ours = [get_scenario(name) for name in PAPER_SCENARIOS]
    config = ours[0].config()
    seen, action = config["observation"], config["action"]
    speeds = action["target_speeds"]
    rows = [
        ("observation", seen["type"] + "Observation", paper["observation_type"]),
        ("features", ", ".join(seen["features"]), ", ".join(paper["observation_features"])),
        ("absolute", str(seen["absolute"]), str(paper["observation_absolute"])),
        ("normalised", str(seen["normalize"]), str(paper["observation_normalize"])),
        ("vehicles", str(seen["vehicles_count"]), str(paper["observation_vehicles_count"])),
        ("sees behind", str(seen["see_behind"]), str(paper["observation_see_behind"])),
        ("action", action["type"], paper["action_type"]),
        (
            "target speeds, m/s",
            f"{speeds[0]:g} to {speeds[-1]:g}, {len(speeds)} values",
            "{start:g} to {stop:g}, {count} values".format(**paper["action_target_speeds"]),
        ),
        ("lanes", ", ".join(str(each.lanes) for each in ours), ", ".join(map(str, paper["lanes_count"]))),
        ("density", ", ".join(f"{each.density:g}" for each in ours), ", ".join(map(str, paper["vehicles_density"]))),
        ("duration, s", str(config["duration"]), str(paper["duration"])),
    ]
    return [Facts("environment", caption, ("setting", "ours", "paper"), tuple(rows))]


def hyperparameters(recipe: str, caption: str) -> list[Facts]:
    """Return the baselines' settings in a recipe beside the paper's table."""
    config = preset(recipe, "full")
    printed = paper_numbers()["hyperparameters"]
    rows: list[tuple[str, ...]] = []
    for name in ("dqn", "ddqn", "cql"):
        own = offline_baseline(config, name)
        optimizer, paper = own.distill.optimizer, printed[name]
        for setting, ours, theirs in (
            ("batch size", optimizer.batch_size, paper["batch_size"]),
            ("learning rate", optimizer.learning_rate, paper["learning_rate"]),
            ("target update", optimizer.target_update, paper["target_update_interval"]),
            (
                "hidden layers",
                "×".join(map(str, own.network.hidden)),
                f"{paper['critic_hidden_dim']}×{paper['critic_hidden_dim']}",
            ),
            ("discount", own.distill.loss.discount, "–"),
            ("conservative weight", own.distill.loss.conservative_weight, "–"),
        ):
            rows.append((name.upper(), setting, f"{ours}", f"{theirs}"))
    return [Facts("hyperparameters", caption, ("method", "setting", f"ours ({recipe})", "paper"), tuple(rows))]


def prompt(recipe: str, caption: str) -> list[Facts]:
    """Return the prefix prompt and one recorded interaction, as the paper shows them."""
    from rapid.teacher.exhibit import prompt_exhibit

    shown = prompt_exhibit()
    who = {"model": "the model", "tool": "a tool", "driver": "RAPID"}
    rows = [
        ("prefix prompt", f"{shown.prefix}\n\n{shown.scene}"),
        *((who[turn.role], turn.text) for turn in shown.turns),
        ("decision", f"{shown.action}: {shown.reason}"),
    ]
    note = f"{shown.model} in {shown.scenario}, spawn {shown.spawn_seed}, decision {shown.step + 1}."
    return [Facts("prompt", caption, ("who", "says"), tuple(rows), (note,))]
