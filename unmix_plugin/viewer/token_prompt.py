"""What a page shows before it has given the token."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from unmix_plugin.viewer import html
from unmix_plugin.viewer.gate import Gate
from unmix_plugin.viewer.inputs import text

if TYPE_CHECKING:
    import viser


class TokenPrompt:
    """Asks one page for the token."""

    def __init__(self, client: viser.ClientHandle, gate: Gate) -> None:
        self.client = client
        gui = client.gui
        self._note = gui.add_html(html.paragraph("This viewer asks for the token that it was started with."))
        self._word = gui.add_text("token", "")
        self._button = gui.add_button("enter")

        def enter(_: Any) -> None:
            self._note.content = html.paragraph("checking")
            gate.guess(client.client_id, text(self._word.value))

        self._button.on_click(enter)

    def refuse(self) -> None:
        """Say that the guess was wrong."""
        self._note.content = html.paragraph("That is not the token.", is_warning=True)

    def remove(self) -> None:
        """Make room for the panels."""
        for handle in (self._note, self._word, self._button):
            handle.remove()


class TokenPrompts:
    """Pages that have yet to give the token."""

    def __init__(self, gate: Gate, admit: Callable[[viser.ClientHandle], None]) -> None:
        """
        Args:
            gate: Checks what they give.
            admit: Serves a page that gave the token.
        """
        self._gate, self._admit = gate, admit
        self._prompts: dict[int, TokenPrompt] = {}
        self._lock = threading.Lock()

    def ask(self, client: viser.ClientHandle, address: str) -> bool:
        """Ask a page; False if too many from its address are asked already."""
        if not self._gate.enter(client.client_id, address):
            return False
        with client.atomic():  # nobody can answer before the answer is listened for
            prompt = TokenPrompt(client, self._gate)
            with self._lock:
                self._prompts[client.client_id] = prompt
        return True

    def leave(self, client: viser.ClientHandle) -> None:
        """Forget a page."""
        self._gate.leave(client.client_id)
        with self._lock:
            self._prompts.pop(client.client_id, None)

    def tick(self) -> None:
        """Check a guess from each address; called at a steady pace."""
        for page, is_right in self._gate.verdicts().items():
            with self._lock:
                prompt = self._prompts.get(page)
            if prompt is None:
                continue
            if not is_right:
                prompt.refuse()
                continue
            self.leave(prompt.client)
            prompt.remove()
            self._admit(prompt.client)
