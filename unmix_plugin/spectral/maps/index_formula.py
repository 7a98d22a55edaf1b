"""Formulas over wavelengths, such as `(r800-r670)/(r800+r670)`: read once, evaluated on tensors; nothing is executed.

Grammar, binding as in Python, upper and lower case alike:

    sum      = product (("+" | "-") product)*
    product  = factor (("*" | "/") factor)*
    factor   = "-" factor | power
    power    = atom [("**" | "^") factor]
    atom     = number | rNNN | function "(" sum ("," sum)* ")" | "(" sum ")"

`rNNN` or `rNNN.N` is the reflectance at NNN nm. Reading makes a postfix program: operands first, then what is done to
them.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from functools import reduce
from typing import NoReturn

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError

MAX_LENGTH = 500
"""Characters of a formula."""
MAX_NESTING = 50
"""Parentheses, minus signs and exponents within one another."""

ALLOWED = "numbers, r800 (the reflectance at 800 nm), + - * / ** ^, parentheses, sqrt log exp abs min max"

_TOKEN = re.compile(
    r"(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?)"
    r"|(?P<word>[a-z_][a-z0-9_.]*)|(?P<sign>\*\*|[-+*/^(),])|(?P<end>\Z)|(?P<other>.)",
    re.IGNORECASE | re.DOTALL,
)
_WAVELENGTH = re.compile(r"r([0-9]+(?:\.[0-9]+)?)", re.IGNORECASE)
_BLANK = re.compile(r"\s*")


@dataclass(frozen=True)
class Wavelength:
    """A step that puts the reflectance at a wavelength on the stack."""

    nm: float


@dataclass(frozen=True)
class Operation:
    """A step that replaces the last `count` values on the stack by one."""

    name: str
    count: int


@dataclass(frozen=True)
class Formula:
    """A formula that was read: over at least one wavelength."""

    text: str
    """As it was written, without blanks around it."""
    steps: tuple[float | Wavelength | Operation, ...]
    """Postfix program; a number is pushed as it is."""

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """The wavelengths that it takes, increasing, each once."""
        return tuple(sorted({step.nm for step in self.steps if isinstance(step, Wavelength)}))

    def evaluate(
        self, at: Callable[[float], Float[Tensor, "*rays"]], like: Float[Tensor, "..."]
    ) -> Float[Tensor, "*rays"]:
        """Value of the formula; NaN where any part of it is not finite, also where that part would cancel.

        Args:
            at: Reflectance at one of `wavelengths_nm`; asked again at each mention, so that few are held at a time.
            like: Of the type and on the device to compute with.
        """
        stack: list[Tensor] = []
        for step in self.steps:
            if isinstance(step, Operation):
                operands = stack[-step.count :]
                del stack[-step.count :]
                value = _OPERATIONS[step.name](*operands)
            elif isinstance(step, Wavelength):
                value = at(step.nm)
            else:  # a number too large for the type is refused by PyTorch
                value = like.new_full((), step if step <= torch.finfo(like.dtype).max else torch.nan)
            # At every step, or 1 / (1 / 0) would be 0.
            stack.append(value.masked_fill(~value.isfinite(), torch.nan))
        return stack.pop()


def parse_formula(text: str) -> Formula:
    """Read a formula.

    Raises:
        ConfigError: no formula, too long, nested too deep, or without a wavelength; the message shows the place.

    >>> parse_formula("r800 / r670").wavelengths_nm
    (670.0, 800.0)
    """
    text = text.strip()
    if len(text) > MAX_LENGTH:
        raise ConfigError(f"an index formula has at most {MAX_LENGTH} characters; this one has {len(text)}")
    formula = Formula(text, tuple(_Reader(text).read()))
    if not formula.wavelengths_nm:
        raise ConfigError(
            f"the index formula {text!r} takes no wavelength; write r800 for the reflectance at 800 nm"
        )
    return formula


class _Reader:
    """Recursive descent over one text; `steps` grows as operands and operations are recognised."""

    def __init__(self, text: str) -> None:
        self.text = text
        self.depth = 0
        self.steps: list[float | Wavelength | Operation] = []
        self.end = 0
        self.advance()

    def read(self) -> list[float | Wavelength | Operation]:
        self.sum()
        if self.token:
            self.fail("expected an operator or the end")
        return self.steps

    def advance(self) -> None:
        """Step to the next token; the empty one ends the text."""
        blank = _BLANK.match(self.text, self.end)
        match = _TOKEN.match(self.text, blank.end() if blank else self.end)
        assert match is not None, "the pattern has an alternative for any character and for the end"
        self.kind, self.token = match.lastgroup, match.group()
        self.start, self.end = match.span()

    def take(self, *signs: str) -> str:
        """The token and a step onwards if it is one of these, otherwise nothing."""
        token = self.token if self.token in signs else ""
        if token:
            self.advance()
        return token

    def sum(self) -> None:
        self.product()
        while sign := self.take("+", "-"):
            self.product()
            self.steps.append(Operation(sign, 2))

    def product(self) -> None:
        self.factor()
        while sign := self.take("*", "/"):
            self.factor()
            self.steps.append(Operation(sign, 2))

    def factor(self) -> None:
        self.depth += 1
        if self.depth > MAX_NESTING:
            self.fail(f"nested deeper than {MAX_NESTING}")
        if self.take("-"):
            self.factor()
            self.steps.append(Operation("negative", 1))
        else:
            self.atom()
            if self.take("**", "^"):
                self.factor()
                self.steps.append(Operation("**", 2))
        self.depth -= 1

    def atom(self) -> None:
        wavelength = _WAVELENGTH.fullmatch(self.token)
        if wavelength:
            self.steps.append(Wavelength(float(wavelength.group(1))))
            self.advance()
        elif self.kind == "number":
            self.steps.append(float(self.token))
            self.advance()
        elif self.token.lower() in _ARGUMENT_COUNTS:
            self.call()
        elif self.take("("):
            self.sum()
            self.close()
        else:
            self.fail("expected a number, a wavelength, a function or (")

    def call(self) -> None:
        name, place = self.token.lower(), self.start
        self.advance()
        if not self.take("("):
            self.fail(f"expected ( after {name}")
        self.sum()
        count = 1
        while self.take(","):
            self.sum()
            count += 1
        self.close()
        least, most = _ARGUMENT_COUNTS[name]
        if not least <= count <= most:
            takes = "one argument" if most == 1 else f"at least {least} arguments"
            self.fail(f"{name} takes {takes}, not {count}", place)
        self.steps.append(Operation(name, count))

    def close(self) -> None:
        if not self.take(")"):
            self.fail("expected )")

    def fail(self, problem: str, place: int | None = None) -> NoReturn:
        column = self.start if place is None else place
        found = "" if place is not None else f", found {self.token!r}" if self.token else ", found the end"
        shown = " ".join(self.text.splitlines())  # one line, so that the caret is below its column
        raise ConfigError(
            f"index formula, column {column + 1}: {problem}{found}\n  {shown}\n  {' ' * column}^\n"
            f"allowed are {ALLOWED}"
        )


def _power(base: Tensor, exponent: Tensor) -> Tensor:
    # The zeros carry what is undefined: alone, NaN**0 and 1**NaN are 1.
    return base**exponent + 0 * base + 0 * exponent


_OPERATIONS: dict[str, Callable[..., Tensor]] = {
    "+": torch.add,
    "-": torch.sub,
    "*": torch.mul,
    "/": torch.div,
    "**": _power,
    "negative": torch.neg,
    "sqrt": torch.sqrt,
    "log": torch.log,
    "exp": torch.exp,
    "abs": torch.abs,
    "min": lambda *values: reduce(torch.minimum, values),
    "max": lambda *values: reduce(torch.maximum, values),
}
_ARGUMENT_COUNTS = {
    **dict.fromkeys(("sqrt", "log", "exp", "abs"), (1, 1)),
    **dict.fromkeys(("min", "max"), (2, math.inf)),
}
