"""Recipes as panels build them: each change is an edit of the recipe, and can be undone.

Endmembers are given by their number, which no edit changes. A change takes the place of earlier ones that it leaves no
trace of: of the same kind, and of the brightness where a colour is given, of both where a spectrum is replaced. A swap
carries the changes of a spectrum along to the other endmember.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace
from typing import Any, TypeVar

from unmix_plugin.editing import (
    Gloss,
    Isolate,
    Operation,
    Recipe,
    Remove,
    Rename,
    Replace,
    Retint,
    Scale,
    Swap,
)
from unmix_plugin.editing.recipe_files import MOST_EDITS
from unmix_plugin.spectral.materials import find_endmember

_ChangeT = TypeVar("_ChangeT", bound=Operation)

_MOST_UNDONE = 200
_ONE_EDIT_S = 2.0
"""Changes of the same thing in quicker succession, as while a slider is dragged, are undone together."""


class RecipeHistory:
    """The recipe in force, those before it, and those that were undone."""

    def __init__(self, present: Recipe | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._recipes, self._index = [present or Recipe()], 0
        self._clock = clock
        self._last_change: tuple[Hashable, float] = (None, 0.0)

    @property
    def present(self) -> Recipe:
        """The one in force."""
        return self._recipes[self._index]

    def take(self, recipe: Recipe, subject: Hashable = None) -> None:
        """Put another recipe in force; `subject` is what is changed, None for a change that is undone by itself."""
        if recipe == self.present:
            return
        now, (last_subject, changed_at) = self._clock(), self._last_change
        goes_on = subject is not None and subject == last_subject and now - changed_at <= _ONE_EDIT_S
        before = self._recipes[: self._index if goes_on else self._index + 1]
        # Dragged to where it was, it leaves nothing to undo, and the next change is its own.
        if before[-1:] == [recipe]:
            del before[-1]
            subject = None
        self._recipes = [*before[-_MOST_UNDONE:], recipe]
        self._index, self._last_change = len(self._recipes) - 1, (subject, now)

    def undone(self) -> Recipe | None:
        """Go back by one; None at the beginning."""
        return self._step(-1)

    def redone(self) -> Recipe | None:
        """Go forward again by one; None at the end."""
        return self._step(1)

    def _step(self, by: int) -> Recipe | None:
        if not 0 <= self._index + by < len(self._recipes):
            return None
        self._index, self._last_change = self._index + by, (None, 0.0)
        return self.present


_SUPERSEDED: dict[type, tuple[type, ...]] = {
    Replace: (Replace, Retint, Scale),
    Retint: (Retint, Scale),
    Scale: (Scale,),
    Rename: (Rename,),
    Gloss: (Gloss,),
}
"""Kinds of earlier changes of which one of a kind leaves nothing."""


def with_change(recipe: Recipe, change: Replace | Retint | Scale | Rename | Gloss) -> Recipe:
    """The recipe with a change of one endmember, in place of earlier ones of which it leaves nothing."""
    earlier, kinds = _changes_of(recipe, change.endmember), _SUPERSEDED[type(change)]
    gone = [position for position in earlier if isinstance(recipe.operations[position], kinds)]
    others = [one for position, one in enumerate(recipe.operations) if position not in gone]
    return _with_operations(recipe, [*others, change])


def with_swap(recipe: Recipe, swap: Swap) -> Recipe:
    """The recipe with two endmembers swapped; swapping the same two again at once undoes it."""
    last = recipe.operations[-1] if recipe.operations else None
    if isinstance(last, Swap) and {last.first, last.second} == {swap.first, swap.second}:
        return _with_operations(recipe, recipe.operations[:-1])
    return _with_operations(recipe, [*recipe.operations, swap])


def with_visible(recipe: Recipe, hidden: Iterable[int], isolated: int | None = None) -> Recipe:
    """The recipe that shows all endmembers but the hidden ones, or the isolated one alone."""
    changes = [one for one in recipe.operations if not isinstance(one, Remove | Isolate)]
    gone = tuple(sorted(set(hidden)))
    if isolated is not None:
        changes.append(Isolate((isolated,)))
    elif gone:
        changes.append(Remove(gone))
    return _with_operations(recipe, changes)


def named_by(recipe: Recipe, kind: type[Remove] | type[Isolate]) -> frozenset[int]:
    """Numbers of the endmembers that a numbered recipe removes, or of those that it isolates."""
    edits = [one for one in recipe.operations if isinstance(one, kind)]
    return frozenset(index for one in edits for index in one.endmembers if isinstance(index, int))


def is_shown(recipe: Recipe, index: int) -> bool:
    """Whether a numbered recipe leaves an endmember visible."""
    isolated = named_by(recipe, Isolate)
    return index not in named_by(recipe, Remove) and (not isolated or index in isolated)


def numbered(recipe: Recipe, names: tuple[str, ...]) -> Recipe:
    """The same recipe with endmembers given by their numbers: `names` are those of the run's before any edit, unknown
    ones stay, and are refused when it is applied."""
    present = list(names)

    def number_of(endmember: str | int) -> str | int:
        found = find_endmember(endmember, present) if isinstance(endmember, str) else None
        return endmember if found is None else found

    operations: list[Operation] = []
    for one in recipe.operations:
        given = {name: getattr(one, name, None) for name in ("endmember", "first", "second")}
        changes: dict[str, Any] = {
            name: number_of(value) for name, value in given.items() if value is not None
        }
        if isinstance(one, Remove | Isolate):
            changes["endmembers"] = tuple(number_of(name) for name in one.endmembers)
        operations.append(changed := replace(one, **changes))
        if isinstance(changed, Rename) and changed.endmember in range(len(present)):
            present[int(changed.endmember)] = changed.name
    return replace(recipe, operations=tuple(operations))


def change_of(recipe: Recipe, kind: type[_ChangeT], endmember: int) -> _ChangeT | None:
    """The change of a kind, in force, that a recipe makes to what an endmember is by its number now."""
    changes = [recipe.operations[position] for position in _changes_of(recipe, endmember)]
    last: Any = next((one for one in reversed(changes) if kind in _SUPERSEDED[type(one)]), None)
    return last if isinstance(last, kind) else None


def _changes_of(recipe: Recipe, endmember: str | int | None) -> list[int]:
    """Positions of the changes of what an endmember is now, the first first: of its own name and gloss, and of its
    spectrum wherever that was before swaps."""
    positions: list[int] = []
    place = endmember
    for position, one in reversed(list(enumerate(recipe.operations))):
        if isinstance(one, Swap) and place in (one.first, one.second):
            place = one.second if place == one.first else one.first
        elif isinstance(one, Rename | Gloss):
            positions += [position] if one.endmember == endmember else []
        elif isinstance(one, Replace | Retint | Scale) and one.endmember == place:
            positions.append(position)
    return positions[::-1]


def _with_operations(recipe: Recipe, operations: Iterable[Operation]) -> Recipe:
    return replace(recipe, operations=tuple(operations)[-MOST_EDITS:])
