"""What the verbs do that look, compare, convert and show, with their options (:mod:`rapid.tool_options`)."""

import json
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path
from typing import Any, cast

from rapid.config import SCALES, Config
from rapid.config_io import to_dict, to_toml
from rapid.errors import RapidError
from rapid.locks import exclusive, exclusive_file
from rapid.outputs import check_new_file
from rapid.presets import DEFAULT_PLAN, OF_RECIPE, differences, preset
from rapid.scenarios import get_scenario
from rapid.tool_options import (
    Agents,
    Certify,
    Doctor,
    Export,
    Import,
    Models,
    Play,
    Presets,
    Pull,
    Push,
    Report,
    Reproduce,
    TeachBench,
    VerifySimulator,
)


def teach_bench(options: TeachBench, config: Config) -> int:
    from rapid.teach_bench import compare_teachers

    compare_teachers(
        config,
        options.teachers,
        options.scenarios,
        Path(options.out),
        spawns=options.spawns,
        spawn_set=options.spawn_set,
        lockstep=options.lockstep,
    )
    print((Path(options.out) / "summary.txt").read_text(encoding="utf-8"))
    return 0


def certify(options: Certify, config: Config) -> int:
    from rapid.agents.open import check_road, network_agent
    from rapid.certify.table import certify

    agent = network_agent(options.agent)
    check_road(agent, config.scenario)
    counts = options.decisions, options.spawns, options.returns
    with ExitStack() as held:
        out = Path(options.out or held.enter_context(tempfile.TemporaryDirectory(prefix="rapid-")))
        held.enter_context(exclusive_file(out / "certificate.json"))
        check_new_file(out / "certificate.json", options.force)
        print(certify(agent, config.scenario, options.radii, *counts, out, options.width), end="")
    if not options.out:
        print("Nothing was kept; --out DIRECTORY keeps the table and the numbers.")
    return 0


def export(options: Export, config: Config) -> int:
    import torch

    from rapid.agents.onnx import driven_observations, export_onnx, latency
    from rapid.agents.open import exportable_agent
    from rapid.agents.specs import MONITORED
    from rapid.data.batch import with_rows
    from rapid.data.dataset import load_dataset
    from rapid.spawns import spawn_seeds

    agent = exportable_agent(options.agent)
    if MONITORED in options.agent and not options.out:
        raise RapidError("Two agents have no one directory, beside which the file could go. Say where: --out FILE.")
    out = options.out or f"{Path(options.agent.rpartition(':')[2]).resolve()}.onnx"
    if options.dataset:
        obs_NVF = load_dataset(options.dataset).transitions.obs_NVF
        obs_BVF, state_BS = with_rows(torch.from_numpy(obs_NVF), agent.vehicles).numpy(), None
    else:
        scenario = str(agent.metadata.get("scenario") or config.scenario)
        obs_BVF, state_BS = driven_observations(agent, scenario, spawn_seeds("test", 32))
    with exclusive_file(out):
        check_new_file(Path(out), options.force)
        parity = export_onnx(agent, out, obs_BVF, state_BS)
    print(
        f"{out}\n{parity.observations} observations: largest difference of Q-values {parity.difference:.2g}, "
        f"the same action on {parity.agreement:.2%}\n"
        f"one decision on one thread: {latency(out, obs_BVF[0]) * 1e6:.0f} microseconds (median)"
    )
    return 0


def import_agent(options: Import, config: Config) -> int:
    from rapid.agents.sb3 import import_sb3

    out = options.out or str(Path(options.model).with_suffix(".onnx"))
    with exclusive_file(out):
        check_new_file(Path(out), options.force)
        parity = import_sb3(options.model, out, options.trained_on)
    print(
        f"{out}\n{parity.observations} observations of {options.trained_on}: largest difference of values "
        f"{parity.difference:.2g}, the same action on {parity.agreement:.2%}\n"
        f"Next: rapid evaluate {out}"
    )
    return 0


def report(options: Report, config: Config) -> int:
    from rapid.phases.page import report_again

    directory = Path(options.directory)
    if not (directory / "run.json").exists():
        raise RapidError(f"There is no run at '{directory}'. Check the path, or make it first: rapid run")
    with exclusive(directory):
        print(report_again(directory))
    return 0


def _fill_blocks(options: Reproduce) -> int:
    from rapid.experiments.readme import pages, update
    from rapid.experiments.reproduce import open_reproduction

    check, here = options.check, Path()
    if options.ids:
        raise RapidError(
            f"--readme and --check are of every marked block in README.md and docs/, not of ids, and "
            f"'{' '.join(options.ids)}' was given. Leave the ids out, or the option."
        )
    if not pages(here):
        raise RapidError(
            f"There is no marked block (<!-- table: NAME -->) in README.md or docs/ below '{here.resolve()}'. Expected "
            "RAPID's checkout: start this there."
        )
    store = open_reproduction((), options.recipe, "full", Path(options.store)).store
    stale = update(here, store, check)
    told = ", ".join(map(str, stale))
    if check and stale:
        print(f"Not what the rows say: {told}. Mend with: rapid reproduce --readme", file=sys.stderr)
    else:
        print(f"Filled: {told}." if stale else "Every block is what the rows say.")
    return int(check and bool(stale))


