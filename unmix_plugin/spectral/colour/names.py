"""Words for colours, as people call them, and names of materials made of them.

A colour is called by the word whose typical colours are nearest by CIEDE2000. Most words have several typical colours,
since a word spans more than a neighbourhood: a dark and a light green are both green.

Sources: Berlin and Kay 1969, Basic color terms, for the eleven words that every language of many words has; the further
words and typical colours after the colour survey of xkcd (Munroe 2010).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from jaxtyping import Float, Float64

from unmix_plugin.spectral.colour.difference import ciede2000, srgb_to_lab

TYPICAL_COLOURS = {
    "black": "000000 1b1b1b",
    "white": "ffffff ebebeb",
    "grey": "363636 5a5a5a 808080 a6a6a6 c8c8c8",
    "red": "e50000 a82222 c84a46 8c0f0f",
    "green": "15b01a 033500 2f6b2f 6fae62 96f97b 4a7c59 8fb996 566d48",
    "blue": "0343df 1f3a6d 4a6fa5 95d0fc 75bbfd 5b7fb9",
    "yellow": "ffff14 ffe14d e8d13a fdf498",
    "orange": "f97306 d9822b ffa64d b85a16",
    "brown": "653700 4a2c17 8a5a3c 7b4b2a 5b4636",
    "pink": "ff81c0 f7b6c8 e07a9b d8a0a6",
    "purple": "7e1e9c 5a2a6e 9b6bb3 c79fef 6b5680",
    "tan": "d1b26f c8a57a b79268 a98c6a",
    "beige": "e6daa6 ddd0b5 cbbfa5",
    "cream": "ffffc2 fbf3d9",
    "olive": "6e750e 808040 5c6130 9a9a55",
    "khaki": "aaa662 bdb76b",
    "teal": "029386 0f5e5e 3f8f8c",
    "turquoise": "06c2ac 5fd3c8",
    "cyan": "00ffff 7fe5f0",
    "magenta": "c20078 e042a8",
    "maroon": "650021 5c1a2b",
    "navy": "01153e 14143c",
    "salmon": "ff796c e9967a",
    "peach": "ffb07c f5cfae",
    "gold": "dbb40c c9a227",
    "rust": "a83c09 9c4a2a",
}
"""Words with typical colours as sRGB."""


@lru_cache
def _typical() -> tuple[tuple[str, ...], Float64[np.ndarray, "N 3"]]:
    """The word of each typical colour, and its L*a*b*."""
    pairs = [(word, colour) for word, colours in TYPICAL_COLOURS.items() for colour in colours.split()]
    srgb = np.array([list(bytes.fromhex(colour)) for _, colour in pairs]) / 255
    return tuple(word for word, _ in pairs), srgb_to_lab(srgb)


def colour_words(srgb: Float[np.ndarray, "N 3"]) -> list[str]:
    """What people call colours, sRGB in [0, 1].

    >>> colour_words(np.array([[0.0, 0.5, 0.0], [0.82, 0.7, 0.5], [0.9, 0.9, 0.92]]))
    ['green', 'tan', 'white']
    """
    words, lab = _typical()
    asked = np.repeat(srgb_to_lab(srgb)[:, None], len(lab), axis=1)
    nearest = ciede2000(asked, np.broadcast_to(lab, asked.shape)).argmin(axis=1)
    return [words[index] for index in nearest.tolist()]


def numbered_words(words: Sequence[str]) -> tuple[str, ...]:
    """Each word with its number among the same ones, from 1, so that all differ.

    >>> numbered_words(["tan", "green", "tan"])
    ('tan 1', 'green 1', 'tan 2')
    """
    seen = Counter[str]()
    names = []
    for word in words:
        seen[word] += 1
        names.append(f"{word} {seen[word]}")
    return tuple(names)
