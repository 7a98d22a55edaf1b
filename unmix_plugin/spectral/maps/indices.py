"""Spectral indices: one number a pixel from its reflectance at a few wavelengths, by name or by formula.

A formula such as `(r800-r670)/(r800+r670)` is written in numbers, wavelengths (`r800`, `r800.5`: the reflectance
there), operators that bind as in Python, and six functions, upper and lower case alike. Python parses it to a tree, of
which only the nodes of these operations are evaluated: nothing that a user wrote is executed.

Notation: `B` bands, `*rays` any leading axes. Reflectance is what an index is defined on; ratios alone take radiance in
a light of equal power just as well. Between two band centres reflectance is interpolated linearly, in the outer half of
an outermost band it is that band's; beyond, an index is refused: nothing is extrapolated. Named indices are not
interpolated between bands that are far apart: they take the nearest.
"""

from __future__ import annotations

import ast
import csv
import difflib
import re
import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import lru_cache, reduce
from importlib import resources

import torch
from jaxtyping import Float
from torch import Tensor

from unmix_plugin.errors import ConfigError, SpectrumError, name_some
from unmix_plugin.spectral.bands import Bands

_MAX_LENGTH = 500
"""Characters of a formula."""
_FAR_NM = 50.0
"""Bands farther apart are those of multispectral cameras: from red to infrared a leaf's spectrum is a step, not a line.
Their bands are as broad, so one stands for wavelengths so far away, as the red and infrared of broad-band indices."""
_ALLOWED = (
    "numbers, r800 (the reflectance at 800 nm), + - * / ** ^, parentheses, sqrt log exp abs of one value, "
    "min max of several"
)

_TOKEN = re.compile(
    r"(?P<number>(?:[0-9]+\.?[0-9]*|\.[0-9]+)(?:e[+-]?[0-9]+)?)|r(?P<nm>[0-9]+(?:\.[0-9]+)?)(?![\w.])"
    r"|(?P<word>[a-z_][\w.]*)|(?P<other>[^\s\w.+*/^(),-])",
    re.ASCII,
)
_FUNCTIONS = {"sqrt": torch.sqrt, "log": torch.log, "exp": torch.exp, "abs": torch.abs}
_FUNCTIONS_OF_SEVERAL = {"min": torch.minimum, "max": torch.maximum}


def _power(base: Tensor, exponent: Tensor) -> Tensor:
    # The zeros carry what is undefined: alone, NaN**0 and 1**NaN are 1.
    return base**exponent + 0 * base + 0 * exponent


_OPERATORS: dict[type[ast.AST], Callable[[Tensor, Tensor], Tensor]] = {
    ast.Add: torch.add,
    ast.Sub: torch.sub,
    ast.Mult: torch.mul,
    ast.Div: torch.div,
    ast.Pow: _power,
}


@dataclass(frozen=True)
class _Formula:
    """A formula that was read: over at least one wavelength."""

    text: str
    """In lower case, with single blanks."""
    wavelengths: dict[str, float]
    """Wavelengths in nm by their name in the tree."""
    tree: ast.expr = field(compare=False, repr=False)

    @property
    def wavelengths_nm(self) -> tuple[float, ...]:
        """The wavelengths that it takes, increasing, each once."""
        return tuple(sorted(set(self.wavelengths.values())))

    def evaluate(
        self, at: Callable[[float], Float[Tensor, "*rays"]], like: Float[Tensor, "..."]
    ) -> Float[Tensor, "*rays"]:
        """Value of the formula; NaN where any part of it is not finite, also where that part would cancel.

        Args:
            at: Reflectance at one of `wavelengths_nm`; asked again at each mention, so that few are held at a time.
            like: Of the type and on the device to compute with.
        """

        def value(node: ast.AST) -> Tensor:
            match node:
                case ast.Name(id=name) if name in self.wavelengths:
                    found = at(self.wavelengths[name])
                case ast.Constant(value=int() | float() as number):  # PyTorch refuses numbers beyond its type
                    is_known = number <= torch.finfo(like.dtype).max
                    found = like.new_full((), float(number) if is_known else torch.nan)
                case ast.UnaryOp(op=ast.USub(), operand=operand):
                    found = -value(operand)
                case ast.BinOp(left=left, op=sign, right=right) if type(sign) in _OPERATORS:
                    found = _OPERATORS[type(sign)](value(left), value(right))
                case ast.Call(func=ast.Name(id=name), args=[only], keywords=[]) if name in _FUNCTIONS:
                    found = _FUNCTIONS[name](value(only))
                case ast.Call(
                    func=ast.Name(id="min" | "max" as name), args=[_, _, *_] as several, keywords=[]
                ):
                    found = reduce(_FUNCTIONS_OF_SEVERAL[name], map(value, several))
                case _:
                    raise _fault(self.text, getattr(node, "col_offset", 0))
            # At every step, or 1 / (1 / 0) would be 0.
            return found.masked_fill(~found.isfinite(), torch.nan)

        return value(self.tree)


