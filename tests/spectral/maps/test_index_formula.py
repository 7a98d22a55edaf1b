import math
import time

import pytest
import torch

from unmix_plugin.errors import ConfigError
from unmix_plugin.spectral.maps.indices import parse_formula

VALUES = {450.0: 0.05, 550.0: 0.12, 670.0: 0.3, 800.0: 0.7}


def value(text, dtype=torch.float64):
    """The formula's value where r450 = 0.05, r550 = 0.12, r670 = 0.3, r800 = 0.7."""
    like = torch.zeros((), dtype=dtype)
    return parse_formula(text).evaluate(lambda nm: like.new_tensor(VALUES[nm]), like)


@pytest.mark.parametrize(
    "text",
    [
        "r800",
        "r800-r670-r550",
        "r800/r670/r550",
        "r800-(r670-r550)",
        "r800/(r670/r550)",
        "r800+r670*r550",
        "(r800+r670)*r550",
        "r800/r670*r550",
        "-r800**2",
        "(-r800)**2",
        "r800**-2",
        "r800**-r670**2",
        "2**r800**r670",
        "(2**r800)**r670",
        "r800*-r670",
        "--r800",
        "r800--r670",
        "-r800*r670-r550",
        "1/r550-1/r800",
        "2.5*(r800-r670)/(r800+6*r670-7.5*r450+1)",
        "1e-2*r800 + .5E1 + 3.",
        " ( r800 -\tr670 ) / r550 ",
        "sqrt(r800) + log(r670) * exp(-r550) - abs(r450-r800)",
        "min(r800, r670, 0.1) + max(r550, r450**2)",
        "max(min(r800, 1), r670/r550)",
    ],
)
def test_operators_bind_as_in_python(text):
    names = {f"r{nm:g}": number for nm, number in VALUES.items()}
    python = eval(text.strip(), {**vars(math), "abs": abs, "min": min, "max": max}, names)
    assert float(value(text)) == pytest.approx(python, rel=1e-14)


def test_a_caret_is_the_power_operator_and_case_does_not_matter():
    assert value("R800^2^2*SQRT(R670)") == value("r800**2**2*sqrt(r670)")


def test_wavelengths_are_listed_once_and_may_have_decimals():
    assert parse_formula("r800.5/(r670+r800.5)-r450").wavelengths_nm == (450.0, 670.0, 800.5)


@pytest.mark.parametrize(
    "text",
    [
        "0*r800/(r670-r670)",
        "1/(1/(r800-r800))",
        "((r800-r800)/(r800-r800))**0",
        "1**log(-r800)",
        "max(r800, log(0))",
        "exp(-exp(1e4*r800))",
        "log(-r800)",
        "sqrt(-r800)",
        "(-r800)**0.5",
        "0*r800**-1e999",
        "r800*10**10**10",
        "r800+1e300*1e300",
        "r800*1e999",
    ],
)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_what_is_undefined_anywhere_in_a_formula_is_nan(text, dtype):
    result = value(text, dtype)
    assert result.dtype == dtype
    assert result.isnan()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "(r800-)",
            r"column 7: expected a number, a wavelength, a function or \(, found '\)'\n  \(r800-\)\n {8}\^",
        ),
        ("(r800-r670", r"column 11: expected \), found the end"),
        ("r800)", r"column 5: expected an operator or the end, found '\)'"),
        ("2r800", r"column 2: expected an operator or the end, found 'r800'"),
        ("r800 r670", r"column 6: expected an operator"),
        ("r800nm", r"column 1: .* found 'r800nm'"),
        ("r800+b3", r"column 6: .* found 'b3'"),
        ("sqrt r800", r"column 6: expected \( after sqrt, found 'r800'"),
        ("1+sqrt(r800, 2)", r"column 3: sqrt takes one argument, not 2"),
        ("min(r800)", r"column 1: min takes at least 2 arguments, not 1"),
        ("r800 // 2", r"column 7: .* found '/'"),
        ("r800 % 2", r"column 6: .* found '%'"),
        ("r800\n+?", r"column 7: .* found '\?'\n  r800 \+\?\n {8}\^"),
        ("", r"column 1: .* found the end"),
    ],
)
def test_a_fault_is_shown_at_its_place_with_what_is_allowed(text, message):
    with pytest.raises(ConfigError, match=message) as caught:
        parse_formula(text)
    assert "allowed are numbers, r800" in str(caught.value)


@pytest.mark.parametrize("text", ["1+2", "sqrt(2)", "10**10**10"])
def test_a_formula_needs_a_wavelength(text):
    with pytest.raises(ConfigError, match="takes no wavelength; write r800 for the reflectance at 800 nm"):
        parse_formula(text)


@pytest.mark.parametrize(
    "text",
    [
        "__import__('os').system('true')",
        "r800.__class__",
        "(r800).real",
        "r800 if r800 else r670",
        "lambda: r800",
        "[r800 for _ in r800]",
        "r800; r670",
        "r800 = 1",
        "eval(r800)",
        "r\uff18\uff10\uff10",
        "\x00r800",
        "(" * 200 + "r800" + ")" * 200,
        "-" * 400 + "r800",
        "r800" + "**2" * 150,
        "sqrt(" * 90 + "r800",
    ],
)
def test_hostile_text_is_refused_at_once(text):
    start = time.process_time()  # not the clock on the wall: other work may run beside the tests
    with pytest.raises(ConfigError):
        parse_formula(text)
    assert time.process_time() - start < 0.5


def test_a_long_formula_is_refused_and_the_longest_is_read():
    longest = "r800" + "+r800" * 99
    assert len(longest) == 499
    assert float(value(longest)) == pytest.approx(70)
    with pytest.raises(ConfigError, match="at most 500 characters; this one has 504"):
        parse_formula(longest + "+r800")


def test_fifty_levels_are_read_and_one_more_is_refused():
    nested = "(" * 49 + "r800" + ")" * 49
    assert float(value(nested)) == 0.7
    with pytest.raises(ConfigError, match="column 51: nested deeper than 50"):
        parse_formula(f"({nested})")
