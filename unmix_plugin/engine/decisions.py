"""What a command decided from data on its own: the outcome, the evidence, what would have refuted it, and the flag that
overrides it.

A guess is a hypothesis. Whoever makes one tries what would refute it before it has any effect, and `UNDECIDED` is an
answer: then the safer course is taken, and the table says so.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from unmix_plugin.engine.configs import settings_of

UNDECIDED = "undecided"
"""The outcome of a decision whose evidence speaks for neither side."""


@dataclass(frozen=True)
class Decision:
    """One automatic decision; code asks `subject`, `outcome` and `evidence`, people read all five."""

    subject: str
    """What was decided, such as `world`; one name in all commands."""
    outcome: str
    """What was chosen, such as `bounded`, or `UNDECIDED`."""
    evidence: Mapping[str, float | int | bool | str] = field(default_factory=dict)
    """Measured values by what they measure, the decisive ones first."""
    refuted_by: str = ""
    """What would have spoken against the outcome, and was looked for."""
    flag: str = ""
    """The option that overrides it."""

    @property
    def is_undecided(self) -> bool:
        """Whether the evidence spoke for neither side."""
        return self.outcome == UNDECIDED

    def to_json(self) -> dict[str, Any]:
        """For a record."""
        return {**asdict(self), "evidence": dict(self.evidence)}


def settled_settings(before: Any, after: Any, path: str) -> Iterator[Decision]:
    """A decision for each setting that was `auto` and has a value now.

    Args:
        before, after: Settings, dataclasses of one class that may hold others.
        path: Of their flags, such as `pipeline.model`.
    """
    asked = {setting.path: setting.value for setting in settings_of(before)}
    for setting in settings_of(after):
        old = asked.get(setting.path)
        if isinstance(old, str) and old == "auto" and setting.value != old:
            name = setting.path[-1].replace("_", "-")
            yield Decision(name, _brief(setting.value), flag=setting.flag.replace("--", f"--{path}.", 1))


def _brief(value: Any) -> str:
    if isinstance(value, tuple):
        shown = ", ".join(f"{each:.3g}" if isinstance(each, float) else str(each) for each in value[:3])
        return f"{shown}, ... ({len(value)})" if len(value) > 3 else shown or "none"
    return str(value)


def decision_table(decisions: Sequence[Decision]) -> list[str]:
    """Lines of a table for people, a decision a block.

    >>> print(
    ...     *decision_table([Decision("world", "bounded", {"behind the box": 0.02}, "more", "--world")]),
    ...     sep="\\n",
    ... )
    world  bounded
           because  behind the box 0.02
           against  more
           change   --world
    """
    width = max((len(each.subject) for each in decisions), default=0) + 2
    lines = []
    for each in decisions:
        lines.append(f"{each.subject:<{width}}{each.outcome}")
        values = ", ".join(f"{name} {_written(value)}" for name, value in each.evidence.items())
        details = (("because", values), ("against", each.refuted_by), ("change", each.flag))
        lines += [f"{'':<{width}}{name:<9}{text}" for name, text in details if text]
    return lines


def _written(value: float | int | bool | str) -> str:
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.3g}" if isinstance(value, float) else str(value)