_PARSER = threading.Lock()
"""Held while Python parses: in threads at once `ast.parse` fails now and then up to 3.11 (CPython issue 106905)."""


@lru_cache(maxsize=256)
def parse_formula(text: str) -> _Formula:
    """Read a formula; one that was read lately is not parsed again.

    Raises:
        ConfigError: no formula, too long, nested too deep, or without a wavelength; the message shows the place.

    >>> parse_formula("r800 / r670").wavelengths_nm
    (670.0, 800.0)
    """
    if len(text.strip()) > _MAX_LENGTH:
        raise ConfigError(
            f"an index formula has at most {_MAX_LENGTH} characters; this one has {len(text.strip())}"
        )
    text = " ".join(text.lower().replace("^", "**").split())
    wavelengths: dict[str, float] = {}
    expression = text
    for match in _TOKEN.finditer(text):
        read = match[0]  # rewritten in as many characters, so that places stay
        if match["nm"]:
            read = read.replace(".", "_")
            wavelengths[read] = float(match["nm"])
        elif match["number"]:  # Python refuses zeros before a whole number
            read = re.sub(r"^0+(?=[0-9])", "", read).ljust(len(read))
        elif match["other"] or (
            match["word"] and match["word"] not in {**_FUNCTIONS, **_FUNCTIONS_OF_SEVERAL}
        ):
            raise _fault(text, match.start())
        expression = expression[: match.start()] + read + expression[match.end() :]
    try:
        with _PARSER:
            tree = ast.parse(expression, mode="eval").body
        formula = _Formula(text, wavelengths, tree)
        formula.evaluate(lambda _: torch.zeros(()), torch.zeros(()))  # which refuses what is not allowed
    except SyntaxError as error:
        raise _fault(text, (error.offset or 1) - 1) from error
    except (RecursionError, MemoryError) as error:
        raise ConfigError(f"the index formula {text!r} is nested too deep") from error
    if not wavelengths:
        raise ConfigError(
            f"the index formula {text!r} takes no wavelength; write r800 for the reflectance at 800 nm"
        )
    return formula


def _fault(text: str, place: int) -> ConfigError:
    """What is wrong at a place of a formula."""
    return ConfigError(
        f"index formula, column {place + 1}: can't be read here\n  {text}\n  {' ' * place}^\nallowed are {_ALLOWED}"
    )


@dataclass(frozen=True)
class _NamedIndex:
    """A published index, at the centre wavelengths that we take for its bands."""

    title: str
    """Full name."""
    formula: str
    """As `parse_formula` reads it."""
    source: str
    """Who published it."""
    usual_range: tuple[float, float]
    """Values that pictures spread their colours over."""


def _named_indices() -> dict[str, _NamedIndex]:
    """The rows of indices.csv."""
    table = (resources.files("unmix_plugin.spectral.maps") / "indices.csv").read_text(encoding="utf-8")
    return {
        name: _NamedIndex(title, formula, source, (float(low), float(high)))
        for name, title, formula, source, low, high in list(csv.reader(table.splitlines()))[1:]
    }


NAMED_INDICES = _named_indices()
"""By the name after `index:`, in the order in which they are listed."""