def reproduce(options: Reproduce, config: Config) -> int:
    from rapid.experiments.exhibits import ALL, cells_of
    from rapid.experiments.reproduce import EVERY, listing, open_reproduction, reproduce, text_of, write_page

    if options.readme or options.check:
        return _fill_blocks(options)
    layers = [Path(layer) for layer in options.layers]
    of = open_reproduction(options.ids, options.recipe, options.scale, Path(options.store), layers)
    if not options.ids or options.dry_run:
        print(listing(of))
        return 0
    out = Path(options.out or f"runs/reproduce/{'-'.join((*of.recipes, options.scale))}")
    failed: dict[str, str] = {}
    if options.page_only:
        page = write_page(of, out)
    else:
        outcome, page = reproduce(of, out, cast(Any, options.engine), options.workers)
        failed = outcome.failed
    if options.export:
        for exhibit in of.exhibits:
            name = f"{exhibit.id}-{of.request(exhibit).recipe}-{options.scale}"
            of.store.export(
                cells_of(ALL[exhibit.id], of.request(exhibit).recipe, options.scale), Path(options.export), name
            )
    if EVERY not in options.ids:
        print(text_of(of))
    print(f"page: {page}")
    if failed:
        print(f"{len(failed)} parts failed; the same command tries them again.", file=sys.stderr)
    return int(bool(failed))


def play(options: Play, config: Config) -> int:
    from rapid.play import Roster, first_moment, serve

    scenario = get_scenario(options.scenario).name if options.scenario else ""
    roster = Roster(options.agents, Path("runs"), config.teacher, config.seed)
    start = first_moment(roster, options.agents, scenario, options.spawn, options.moment)
    serve(roster, start, options.port, config.seed, options.browser)
    return 0


def presets(options: Presets, config: Config) -> int:
    if not options.first:
        for recipe, plans in OF_RECIPE.items():
            print(f"{recipe}: scales {', '.join(SCALES)}; plans {', '.join(plans)} (usual: {DEFAULT_PLAN[recipe]})")
        return 0
    first = preset(*options.first.split("/", 2))
    if not options.second:
        print(to_toml(to_dict(first)), end="")
        return 0
    rows = differences(first, preset(*options.second.split("/", 2)))
    width = max(map(len, rows), default=0)
    for name, (here, there) in rows.items():
        print(f"{name:<{width}}  {here!r} -> {there!r}")
    if not rows:
        print("They set the same.")
    return 0


def agents(options: Agents, config: Config) -> int:
    from rapid.agents.shipped import card, listing

    if options.action == "list":
        print(listing())
        return 0
    if options.action != "show":
        raise RapidError(f"'{options.action}' is nothing to do with agents. Say list, or show NAME.")
    print(json.dumps(card(options.name.removeprefix("shipped:")), indent=2))
    return 0


def push(options: Push, config: Config) -> int:
    from rapid.hub import push

    print(push(options.path, options.repository, options.public).told())
    return 0


def pull(options: Pull, config: Config) -> int:
    from rapid.hub import pull

    print(pull(options.repository, options.out, options.revision).told())
    return 0


def models(options: Models, config: Config) -> int:
    from rapid.teacher import models

    return models.command(options.action, options.name)


def verify_simulator(options: VerifySimulator, config: Config) -> int:
    from rapid.files import write_text
    from rapid.progress import task
    from rapid.simulator.verify import verify

    if options.out:
        check_new_file(Path(options.out), options.force)
    with task("verify", options.episodes, "episodes") as work:
        findings = verify(
            options.scenarios or None,
            options.episodes,
            processes=options.processes,
            plain_math=options.plain_math,
            time_limits=not options.scenarios,
            progress=lambda done, total, findings: work.advance(),
        )
    print(findings.verdict())
    if options.out:
        write_text(options.out, findings.verdict() + "\n")
    return 0 if findings.equal else 1


def doctor(options: Doctor, config: Config) -> int:
    from rapid.doctor import examine

    mark = {"ok": "ok     ", "warning": "warning", "failed": "FAILED "}
    failed = False
    for finding in examine(options.teacher):
        print(f"{mark[finding.verdict]}  {finding.name:<16} {finding.fact}", flush=True)
        if finding.fix:
            print(f"{'':26}{finding.fix}")
        failed |= finding.verdict == "failed"
    print("Something needs mending, see above." if failed else "Everything that a run needs is there.", file=sys.stderr)
    return int(failed)
