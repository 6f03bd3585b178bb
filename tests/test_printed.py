"""Comparison of printed text with what a page shows of it: what agrees, what differs, and blocks by today's output."""

import pytest
from printed import agrees, disagreement, is_same_line, renewed

PRINTED = """\
machine by method
parameter  estimate  95 % interval  unit
mass       20.4132   19.9 .. 20.9   kg
drag       0.02044   unknown        N s/m

verdict: usable
  speed is off by 6.31 % of its motion
Next: nothing.
"""


def test_a_block_agrees_with_lines_left_out_only_where_it_says_so():
    assert agrees(PRINTED, PRINTED)
    assert agrees("...\nmass 20.4132 19.9 .. 20.9 kg\n...\nverdict: usable\n...\n", PRINTED)
    assert agrees("...\nNext: nothing.\n", PRINTED)
    assert not agrees("mass 20.4132 19.9 .. 20.9 kg\n...\n", PRINTED)
    assert not agrees("...\nverdict: usable\n", PRINTED)
    assert not agrees("...\nverdict: usable\nNext: nothing.\n", PRINTED)
    assert not agrees("...\nverdict: usable with care\n...\n", PRINTED)
    assert not agrees("", PRINTED)
    assert agrees("", "\n")


@pytest.mark.parametrize(
    ("shown", "printed", "same"),
    [
        ("off by 6.3 % of its motion", "off by 6.31 % of its motion", True),
        ("off by 6.3 % of its motion", "off by 6.36 % of its motion", False),
        ("off by 6.3 % of its motion", "off by -6.3 % of its motion", False),
        ("655 rows", "656 rows", False),
        ("1.2e-5 rad", "1.24e-05 rad", True),
        ("1.2e-5 rad", "1.26e-05 rad", False),
        ("mass  20.1  19.9 .. 20.9  kg", "mass 20.59 20.3 .. 21.1 kg", True),  # by half of the interval
        ("mass  20.1  19.9 .. 20.9  kg", "mass 20.71 20.3 .. 21.1 kg", False),
        ("spring 0.02 ± 0.001 explains 98 %", "spring 0.021 ± 0.001 explains 98 %", True),
        ("spring 0.02 ± 0.001 explains 98 %", "spring 0.021 ± 0.001 explains 97 %", False),
        ("fields: a, b, ...", "fields: a, b, c, 3", True),
        ("... explains 98 %", "Spring on pan: 0.02 ± 0.001 explains 98 %", True),
        ("fields: a, b", "fields: a, b, c", False),
        ("usable", "usable with care", False),
    ],
)
def test_numbers_agree_to_the_digits_shown_or_to_half_of_an_interval(shown, printed, same):
    assert is_same_line(shown, printed) is same


def test_a_difference_shows_both_and_nothing_else():
    assert not disagreement(PRINTED, PRINTED)
    lines = disagreement("...\nverdict: usable with care\n...\n", PRINTED).splitlines()
    assert "-verdict: usable with care" in lines
    assert "+verdict: usable" in lines


def test_blocks_are_renewed_as_abridged_as_they_were_and_then_agree():
    shown = "machine ...\n...\nmass  21.5   21.0 .. 22.0   kg\n\nverdict: usable with care\n! drag is wrong.\n"
    now = renewed(shown, PRINTED)
    assert now == "machine ...\n...\nmass       20.4132   19.9 .. 20.9   kg\n...\n\nverdict: usable\n...\n"
    assert agrees(now, PRINTED)
    assert renewed(now, PRINTED) == now
    assert renewed("...\nmass 9.3 ...\n...\n", PRINTED) == "...\nmass       20.4132 ...\n...\n"
    assert renewed("mass 3\n", PRINTED) == PRINTED  # that nothing was left out is kept, too
    assert not renewed(shown, "")
