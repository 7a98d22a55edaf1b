"""Formulas over wavelengths, such as `(r800-r670)/(r800+r670)`: read once, evaluated on tensors; nothing is executed.

Grammar, binding as in Python, upper and lower case alike:

    sum      = product (("+" | "-") product)*
    product  = factor (("*" | "/") factor)*
    factor   = "-" factor | power
    power    = atom [("**" | "^") factor]
    atom     = number | rNNN | function "(" sum ("," sum)* ")" | "(" sum ")"

`rNNN` or `rNNN.N` is the reflectance at NNN nm. Reading makes a postfix program: operands first, then what is done to
them.

Spectral indices: one number a pixel from its reflectance at a few wavelengths, by name or by formula.

Notation: `B` bands, `*rays` any leading axes. Reflectance is what an index is defined on; ratios alone take radiance in
a light of equal power just as well. Between two band centres reflectance is interpolated linearly, in the outer half of
an outermost band it is that band's; beyond, an index is refused: nothing is extrapolated.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import reduce
from typing import NoReturn

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError, SpectrumError
from unmix_plugin.spectral.bands import Bands

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


@dataclass(frozen=True)
class NamedIndex:
    """A published index, at the centre wavelengths that we take for its bands."""

    title: str
    """Full name."""
    formula: str
    """In the grammar of `index_formula`."""
    source: str
    """Who published it."""
    usual_range: tuple[float, float] = (-1.0, 1.0)
    """Values that pictures spread their colours over."""


NAMED_INDICES: dict[str, NamedIndex] = {
    "ndvi": NamedIndex(
        "normalised difference vegetation index", "(r800-r670)/(r800+r670)", "Rouse et al. 1974"
    ),
    "gndvi": NamedIndex(
        "green normalised difference vegetation index",
        "(r800-r550)/(r800+r550)",
        "Gitelson, Kaufman & Merzlyak 1996",
    ),
    "evi": NamedIndex(
        "enhanced vegetation index", "2.5*(r800-r670)/(r800+6*r670-7.5*r470+1)", "Huete et al. 2002"
    ),
    "savi": NamedIndex("soil-adjusted vegetation index", "1.5*(r800-r670)/(r800+r670+0.5)", "Huete 1988"),
    "osavi": NamedIndex(
        "optimised soil-adjusted vegetation index",
        "(r800-r670)/(r800+r670+0.16)",
        "Rondeaux, Steven & Baret 1996",
    ),
    "ndre": NamedIndex("normalised difference red edge", "(r790-r720)/(r790+r720)", "Barnes et al. 2000"),
    "pri": NamedIndex(
        "photochemical reflectance index",
        "(r531-r570)/(r531+r570)",
        "Gamon, Peñuelas & Field 1992, in the form of Gamon, Serrano & Surfus 1997",
        (-0.2, 0.2),
    ),
    "mcari": NamedIndex(
        "modified chlorophyll absorption ratio index",
        "((r700-r670)-0.2*(r700-r550))*(r700/r670)",
        "Daughtry et al. 2000",
        (0.0, 1.0),
    ),
    "tvi": NamedIndex(
        "triangular vegetation index",
        "0.5*(120*(r750-r550)-200*(r670-r550))",
        "Broge & Leblanc 2001",
        (0.0, 50.0),
    ),
    "sipi": NamedIndex(
        "structure-insensitive pigment index (carotenoids to chlorophyll a)",
        "(r800-r445)/(r800-r680)",
        "Peñuelas, Baret & Filella 1995",
        (0.0, 2.0),
    ),
    "psri": NamedIndex(
        "plant senescence reflectance index", "(r678-r500)/r750", "Merzlyak et al. 1999", (-0.5, 0.5)
    ),
    "cri1": NamedIndex(
        "carotenoid reflectance index 1", "1/r510-1/r550", "Gitelson et al. 2002", (0.0, 15.0)
    ),
    "ari1": NamedIndex(
        "anthocyanin reflectance index 1",
        "1/r550-1/r700",
        "Gitelson, Merzlyak & Chivkunova 2001",
        (0.0, 10.0),
    ),
    "ndwi": NamedIndex(
        "normalised difference water index (open water)", "(r550-r800)/(r550+r800)", "McFeeters 1996"
    ),
    "ndwi-gao": NamedIndex(
        "normalised difference water index (water in leaves)", "(r860-r1240)/(r860+r1240)", "Gao 1996"
    ),
    "nbr": NamedIndex("normalised burn ratio", "(r830-r2215)/(r830+r2215)", "Key & Benson 2006"),
    "redness": NamedIndex(
        "redness index of soils (iron oxides)", "(r660-r560)/(r660+r560)", "Escadafal & Huete 1991"
    ),
    "iron-oxide": NamedIndex("iron oxide ratio, red over blue", "r660/r485", "Segal 1982", (0.0, 5.0)),
}
"""By the name after `index:`, in the order in which they are listed."""


@dataclass(frozen=True)
class SpectralIndex:
    """An index on spectra of one sampling: call it on reflectance."""

    name: str
    """Of a named index, otherwise the formula as it was written."""
    what: str
    """One line: full name, formula and source, and the bands it is computed from."""
    usual_range: tuple[float, float] | None
    """Values that pictures spread their colours over; None for a formula, of which nothing is known."""
    bands: Bands
    formula: Formula

    def __call__(self, reflectance: Float[Tensor, "*rays B"]) -> Float[Tensor, "*rays"]:
        """The index of each spectrum; NaN where any part of the formula is undefined, as in 0/0, or overflows.

        Raises:
            SpectrumError: another number of bands than those the index was made for.
        """
        if reflectance.shape[-1] != len(self.bands):
            raise SpectrumError(
                f"index {self.name} is made for {self.bands}; found spectra of {reflectance.shape[-1]}"
            )
        return self.formula.evaluate(lambda nm: _reflectance_at(nm, reflectance, self.bands), reflectance)


def parse_index(text: str, bands: Bands) -> SpectralIndex:
    """The index that a name (`ndvi`) or a formula (`(r800-r670)/(r800+r670)`) means on these bands.

    Raises:
        ConfigError: an unknown name (the message has the nearest), or no formula (it shows the place).
        SpectrumError: the bands do not reach a wavelength that the index needs.

    >>> index = parse_index("NDVI", Bands.of([660, 680, 800]))
    >>> index(torch.tensor([0.1, 0.1, 0.4]))
    tensor(0.6000)
    """
    text = text.strip()
    named = NAMED_INDICES.get(text.lower())
    name = text.lower() if named else text
    formula = parse_formula(named.formula if named else _require_formula(text))
    missing = _missing(formula, bands)
    if missing:
        edges = bands.edges_nm
        raise SpectrumError(
            f"index {name} needs {_listed(missing)} nm but the bands cover {edges[0]:g}-{edges[-1]:g} nm; "
            f"nothing is extrapolated; named ones that these bands reach: "
            f"{', '.join(available_indices(bands)) or 'none'}"
        )
    used = {index for nm in formula.wavelengths_nm for index in _neighbours(nm, bands)[:2]}
    centres = _listed(float(bands.centers_nm[index]) for index in sorted(used))
    title = f"{named.title}, {named.formula} ({named.source})" if named else f"formula {formula.text}"
    what = f"{' '.join(title.split())}; from the bands at {centres} nm"
    return SpectralIndex(name, what, named.usual_range if named else None, bands, formula)


def available_indices(bands: Bands) -> list[str]:
    """Names of the indices whose wavelengths the bands reach, in the order of `NAMED_INDICES`."""
    return [
        name for name, named in NAMED_INDICES.items() if not _missing(parse_formula(named.formula), bands)
    ]


def _require_formula(text: str) -> str:
    """The text, unless it is empty or no more than a word, which can only be a name."""
    if not text:
        raise ConfigError(
            f"index: is followed by nothing; give a name ({', '.join(NAMED_INDICES)}) or a formula of {ALLOWED}"
        )
    if not re.fullmatch(r"[a-z_][\w-]*", text, re.IGNORECASE) or re.search(r"\br[0-9]", text, re.IGNORECASE):
        return text
    near = difflib.get_close_matches(text.lower(), NAMED_INDICES, n=3, cutoff=0.5)
    hint = f"nearest: {', '.join(near)}" if near else f"known: {', '.join(NAMED_INDICES)}"
    raise ConfigError(f"there is no index {text!r}; {hint}; or give a formula of {ALLOWED}")


def _missing(formula: Formula, bands: Bands) -> list[float]:
    return [nm for nm in formula.wavelengths_nm if not bands.contains(nm)]


def _listed(wavelengths_nm: Iterable[float]) -> str:
    return ", ".join(f"{nm:g}" for nm in wavelengths_nm)


def _neighbours(nm: float, bands: Bands) -> tuple[int, int, float]:
    """The bands to the left and right of a covered wavelength and the weight of the right one; twice one band where
    the wavelength is its centre or lies beyond the outermost."""
    centers = bands.centers_nm
    right = min(int(centers.searchsorted(nm)), len(centers) - 1)
    if right == 0 or centers[right] <= nm:
        return right, right, 0.0
    left = right - 1
    return left, right, float((nm - centers[left]) / (centers[right] - centers[left]))


def _reflectance_at(nm: float, reflectance: Float[Tensor, "*rays B"], bands: Bands) -> Float[Tensor, "*rays"]:
    left, right, weight = _neighbours(nm, bands)
    if left == right:
        return reflectance[..., left]
    return torch.lerp(reflectance[..., left], reflectance[..., right], weight)
