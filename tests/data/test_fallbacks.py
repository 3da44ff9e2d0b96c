"""Decisions of the rule in a model's place: stopped at if they are many, told if they are few, left out if wanted."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from fake_worlds import FakeTeacher, FakeWorlds
from rapid.cli import main
from rapid.config import Config, TeacherConfig
from rapid.config_io import validate
from rapid.data.card import card
from rapid.data.collection import collect
from rapid.data.dataset import Dataset, load_dataset, mix, save_dataset
from rapid.data.driving import Budget
from rapid.data.fallbacks import LEAST_DECISIONS, TooManyFallbacksError, check_share, fallback_notice
from rapid.data.journal import Journal
from rapid.data.sharding import _share
from rapid.errors import RapidError
from rapid.teacher.decision import Decision, UnreachableError

SCENARIO = "lane-3-density-2"


class Unsure(FakeTeacher):
    """Lets the rule decide every `every`-th time; `down_after` so many steps its server is gone."""

    def __init__(self, every: int = 0, first: int = 0, down_after: int = 10**9) -> None:
        super().__init__()
        self.every, self.first, self.down_after, self.steps = every, first, down_after, 0

    def decide(self, obs_BVF, previous, keys_B):
        self.steps += 1
        decisions = super().decide(obs_BVF, previous, keys_B)
        if self.steps > self.down_after + 1:
            raise UnreachableError("gone")
        for place, decision in enumerate(decisions):
            number = self.asked - len(decisions) + place
            if self.steps > self.down_after:
                decisions[place] = replace(decision, status="fallback", answer="", error="no answer: gone")
            elif self.every and number >= self.first and number % self.every == 0:
                decisions[place] = replace(
                    decision, status="fallback", answer="maybe faster", error="The answer is not one clear decision."
                )
        return decisions


def run(directory: Path, teacher: FakeTeacher, share: float = 0.2, lockstep: int = 16) -> Dataset:
    return collect(
        teacher,
        SCENARIO,
        directory,
        480 if lockstep == 16 else 150,
        lockstep,
        make_worlds=FakeWorlds,
        budget=Budget(fallback_share=share),
    )


def command(words: list[str]) -> None:
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 0


@pytest.fixture(scope="module")
def unsure(tmp_path_factory) -> Dataset:
    """A dataset in which the rule made a tenth of the decisions."""
    directory = tmp_path_factory.mktemp("unsure")
    run(directory, Unsure(every=10))
    return load_dataset(directory)


def test_too_many_stop_the_collection_with_the_last_answer_and_why_it_was_refused(tmp_path):
    teacher = Unsure(every=2, first=20)
    with pytest.raises(TooManyFallbacksError) as stopped:
        run(tmp_path, teacher)
    assert 37 <= teacher.asked < 37 + 16
    said = str(stopped.value)
    for part in ("decisions (", "allows 20%", "'maybe faster'", "The answer is not one clear decision. Try"):
        assert part in said
    assert not (tmp_path / "dataset.json").exists()
    # What was decided before the first of them is kept, nothing after it.
    kept = [json.loads(line) for line in (tmp_path / "collecting" / "journal.jsonl").read_text().splitlines()[1:]]
    statuses = [decision["status"] for line in kept for decision in line["decisions"]]
    assert statuses == ["ok"] * len(statuses)
    assert len(statuses) == 16
    # The same command with a model that answers.
    better, whole = Unsure(), Unsure()
    dataset = run(tmp_path, better)
    assert set(dataset.log.column("status").to_pylist()) == {"ok"}
    run(tmp_path / "whole", whole)
    assert better.asked == whole.asked - len(statuses)
    assert dataset.transitions.action_N.tolist() == load_dataset(tmp_path / "whole").transitions.action_N.tolist()


def test_a_process_that_ended_while_it_stopped_stops_again(tmp_path, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(Journal, "forget_from", lambda journal, unwanted: [])
        with pytest.raises(TooManyFallbacksError):
            run(tmp_path, Unsure(every=2))
    with pytest.raises(TooManyFallbacksError, match="maybe faster"):
        run(tmp_path, Unsure())
    assert set(run(tmp_path, Unsure()).log.column("status").to_pylist()) == {"ok"}


@pytest.mark.parametrize(
    ("count", "total", "limit", "stops"),
    [
        (8, 40, 0.2, False),
        (9, 40, 0.2, True),
        (8, 8, 0.2, False),
        (9, 9, 0.2, True),
        (40, 40, 1.0, False),
        (0, 40, 0.0, False),
        (1, 40, 0.0, True),
    ],
)
def test_the_share_that_stops(count, total, limit, stops):
    if not stops:
        check_share(count, total, limit, None)
        return
    with pytest.raises(TooManyFallbacksError, match=r"The last such answer: none\. Try another"):
        check_share(count, total, limit, Decision(1, status="fallback"))


def test_a_long_answer_is_shown_in_part_and_without_line_breaks():
    with pytest.raises(TooManyFallbacksError) as stopped:
        check_share(50, 50, 0.2, Decision(1, answer="a\n" * 500, error="no.", status="fallback"))
    assert len(str(stopped.value)) < 1200
    assert "\n" not in str(stopped.value)


def test_what_the_rule_decided_while_the_server_was_gone_is_asked_again(tmp_path):
    with pytest.raises(UnreachableError):
        run(tmp_path, Unsure(down_after=3), lockstep=4)
    lines = (tmp_path / "collecting" / "journal.jsonl").read_text().splitlines()
    assert len(lines) == 1 + 3
    dataset = run(tmp_path, Unsure(), lockstep=4)
    assert set(dataset.log.column("status").to_pylist()) == {"ok"}


def test_so_it_is_where_the_server_is_still_gone_when_it_is_greeted(tmp_path):
    class Waiting(Unsure):
        """A teacher that waits for others, and greets them."""

        lost, greetings = 0, ()

        def end_by(self, moment, reason):
            pass

        def get_ready(self):
            pass

    class Ending(Waiting):
        def decide(self, obs_BVF, previous, keys_B):
            if self.steps > self.down_after:
                raise MemoryError("the process ends here")
            return super().decide(obs_BVF, previous, keys_B)

    class Gone(Waiting):
        def get_ready(self):
            raise UnreachableError("still gone")

    with pytest.raises(MemoryError):
        run(tmp_path, Ending(down_after=3), lockstep=4)
    journal = tmp_path / "collecting" / "journal.jsonl"
    assert len(journal.read_text().splitlines()) == 1 + 4
    with pytest.raises(UnreachableError, match="still gone"):
        run(tmp_path, Gone(), lockstep=4)
    assert len(journal.read_text().splitlines()) == 1 + 3
    assert set(run(tmp_path, Waiting(), lockstep=4).log.column("status").to_pylist()) == {"ok"}


def test_what_was_kept_never_stops_a_better_model(tmp_path):
    """Of groups so small that they end before a share says anything, also not for ever after."""
    with pytest.raises(TooManyFallbacksError):
        run(tmp_path, Unsure(every=1), lockstep=1)
    dataset = run(tmp_path, Unsure(), lockstep=1)
    assert dataset.fallbacks[0] <= 0.2 * LEAST_DECISIONS


def test_a_lower_share_is_told_in_the_card_and_by_every_verb(unsure, tmp_path, capsys):
    count, total = unsure.fallbacks
    assert (count, total) == (unsure.log.column("status").to_pylist().count("fallback"), len(unsure))
    assert 0.05 < count / total < 0.15
    notice = f"A rule made {count} of the {total} decisions ({count / total:.1%})"
    assert notice in card(unsure)
    save_dataset(unsure, tmp_path / "teacher")
    save_dataset(
        collect(FakeTeacher(), SCENARIO, tmp_path / "random", 150, 4, source="random", make_worlds=FakeWorlds),
        tmp_path / "random",
    )
    words = ["mix", str(tmp_path / "teacher"), str(tmp_path / "random"), "--size", "100"]
    command([*words, "--p", "0.5", "--out", str(tmp_path / "mixed")])
    mixed = load_dataset(tmp_path / "mixed")
    drawn, of = mixed.fallbacks
    assert (of, 0 < drawn < 50) == (50, True)
    told = f"A rule made {drawn} of the 50 teacher's transitions"
    assert told in capsys.readouterr().err
    assert told in card(mixed)
    words = ["distill", str(tmp_path / "mixed"), "--scale", "tiny", "--iterations", "1", "--evaluate-every", "0"]
    command([*words, "--out", str(tmp_path / "agent")])
    assert told in capsys.readouterr().err


@pytest.mark.parametrize("level", ["transition", "batch"])
def test_they_can_be_left_out(unsure, level):
    count, total = unsure.fallbacks
    size = total - count
    mixed = mix(unsure, None, 1.0, size, 0, level, drop_fallbacks=True)
    rule_N = unsure.fallback_N
    expected = list(zip(unsure.transitions.episode_N[~rule_N], unsure.transitions.step_N[~rule_N], strict=True))
    assert list(zip(mixed.transitions.episode_N, mixed.transitions.step_N, strict=True)) == expected
    assert fallback_notice(mixed).startswith(f"Left out: {count} transitions")
    # Where nothing is left out, what is drawn is as it always was.
    assert len(mix(unsure, None, 1.0, total, 0, level)) == total
    if level == "transition":
        with pytest.raises(RapidError, match=f"there are {size}"):
            mix(unsure, None, 1.0, total, 0, level, drop_fallbacks=True)


def test_data_without_any_says_nothing():
    clean = load_dataset(f"shipped:{SCENARIO}/teacher")
    assert (fallback_notice(clean), clean.fallbacks) == ("", (0, len(clean)))
    assert "A rule made" not in card(clean)
    assert "fallbacks" not in mix(clean, None, 1.0, 10, 0).mixture
    assert fallback_notice(load_dataset(f"shipped:{SCENARIO}/react")).startswith("A rule made 12 of the 175 decisions")


def test_every_shard_has_the_same_limit():
    assert _share(Budget(tokens=9, fallback_share=0.3), 3) == Budget(tokens=3, fallback_share=0.3)
    for share in (-0.1, 1.1, np.nan):
        with pytest.raises(RapidError, match="max_fallback_share"):
            validate(replace(Config(), teacher=TeacherConfig(max_fallback_share=share)))
