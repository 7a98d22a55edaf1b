"""Words for colours."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from unmix_plugin.spectral.colour.names import TYPICAL_COLOURS, colour_words, numbered_words


@pytest.mark.parametrize(
    ("srgb", "word"),
    [
        ("#d2b48c", "tan"),  # CSS colours of these names
        ("#808000", "olive"),
        ("#008080", "teal"),
        ("#ff0000", "red"),
        ("#008000", "green"),
        ("#0000ff", "blue"),
        ("#ffff00", "yellow"),
        ("#ffa500", "orange"),
        ("#8b4513", "brown"),
        ("#ffc0cb", "pink"),
        ("#800080", "purple"),
        ("#000080", "navy"),
        ("#808080", "grey"),
        ("#000000", "black"),
        ("#ffffff", "white"),
        # The ColorChecker's patches, by the names of their maker.
        ("#735244", "brown"),  # dark skin
        ("#576c43", "green"),  # foliage
        ("#d67e2c", "orange"),
        ("#5e3c6c", "purple"),
        ("#383d96", "blue"),
        ("#469449", "green"),
        ("#af363c", "red"),
        ("#e7c71f", "yellow"),
        ("#bb5695", "magenta"),
        ("#7a7a79", "grey"),  # neutral 5
    ],
)
def test_colours_are_called_what_people_call_them(srgb, word):
    found = colour_words(np.array([list(bytes.fromhex(srgb[1:]))]) / 255)
    assert found == [word]


def test_typical_colours_have_their_own_word():
    for word, colours in TYPICAL_COLOURS.items():
        srgb = np.array([list(bytes.fromhex(colour)) for colour in colours.split()]) / 255
        assert colour_words(srgb) == [word] * len(srgb)


@given(st.lists(st.sampled_from(["tan", "green", "black"])))
def test_numbered_words_differ_and_say_their_word(words):
    names = numbered_words(words)
    assert len(set(names)) == len(words)
    assert [name.rpartition(" ")[0] for name in names] == words
