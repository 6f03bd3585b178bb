"""Units: what is the same, and by which factor one becomes the other."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from diransac.data.units import conversion, same_unit, split_unit

SAME = [
    ("m/s^2", "m s^-2"),
    ("m/s^2", "m/s**2"),
    ("m/s^2", "m·s⁻²"),
    ("m/s^2", "m/s2"),
    ("m/s^2", "m/(s s)"),
    ("m/s^2", " m / s ^ 2 "),
    ("m/s^2", "m/s/s"),
    ("N m", "N*m"),
    ("N m", "Nm"),
    ("N m", "N.m"),
    ("N m", "kg m^2/s^2"),
    ("N", "kg m/s^2"),
    ("N s/m", "kg/s"),
    ("kg m^2", "m^2 kg"),
    ("s/m", "1/(m/s)"),
    ("rad", "1"),
    ("rad", ""),
    ("rad/s", "1/s"),
    ("1/s", "Hz"),
    ("N s^2/m^2", "kg/m"),
    ("W", "V A"),
    ("deg", "°"),
    ("sqrt furlong", "sqrt  furlong"),
]
DIFFERENT = [
    ("m", "mm"),
    ("m/s", "m/s^2"),
    ("rad", "deg"),
    ("Hz", "rad/s"),
    ("N", "N m"),
    ("kg", "g"),
    ("m", "furlong"),
    ("m", "m)"),
    ("m", "(m"),
    ("m", "m^"),
    ("m", "m/"),
    ("m", "0 m"),
    ("m", "m #"),
]


@pytest.mark.parametrize(("a", "b"), SAME)
def test_same_unit_sees_through_the_spelling(a, b):
    assert same_unit(a, b)
    assert same_unit(b, a)


@pytest.mark.parametrize(("a", "b"), DIFFERENT)
def test_same_unit_tells_units_apart(a, b):
    assert not same_unit(a, b)
    assert not same_unit(b, a)


@pytest.mark.parametrize(
    ("a", "b", "factor"),
    [
        ("deg", "rad", math.pi / 180.0),
        ("deg/s", "rad/s", math.pi / 180.0),
        ("mm", "m", 1e-3),
        ("ms", "s", 1e-3),
        ("us", "s", 1e-6),
        ("rpm", "rad/s", 2.0 * math.pi / 60.0),
        ("g", "m/s^2", 9.80665),
        ("g", "kg", 1e-3),
        ("kN", "N", 1e3),
        ("N mm", "N m", 1e-3),
        ("min", "s", 60.0),
        ("m/s^2", "m s^-2", 1.0),
    ],
)
def test_conversion_gives_the_factor(a, b, factor):
    assert conversion(a, b) == pytest.approx(factor, rel=1e-12)
    assert conversion(b, a) == pytest.approx(1.0 / factor, rel=1e-12)


NO_FACTOR = [("m", "s"), ("Hz", "rad/s"), ("furlong", "m"), ("m^999999999", "m"), ("1e999 m", "m")]


@pytest.mark.parametrize(("a", "b"), NO_FACTOR)
def test_conversion_is_none_where_no_factor_is_known(a, b):
    assert conversion(a, b) is None


symbols = st.sampled_from(["m", "s", "kg", "rad", "N", "mm", "A", "deg"])
products = st.lists(st.tuples(symbols, st.integers(-4, 4).filter(bool)), min_size=1, max_size=5)


def spelled_as_quotient(parts):
    above = " ".join(f"{s}^{p}" for s, p in parts if p > 0) or "1"
    below = "".join(f"/{s}**{-p}" for s, p in parts if p < 0)
    return above + below


def spelled_as_product(parts):
    return "*".join(f"{s}^({p})" for s, p in reversed(parts))


@given(products)
def test_every_spelling_of_a_product_is_the_same_unit(parts):
    assert same_unit(spelled_as_quotient(parts), spelled_as_product(parts))


@given(products, products)
def test_conversion_back_is_the_inverse(a, b):
    one, other = spelled_as_product(a), spelled_as_quotient(b)
    forth, back = conversion(one, other), conversion(other, one)
    assert (forth is None) == (back is None)
    if forth is not None:
        assert forth * back == pytest.approx(1.0, rel=1e-9)


@given(st.text(max_size=20), st.text(max_size=20))
def test_any_text_is_answered(a, b):
    assert same_unit(a, a)
    assert conversion(a, b) is None or conversion(a, b) > 0.0


@pytest.mark.parametrize(
    ("header", "expected"),
    [
        ("theta [deg]", ("theta", "deg")),
        ("theta[rad/s]", ("theta", "rad/s")),
        (" x ", ("x", None)),
        ("q[0]", ("q[0]", None)),
        ("angle [°]", ("angle", "°")),
        ("duty [%]", ("duty", "%")),
        ("ratio [1]", ("ratio [1]", None)),
        ("[deg]", ("[deg]", None)),
        ("", ("", None)),
    ],
)
def test_split_unit_takes_the_unit_off_a_header(header, expected):
    assert split_unit(header) == expected
