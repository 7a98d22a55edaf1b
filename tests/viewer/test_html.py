"""Pieces of HTML: nothing that a user typed is ever markup."""

from html.parser import HTMLParser

import pytest

from unmix_plugin.viewer import page as html
from unmix_plugin.viewer.layers.painting import ColourMapLegend, SwatchLegend, TextLegend, legend_html

EVIL = "<script>alert(1)</script><img src=x onerror='alert(2)'> & \"quotes\""


class Collector(HTMLParser):
    """Tags and text of a page, and whether every tag is closed."""

    def __init__(self):
        super().__init__()
        self.tags, self.text, self.open = [], "", []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.text += data


def parsed(content):
    collector = Collector()
    collector.feed(content)
    collector.close()
    assert collector.open == []
    return collector


@pytest.mark.parametrize(
    "content",
    [
        html.paragraph(EVIL),
        html.paragraph(EVIL, is_warning=True),
        html.bars([(EVIL, 0.5, (1.0, 0.0, 0.0))]),
        html.table([(EVIL, EVIL)]),
        legend_html(TextLegend(EVIL)),
        legend_html(SwatchLegend(((EVIL, (0.1, 0.2, 0.3)),))),
        legend_html(ColourMapLegend("viridis", 0.0, 1.0, EVIL)),
        html.swatches([(EVIL, (0.0, 0.0, 0.0))]),
    ],
)
def test_words_of_users_are_shown_and_never_run(content):
    found = parsed(content)
    assert not {"script", "img"} & set(found.tags)
    assert EVIL in found.text


def test_a_colour_bar_says_its_values_and_goes_from_end_to_end():
    content = legend_html(ColourMapLegend("gray", -1.0, 3.0, "radiance"))
    found = parsed(content)
    assert [value in found.text for value in ("-1", "1", "3", "radiance")] == [True] * 4
    assert "#000000" in content
    assert "#ffffff" in content


def test_bars_are_as_long_as_their_values_and_never_longer_than_the_panel():
    content = html.bars(
        [("a", 0.25, (1.0, 0.0, 0.0)), ("b", 7.0, (0.0, 1.0, 0.0)), ("c", -1.0, (0.0, 0.0, 1.0))]
    )
    assert [f"width:{width}" in content for width in ("25.0%", "100.0%", "0.0%")] == [True] * 3
