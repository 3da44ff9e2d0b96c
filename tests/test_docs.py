"""What the pages say is run: every snippet of the tutorial, of README and of the how-to pages, and every notebook."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
NOT_INSTALLED = "# needs moviepy"


def snippets(page: str, language: str) -> list[str]:
    """The code blocks of a language in a page."""
    return re.findall(rf"^```{language}\n(.*?)^```", (ROOT / page).read_text(encoding="utf-8"), flags=re.M | re.S)


WITH_CODE = [
    str(path.relative_to(ROOT))
    for path in [ROOT / "README.md", *sorted(ROOT.glob("docs/**/*.md"))]
    if path.name != "tutorial.md" and "```python\n" in path.read_text(encoding="utf-8")
]
"""Pages with code; the tutorial has a test of its own."""


def run(words: list[str] | str, folder: Path, code: str | None = None) -> str:
    path = os.pathsep.join([str(Path(sys.executable).parent), os.environ["PATH"]])
    done = subprocess.run(
        words,
        shell=isinstance(words, str),
        cwd=folder,
        input=code,
        env=os.environ | {"PATH": path, "PYTHONPATH": str(ROOT / "src"), "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, f"{words}\n{code or ''}\n{done.stdout[-2000:]}{done.stderr[-4000:]}"
    return done.stdout


def explained_metrics() -> set[str]:
    """The names in the first column of the page on metrics."""
    return set(re.findall(r"^\| `(\w+)` ", (ROOT / "docs/metrics.md").read_text(encoding="utf-8"), flags=re.M))


def test_every_term_that_a_trainer_writes_is_explained():
    from rapid.training.learner import TERMS
    from rapid.training.ppo_learner import SHOWN, VALUE
    from rapid.training.ppo_learner import TERMS as OF_PPO

    assert {*TERMS, *VALUE, *OF_PPO, *SHOWN} <= explained_metrics()


@pytest.mark.slow
def test_the_tutorial_runs_as_it_is_written_and_its_metrics_are_explained(tmp_path: Path):
    for code in snippets("docs/tutorial.md", "python"):
        run([sys.executable, "-"], tmp_path, code)
    commands = [line for block in snippets("docs/tutorial.md", "bash") for line in block.splitlines() if line.strip()]
    assert len(commands) >= 5
    for command in commands:
        run(command, tmp_path)
    explained = explained_metrics()
    found = {
        name
        for path in tmp_path.rglob("metrics.jsonl")
        for line in path.read_text().splitlines()
        for name in json.loads(line)
    }
    assert {"td", "gate", "return"} <= found
    assert found <= explained, sorted(found - explained)


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_CODE)
def test_snippets_of_the_other_pages_run_one_after_another(page: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    code = "\n".join(code for code in snippets(page, "python") if NOT_INSTALLED not in code)
    run([sys.executable, "-"], tmp_path, code.replace("learn(20_000)", "learn(768)"))


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted((ROOT / "notebooks").glob("*.ipynb")), ids=lambda path: path.stem)
def test_notebooks_run(path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    monkeypatch.setenv("PYTHONPATH", str(ROOT / "src"))
    notebook = nbformat.read(path, as_version=4)
    assert all(not cell.get("outputs") for cell in notebook.cells), "Commit notebooks without outputs."
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(tmp_path)}}).execute()


def test_every_command_named_in_the_pages_exists():
    from rapid.cli import VERBS

    for page in [*ROOT.glob("docs/**/*.md"), ROOT / "README.md"]:
        if "log" in page.parts:
            continue
        for verb in re.findall(r"(?:^|`)rapid ([a-z][a-z-]+)", page.read_text(encoding="utf-8"), flags=re.M):
            assert verb in VERBS, f"{page}: rapid {verb}"


def test_readme_is_short_enough_for_a_stranger():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").splitlines()) <= 130


def test_every_test_that_the_page_of_faults_names_exists():
    named = re.findall(r"`([\w/]+\.py)::(\w+)`", (ROOT / "docs/faults.md").read_text(encoding="utf-8"))
    assert len(named) > 60
    missing = [
        f"{path}::{name}"
        for path, name in named
        if not (ROOT / "tests" / path).is_file()
        or not re.search(rf"^def {name}\(", (ROOT / "tests" / path).read_text(encoding="utf-8"), flags=re.M)
    ]
    assert missing == []


def test_the_table_of_the_architecture_has_every_module_and_nothing_else():
    text = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8").split("## Conventions")[0]
    cells = [line.split("|")[1] for line in text.splitlines() if line.startswith("| `")]
    named = {name.rstrip("/") for cell in cells for name in re.findall("`([^`]+)`", cell)}
    package = ROOT / "src" / "rapid"
    there = {path.stem for path in package.glob("[!_]*.py")} | {path.parent.name for path in package.glob("*/*.py")}
    assert named == there | {"shipped"}
