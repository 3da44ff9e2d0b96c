"""What errors look like: one full stop is enough, also where foreign words are quoted."""

import pickle

import pytest

from rapid.errors import RapidError, sentence


@pytest.mark.parametrize(
    ("message", "shown"),
    [
        ("The server said: no.. Try again.", "The server said: no. Try again."),
        ("It failed: what?. Look.", "It failed: what? Look."),
        ("It failed: stop!.", "It failed: stop!"),
        ("Wait... and '../data' is there.", "Wait... and '../data' is there."),
        ("Version 1..2 of a.b.", "Version 1..2 of a.b."),
        ("", ""),
    ],
)
def test_an_error_ends_with_one_full_stop(message, shown):
    assert str(RapidError(message)) == shown
    assert str(pickle.loads(pickle.dumps(RapidError(message)))) == shown


@pytest.mark.parametrize(
    ("text", "shown"),
    [("gone", "gone."), ("gone.", "gone."), (" why? ", "why?"), ("no!", "no!"), ("and so…", "and so…")],
)
def test_foreign_words_become_a_sentence(text, shown):
    assert sentence(text) == shown