@dataclass(frozen=True)
class _SpectralIndex:
    """An index on spectra of one sampling: call it on reflectance."""

    name: str
    """Of a named index, otherwise the formula as it was written."""
    title: str
    """Full name."""
    remarks: tuple[str, ...]
    """Formula and source of a named index, and the bands that it is computed from."""
    usual_range: tuple[float, float] | None
    """Values that pictures spread their colours over; None for a formula, of which nothing is known."""
    bands: Bands
    formula: _Formula

    @property
    def what(self) -> str:
        """Title and remarks in one line."""
        *formula, bands = self.remarks
        return f"{', '.join([self.title, *formula])}; {bands}"

    def __call__(self, reflectance: Float[Tensor, "*rays B"]) -> Float[Tensor, "*rays"]:
        """The index of each spectrum; NaN where any part of the formula is undefined, as in 0/0, or overflows."""
        if reflectance.shape[-1] != len(self.bands):
            raise SpectrumError(
                f"index {self.name} is made for {self.bands}; found spectra of {reflectance.shape[-1]}"
            )
        return self.formula.evaluate(lambda nm: _reflectance_at(nm, reflectance, self.bands), reflectance)


def parse_index(text: str, bands: Bands) -> _SpectralIndex:
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
        raise SpectrumError(
            f"index {name} needs {_listed(missing)} nm but the bands cover {bands.coverage}; "
            f"nothing is extrapolated; named ones that these bands reach: "
            f"{', '.join(available_indices(bands)) or 'none'}"
        )
    if named:
        on_bands = named_formula(name, bands)
        if on_bands is None:
            raise SpectrumError(
                f"index {name} needs {_listed(formula.wavelengths_nm)} nm, and of each a band of its own within "
                f"{_FAR_NM:g} nm, but the bands lie at {name_some([f'{nm:g}' for nm in bands.centers_nm], 12)} nm; "
                f"named ones that they reach: {', '.join(available_indices(bands)) or 'none'}"
            )
        formula = parse_formula(on_bands)
    used = {index for nm in formula.wavelengths_nm for index in _neighbours(nm, bands)[:2]}
    centres = _listed(float(bands.centers_nm[index]) for index in sorted(used))
    text, seen_in = " ".join(formula.text.split()), f"from the bands at {centres} nm"
    if named is None:
        return _SpectralIndex(name, f"formula {text}", (seen_in,), None, bands, formula)
    remarks = (f"{text} ({named.source})", seen_in)
    return _SpectralIndex(name, named.title, remarks, named.usual_range, bands, formula)


def available_indices(bands: Bands) -> list[str]:
    """Names of the indices whose wavelengths the bands reach, in the order of `NAMED_INDICES`."""
    return [name for name in NAMED_INDICES if named_formula(name, bands)]


def named_formula(name: str, bands: Bands) -> str | None:
    """A named index's formula for these bands, with the nearest band instead of a wavelength between bands that are
    far apart; None where they do not reach a wavelength or don't tell two apart.

    >>> named_formula("ndvi", Bands.of([560, 650, 840]))
    '(r840-r650)/(r840+r650)'
    """
    formula = parse_formula(NAMED_INDICES[name].formula)
    taken = {}
    for nm in formula.wavelengths_nm if not _missing(formula, bands) else ():
        left, right, _ = _neighbours(nm, bands)
        step = bands.centers_nm[right] - bands.centers_nm[left]
        taken[nm] = nm if 0 < step <= _FAR_NM else float(bands.centers_nm[bands.nearest(nm)])
    is_near = all(abs(place - nm) <= _FAR_NM for nm, place in taken.items())
    if not taken or not is_near or len(set(taken.values())) < len(taken):
        return None
    return re.sub(r"(?<=r)\d+", lambda match: f"{taken[float(match[0])]:.10g}", formula.text)


def _require_formula(text: str) -> str:
    """The text, unless it is empty or no more than a word, which can only be a name."""
    if not text:
        raise ConfigError(
            f"index: is followed by nothing; give a name ({', '.join(NAMED_INDICES)}) or a formula of {_ALLOWED}"
        )
    if not re.fullmatch(r"[a-z_][\w-]*", text, re.IGNORECASE) or re.search(r"\br[0-9]", text, re.IGNORECASE):
        return text
    near = difflib.get_close_matches(text.lower(), NAMED_INDICES, n=3, cutoff=0.5)
    hint = f"nearest: {', '.join(near)}" if near else f"known: {', '.join(NAMED_INDICES)}"
    raise ConfigError(f"there is no index {text!r}; {hint}; or give a formula of {_ALLOWED}")


def _missing(formula: _Formula, bands: Bands) -> list[float]:
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
