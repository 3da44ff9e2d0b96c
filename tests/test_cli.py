import re
import subprocess
import sys
import time
import tomllib
from pathlib import Path

import pytest

import rapid
from rapid.cli import VERBS, main
from rapid.errors import how_to_install
from rapid.usage import MANY, options_of
from rapid.verbs import VERBS as KINDS


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
        (["evaluate"], "Which agents"),
        (["distill", "data", "--distill.iterations", "5"], "its name in `rapid run`, here it is --iterations."),
        (["run", "--iterations=5"], "its name in `rapid distill`, here it is --distill.iterations."),
        (["adapt", "agent", "--adapt.no-mirror"], "here it is --no-mirror."),
        (["run", "--out", "x"], "here it is --directory."),
        (["distill", "data", "--itrations", "5"], "did you mean '--iterations'"),
        (["mix", "a", "b", "--loss.discount", "1"], "it is one of `rapid distill`"),
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


@pytest.mark.parametrize("verb", list(VERBS))
def test_the_options_that_we_know_are_those_that_the_parser_has(verb: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main([verb, "--help-all"])
    text = capsys.readouterr().out
    lines = re.findall(r"^(?:│| ) ?(--.*)$", text, re.M)
    parsed = {word for line in lines for word in re.findall(r"--(\w[\w.-]*)", line)}
    assert parsed == {word for option in options_of(KINDS[verb][0]) for word in option.words}


@pytest.mark.parametrize("verb", list(VERBS))
def test_a_verb_with_many_options_has_a_short_help(verb: str, capsys: pytest.CaptureFixture[str]):
    with pytest.raises(SystemExit):
        main([verb, "--help"])
    text, options = capsys.readouterr().out, options_of(KINDS[verb][0])
    if len(options) <= MANY:
        assert "--help-all" not in text
        return
    told = re.findall(r"^  --([\w.-]+)", text, re.M)
    assert 8 <= len(told) <= 16
    assert set(told) <= {option.name for option in options}
    assert f"These are {len(told)} of {len(options)} options; all: rapid {verb} --help-all" in text


def test_the_short_help_tells_what_the_recipe_sets(capsys: pytest.CaptureFixture[str]):
    for recipe, p in (("strong", "0.5"), ("paper", "0.25")):
        with pytest.raises(SystemExit):
            main(["run", "--help", "--recipe", recipe])
        assert f"--mix.p X ({p})" in capsys.readouterr().out


def test_slow_loading_is_told_and_quick_loading_is_not(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    for seconds, told in ((0.0, False), (0.3, True)):
        monkeypatch.setattr(
            "rapid.verbs.prepare", lambda verb, words, seconds=seconds: time.sleep(seconds) or (lambda: 0)
        )
        monkeypatch.setattr("rapid.cli.SILENCE_S", 0.1)
        with pytest.raises(SystemExit):
            main(["doctor"])
        assert ("loading what `rapid doctor` needs" in capsys.readouterr().err) == told


def test_installing_is_told_as_it_works():
    # There is no such package on the index.
    root, wrong = Path(rapid.__file__).parents[2], re.compile(r"pip install[^\n]*rapid-driving")
    files = [path for place in ("src", "docs", "examples", "notebooks") for path in (root / place).rglob("*")]
    files += [root / "README.md", root / "CONTRIBUTING.md"]
    texts = {path: path.read_text(encoding="utf-8") for path in files if path.suffix in (".py", ".md", ".ipynb")}
    assert len(texts) > 100
    assert [str(path) for path, text in texts.items() if wrong.search(text)] == []
    extras = tomllib.loads((root / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    named = {
        extra
        for text in texts.values()
        for names in re.findall(r"how_to_install\(([^*)]*)\)", text)
        for extra in re.findall(r"[\"'](\w+)[\"']", names)
    }
    assert {"ray", "minari"} <= named <= set(extras)
    assert how_to_install("ray", "export") == f"pip install -c constraints.txt -e '.[ray,export]' (in {root})"


def test_the_example_without_an_agent_says_how_it_is_used():
    example = Path(rapid.__file__).parents[2] / "examples/drive_onnx.py"
    done = subprocess.run([sys.executable, str(example)], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "Usage: python drive_onnx.py AGENT.onnx" in done.stderr
    assert "Traceback" not in done.stderr


def test_python_dash_m_is_the_same_command() -> None:
    ran = subprocess.run([sys.executable, "-m", "rapid", "--version"], capture_output=True, text=True, check=True)
    assert ran.stdout.startswith("rapid ")
