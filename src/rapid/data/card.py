"""The dataset card: what a stranger must know before using a dataset, as Markdown."""

import json
from typing import Any

from rapid.data.dataset import LICENCE, Dataset, summary
from rapid.data.fallbacks import fallback_notice
from rapid.data.transitions import SOURCES
from rapid.data.unwritten import greetings_in, lost_in
from rapid.scenarios import get_scenario
from rapid.text import in_markdown, printable


def card(dataset: Dataset) -> str:
    """Return the card: scenario, drivers and their prompts, counts, returns, crashes, actions, decisions, licence."""
    facts = summary(dataset)
    scenario = get_scenario(dataset.scenario)
    lines = [
        f"# {dataset.scenario}: {len(dataset)} transitions",
        "",
        f"Highway driving, {scenario.lanes} lanes, density {scenario.density:g}, dynamics of `{scenario.env_id}`, "
        f"reward `{scenario.reward}`. One decision a second, at most 30 an episode. Licence: {LICENCE}.",
        "",
        "| source | driver | transitions | whole episodes collected | return (mean ± std over episodes) "
        "| return quartiles | crashed | speed, m/s |",
        "|---|---|---|---|---|---|---|---|",
    ]
    present = [name for name in SOURCES if name in facts]
    for name in present:
        row = facts[name] if dataset.mixture is None else dataset.mixture["sources"][name]
        score, quartiles, crashed = "–", "–", "–"
        if "episodes" in row:
            score = f"{row['return_mean']:.2f} ± {row['return_std']:.2f}"
            quartiles = " / ".join(f"{value:.1f}" for value in row["return_quantiles"])
            crashed = f"{row['crash_share']:.1%}"
        driver = in_markdown(str(dataset.drivers.get(name, {}).get("name", "unknown")))
        lines.append(
            f"| {name} | {driver} | {facts[name]['transitions']} | {row.get('episodes', '–')} | {score} "
            f"| {quartiles} | {crashed} | {row['mean_speed']:.1f} |"
        )
    lines += ["", "| share of actions | " + " | ".join(facts[present[0]]["actions"] if present else ()) + " |"]
    lines.append("|" + "---|" * (1 + len(facts[present[0]]["actions"]) if present else 1))
    lines += [
        f"| {name} | " + " | ".join(f"{share:.1%}" for share in facts[name]["actions"].values()) + " |"
        for name in present
    ]
    if dataset.mixture is not None:
        how = dataset.mixture
        lines += [
            "",
            f"Mixed with p = {how['p']:g} teacher transitions at the level of the {how['level']}, seed {how['seed']}.",
        ]
    if notice := fallback_notice(dataset):
        lines += ["", notice]
    if "decisions" in facts:
        lines += ["", "## Decisions", "", *_decision_lines(facts["decisions"], len(dataset))]
        if (lost := lost_in(dataset.collection)).decisions:
            lines.append(f"- Asked for and lost when processes ended: {lost}")
        if (asked := greetings_in(dataset.collection)).decisions:
            lines.append(f"- Asked for before driving, to see that the server answers: {asked.exactly}")
    if "memory" in facts:
        lines += ["", "## Memory", "", *_memory_lines(facts["memory"])]
    lines += ["", "## Drivers"]
    for name, identity in dataset.drivers.items():
        # JSON on lines of its own: no text in it can begin a line, and so none can end the fence.
        lines += ["", f"{in_markdown(name)}:", "", "```json", json.dumps(identity, indent=2, ensure_ascii=False), "```"]
    lines += ["", "## Reading it", "", *_READING]
    return printable("\n".join(lines)) + "\n"


def _decision_lines(decisions: dict[str, Any], count: int) -> list[str]:
    """Return what the log adds up to, as a list."""
    status = ", ".join(f"{in_markdown(name)} {amount}" for name, amount in decisions["status"].items())
    read, written = (f"{decisions[name]:.0f}" for name in ("tokens_in", "tokens_out"))
    served = ", ".join(decisions["served"])
    return [
        *([f"- The model called itself: {served}"] if served else []),
        f"- Status: {status}; {decisions['retries']:g} retries",
        f"- {decisions['prompts']} different prompts",
        f"- {read} tokens read, {written} written, cost {decisions['cost']:g}",
        f"- {decisions['seconds']:.1f} s of deciding, {decisions['seconds'] / max(count, 1):.3f} s a decision",
    ]


def _memory_lines(memory: dict[str, Any]) -> list[str]:
    """Return what the memory holds, as a list."""
    return [
        f"- {memory['known']} experiences that the teacher had, {memory['learned']} that it gained here, "
        f"{memory['lessons']} of them with a lesson from a crash",
        f"- Reflections: {memory['tokens_in']} tokens read, {memory['tokens_out']} written, cost {memory['cost']:g}",
    ]


_READING = (
    "- `rapid.load_dataset(directory)` checks the files against their hashes and gives `Transitions` (NumPy arrays).",
    "- `transitions.parquet`: one row a step. `obs` is 15 vehicles × 5 features (presence, x, y, vx, vy; metres and "
    "m/s, absolute), row 0 the ego. `next_obs` is null where it equals the `obs` of the next row. `terminated` is a "
    "crash, `truncated` the clock. `source` 0 is the teacher, 1 the random driver.",
    "- `teacher_log.parquet`: one row a decision. What the model was told first (`told`), what it answered (`answer`, "
    "and its own reason, `explanation`) and what RAPID computed about the action (`computed`) are three columns; "
    "`turns` holds everything said after `told`, as JSON. Beside them: prompt hash, status, the "
    "model's own name (`served`), error, tokens, seconds.",
    "- `memory.jsonl`, if the teacher has a memory: one line an experience, those that it had first.",
)
