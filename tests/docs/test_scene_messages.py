"""The list of messages in docs/reference/scene-folder.md is that of `unmix_plugin.scenes.messages`;
`python -m tests.docs.test_scene_messages` writes it anew."""

import re

import pytest

from tests.factories.pages import ROOT, text_of
from unmix_plugin.scenes.messages import Message

PAGE = "docs/reference/scene-folder.md"
BEGIN, END = "<!-- messages: from unmix_plugin/scenes/messages.py -->\n", "<!-- end of messages -->\n"
HEADINGS = {
    Message.NO_FOLDER: "The folder and transforms.json",
    Message.NO_WAVELENGTHS: "Bands and sensors",
    Message.NO_POSE: "Poses",
    Message.NO_FOCAL_LENGTH: "Lenses",
    Message.NO_CUBE: "Paths",
    Message.FILE_CLOSED: "Cubes",
    Message.NO_PICTURE_FILE: "Pictures, masks and labels",
    Message.NO_MATERIALS: "Truth",
    Message.NO_SPLIT_LISTS: "Splits and the world",
    Message.CLIPPED: "Warnings",
    Message.CUBE_CHANGED: "While training",
}


def shown(message: Message) -> str:
    """A message as the page shows it: values by their names, those that only some messages have left out."""
    always = re.sub(r"(?<=[\w\])}])\{\w+\}", "", message.shown)
    return re.sub(r"\{(\w+)[^}]*\}", lambda found: f"*{found[1].replace('_', ' ')}*", always).replace(
        "|", "\\|"
    )


def listed() -> str:
    """The list of all messages, in tables."""
    lines = []
    for message in Message:
        if message in HEADINGS:
            lines += ["", f"### {HEADINGS[message]}", "", "| the message says | beside that |", "|---|---|"]
        lines.append(f"| {shown(message)} | {message.advice} |")
    return "\n".join(lines[1:]) + "\n"


def test_the_page_lists_all_messages_of_the_code():
    _, found = text_of(PAGE).split(BEGIN)
    assert found.split(END)[0].strip() == listed().strip(), f"write it anew: python -m {__name__}"


@pytest.mark.parametrize("message", Message, ids=lambda message: message.name)
def test_a_message_says_something_and_no_two_say_the_same(message):
    others = [other.shown for other in Message if other is not message]
    assert shown(message).strip(". ")
    assert message.shown not in others


if __name__ == "__main__":
    before, rest = text_of(PAGE).split(BEGIN)
    _, after = rest.split(END)
    (ROOT / PAGE).write_text(f"{before}{BEGIN}\n{listed()}\n{END}{after}", encoding="utf-8")
