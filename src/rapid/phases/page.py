"""The page of a run, gathered from what its steps left."""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rapid.agents.saved import load_agent, remembered
from rapid.baselines import online_baseline
from rapid.config import Config
from rapid.config_io import apply_overrides, to_dict
from rapid.data.dataset import load_dataset, summary
from rapid.data.fallbacks import fallback_notice
from rapid.evaluation.metrics import load_rows
from rapid.evaluation.recording import Recording
from rapid.evaluation.summary import lead_of
from rapid.files import read_json
from rapid.phases.adapt import ONLINE, PPO
from rapid.phases.data import data_folders
from rapid.phases.measure import recorded
from rapid.presets import as_options, of_file, without_presets
from rapid.report import ReportData, RoutingSnapshot, write_figures, write_report
from rapid.runs import STEPS
from rapid.training.machinery.record import load_metrics


def report_again(directory: Path) -> Path:
    """Write the page of a finished run again and return its path.

    Raises:
        RapidError: there is no run, or it has not been measured yet.
    """
    manifest = read_json(directory / "run.json", "run manifest")
    settings = manifest.get("config", {})
    config = apply_overrides(of_file(settings), without_presets(settings), source=f"'{directory / 'run.json'}'")
    return write_run_report(config, directory)


def write_run_report(config: Config, directory: Path) -> Path:
    """Gather the artefacts of a run into ``report.html`` and the figures beside it."""
    manifest = read_json(directory / "run.json", "run manifest")
    steps = {step: directory / "steps" / f"{step}.json" for step in STEPS}
    recordings = recorded(directory / "evaluate")
    teacher_data = load_dataset(data_folders(config, directory)[0])
    notes = []
    if config.data:
        notes.append(f"Nothing was collected in this run; its data: {config.data}.")
    if notice := fallback_notice(teacher_data):
        notes.append(notice + (" This run left them out of its mixture." if config.mix.drop_fallbacks else ""))
    measured = read_json(steps["evaluate"]) if steps["evaluate"].exists() else {}
    if "note" in measured:
        notes.append(measured["note"])
    if config.scale in ("tiny", "quick"):
        notes.append(f"Scale {config.scale}: one training seed and few spawns. This shows that it works, not how well.")
    rows = load_rows(directory / "evaluate" / "episodes.parquet")
    lead = lead_of(rows) or "RAPID"
    data = ReportData(
        title=f"RAPID on {config.adapt.scenario or config.scenario}",
        settings=to_dict(config),
        versions=manifest["versions"],
        commit=manifest["commit"],
        command=shlex.join(["rapid", "run", *as_options(config), "--directory", f"{directory}-again"]),
        started=manifest["started"],
        timings={step: read_json(path)["seconds"] for step, path in steps.items() if path.exists()},
        rows=rows,
        main_agent=lead,
        distill={
            "distilled": load_metrics(directory / "distill" / "rapid"),
            "offline DQN": load_metrics(directory / "distill" / "offline-dqn"),
            "behaviour cloning": load_metrics(directory / "distill" / "cloning"),
        },
        adapt=_online_records(config, directory / "adapt"),
        routing=_routing(config, directory, recordings, lead),
        recordings=recordings,
        dataset={"driver": teacher_data.drivers, **summary(teacher_data)},
        notes=notes,
    )
    write_figures(data, directory / "figures")
    return write_report(data, directory / "report.html")


def _online_records(config: Config, directory: Path) -> dict[str, list[dict[str, Any]]]:
    """The records of phase 3 and of the baselines that learned online, by the agents' names."""
    trainings = {"RAPID": (config, directory / "rapid")}
    # Runs of earlier versions have no such baselines.
    trainings |= {
        name: (online_baseline(config, algorithm), directory / folder)
        for folder, (algorithm, name) in ONLINE.items()
        if (directory / folder).exists()
    }
    return {
        name: [row for part in _parts(settings, folder) for row in load_metrics(part)]
        for name, (settings, folder) in trainings.items()
    }


def _parts(config: Config, directory: Path) -> list[Path]:
    """Where the records of phase 3 lie, in their order."""
    parts = {directory: config.adapt.steps, directory / PPO: config.adapt.ppo.steps}
    return [part for part, steps in parts.items() if steps]


def _routing(config: Config, directory: Path, recordings: Sequence[Recording], lead: str) -> list[RoutingSnapshot]:
    """The routing weights in one scene of the adapted agent's first recorded episode, before and after adaptation."""
    recording = next((recording for recording in recordings if recording.agent == lead), None)
    if recording is None or config.network.kind != "rapid":
        return []
    middle = len(recording.action_T) // 2
    obs_VF = recording.obs_TVF[middle]
    snapshots = []
    for label, phase in (("before adaptation", "distill"), ("after adaptation", "adapt")):
        agent = load_agent(directory / phase / "rapid" / "agent")
        # What was distilled may see fewer: the nearest, which come first.
        seen_VF = obs_VF[: agent.vehicles]
        state_TS = remembered(agent, recording.action_T[:middle])
        weights_BVN = agent.explain(seen_VF[None], None if state_TS is None else state_TS[-1:]).weights_BVN
        if weights_BVN is not None:
            snapshots.append(RoutingSnapshot(label, weights_BVN[0].numpy(), seen_VF))
    return snapshots
