"""Recipes as panels build them: each change is an edit of the recipe, and can be undone.

Endmembers are given by their number, which no edit changes. A second change of the same kind to the same endmember
replaces the first, wherever swaps have taken its look since.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Hashable, Iterable
from dataclasses import replace
from typing import Any

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

_OF_LOOKS = (Replace, Retint, Scale)
"""Changes of spectra, which a swap takes along; names and gloss stay where they are."""
_MOST_UNDONE = 200
_MOST_OPERATIONS = 500
_ONE_EDIT_S = 2.0
"""Changes of the same thing in quicker succession, as while a slider is dragged, are undone together."""


class RecipeHistory:
    """The recipe in force, those before it, and those that were undone."""

    def __init__(self, present: Recipe | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self._past: list[Recipe] = []
        self._future: list[Recipe] = []
        self._clock = clock
        self._last_change: tuple[Hashable, float] = (None, 0.0)
        self.present = present or Recipe()

    def take(self, recipe: Recipe, subject: Hashable = None) -> None:
        """Put another recipe in force; `subject` is what is changed, None for a change that is undone by itself."""
        if recipe == self.present:
            return
        now, (last_subject, changed_at) = self._clock(), self._last_change
        if subject is None or subject != last_subject or now - changed_at > _ONE_EDIT_S:
            self._past = [*self._past, self.present][-_MOST_UNDONE:]
        self._last_change = (subject, now)
        self._future.clear()
        self.present = recipe

    def undone(self) -> Recipe | None:
        """Go back by one; None at the beginning."""
        return self._step(self._past, self._future)

    def redone(self) -> Recipe | None:
        """Go forward again by one; None at the end."""
        return self._step(self._future, self._past)

    def _step(self, source: list[Recipe], target: list[Recipe]) -> Recipe | None:
        if not source:
            return None
        self._last_change = (None, 0.0)
        target.append(self.present)
        self.present = source.pop()
        return self.present


def with_change(recipe: Recipe, change: Replace | Retint | Scale | Rename | Gloss) -> Recipe:
    """The recipe with a change of one endmember, in place of an earlier one of the same kind."""
    earlier = _changes_of(recipe, type(change), change.endmember)
    others = [one for position, one in enumerate(recipe.operations) if position not in earlier]
    return _with_operations(recipe, [*others, change])


def with_swap(recipe: Recipe, swap: Swap) -> Recipe:
    """The recipe with two endmembers swapped; swapping the same two again at once undoes it."""
    last = recipe.operations[-1] if recipe.operations else None
    if isinstance(last, Swap) and {last.first, last.second} == {swap.first, swap.second}:
        return _with_operations(recipe, recipe.operations[:-1])
    return _with_operations(recipe, [*recipe.operations, swap])


def with_visible(recipe: Recipe, hidden: Iterable[int], isolated: int | None) -> Recipe:
    """The recipe that shows all endmembers but the hidden ones, or the isolated one alone."""
    others = [one for one in recipe.operations if not isinstance(one, Remove | Isolate)]
    if isolated is not None:
        return _with_operations(recipe, [*others, Isolate((isolated,))])
    gone = tuple(sorted(set(hidden)))
    return _with_operations(recipe, [*others, Remove(gone)] if gone else others)


def visibility(recipe: Recipe) -> tuple[frozenset[int], frozenset[int]]:
    """Numbers of the endmembers that a numbered recipe removes, and of those that it isolates."""
    removed, isolated = (
        frozenset(
            index
            for one in recipe.operations
            if isinstance(one, kind)
            for index in one.endmembers
            if isinstance(index, int)
        )
        for kind in (Remove, Isolate)
    )
    return removed, isolated


def numbered(recipe: Recipe, names: tuple[str, ...]) -> Recipe:
    """The same recipe with endmembers given by their numbers; unknown names stay, and are refused when it is applied.

    Args:
        recipe: As written by hand, perhaps.
        names: Of the run's endmembers before any edit.
    """
    present = list(names)

    def number_of(endmember: str | int) -> str | int:
        return present.index(endmember) if endmember in present else endmember

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


def change_of(recipe: Recipe, kind: type[Operation], endmember: int) -> Operation | None:
    """The change of a kind that a recipe makes to an endmember by its number."""
    return next((recipe.operations[position] for position in _changes_of(recipe, kind, endmember)), None)


def _changes_of(recipe: Recipe, kind: type[Operation], endmember: str | int | None) -> list[int]:
    """Positions of the changes of a kind that an endmember shows at the end, the first first."""
    positions, there = [], endmember
    for position, one in reversed(list(enumerate(recipe.operations))):
        if isinstance(one, Swap) and kind in _OF_LOOKS and there in (one.first, one.second):
            there = one.second if there == one.first else one.first
        elif type(one) is kind and getattr(one, "endmember", None) == there:
            positions.append(position)
    return positions[::-1]


def _with_operations(recipe: Recipe, operations: Iterable[Operation]) -> Recipe:
    return replace(recipe, operations=tuple(operations)[-_MOST_OPERATIONS:])
