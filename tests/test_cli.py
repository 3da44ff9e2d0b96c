import subprocess
import sys
from pathlib import Path

import pytest

import rapid
from rapid.cli import VERBS, main


def run_cli(*words: str) -> tuple[int, str, str]:
    """The command in a fresh process: exit code, output, errors."""
    done = subprocess.run([sys.executable, "-m", "rapid.cli", *words], capture_output=True, text=True, check=False)
    return done.returncode, done.stdout, done.stderr


def test_help_names_every_verb_and_imports_nothing_heavy():
    code = (
        "import sys; from rapid.cli import help_text; text = help_text(); "
        "assert all(verb in text for verb in sys.argv[1].split()); "
        "heavy = {'torch', 'numpy', 'numba', 'tyro', 'rich', 'gymnasium'} & set(sys.modules); assert not heavy, heavy"
    )
    subprocess.run([sys.executable, "-c", code, " ".join(VERBS)], check=True)


@pytest.mark.parametrize("verb", list(VERBS))
def test_every_verb_explains_itself(verb: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main([verb, "--help"])
    assert stop.value.code == 0
    assert "usage: rapid" in capsys.readouterr().out


def test_version():
    assert run_cli("--version")[:2] == (0, f"rapid {rapid.__version__}\n")


def test_verbs_without_options_run(capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit) as stop:
        main(["models"])
    assert stop.value.code == 0
    assert "smollm2-135m" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["rnu"], "did you mean 'run'"),
        (["run", "--recipe", "papr"], "did you mean 'paper'"),
        (["run", "--scale", "huge"], "tiny, quick, full."),
        (["run", "--scenario", "lane-3-densty-2"], "did you mean 'lane-3-density-2'"),
        (["run", "--seed", "x"], "seed"),
        (["run", "--distill.loss.discont", "1"], "discount"),
        (["run", "--config", "missing.toml"], "missing.toml"),
        (["run", "--from", "colect"], "collect"),
        (["run", "--network.top-k", "5"], "network.num_policies"),
        (["run", "--evaluate.attacks", "pdg"], "pgd"),
        (["run", "--teacher.model", "smollm"], "smollm2-135m"),
        (["collect", "--scenario", "lane-0-density-2"], "1 to 20 lanes"),
        (["mix", "nowhere", "nothing", "--out", "x"], "nowhere"),
        (["distill", "nowhere"], "nowhere"),
        (["distill", "nowhere", "--seeds", "0"], "'seeds' is 0"),
        (["adapt", "nowhere"], "nowhere"),
        (["evaluate", "nobody"], "nobody"),
        (["evaluate", "slower", "--scenario", "highway"], "Unknown scenario"),
        (["collect", "--engine", "ray"], "at least 2 for the engine 'ray'"),
        (["collect", "--workers", "2", "--shard", "1/2"], "collect.shard"),
        (["collect", "--max-decisions", "-1"], "at least 0"),
        (["teach-bench"], "Which teachers"),
        (["teach-bench", "rule", "smolm2-135m:digest"], "did you mean 'smollm2-135m'"),
        (["teach-bench", "rule", "--simulator", "compild"], "Unknown simulator"),
        (["report", "nowhere"], "nowhere"),
        (["models", "pull", "smolm2-135m"], "smollm2-135m"),
    ],
)
def test_bad_input_is_explained_and_nothing_is_made(
    words: list[str],
    says: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(words)
    captured = capsys.readouterr()
    assert stop.value.code == 2
    assert says in captured.err + captured.out
    assert "Traceback" not in captured.err
    assert list(tmp_path.iterdir()) == []


def test_a_damaged_settings_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    file = tmp_path / "my.toml"
    file.write_text('seed = "zero"\n')
    with pytest.raises(SystemExit) as stop:
        main(["run", "--config", str(file), "--directory", str(tmp_path / "run")])
    assert stop.value.code == 2
    assert "my.toml" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()
