"""Ten real records, by the default method without any setting; skipped, loudly, where their folder is missing."""

import pytest

from acceptance.judging import cases_of, failure
from acceptance.records import DATA
from acceptance.table import RECORDS

pytest.importorskip("mujoco", reason="REAL RECORDS NOT CHECKED: mujoco, which judges a leg, is missing")
MISSING = pytest.mark.skipif(not DATA.is_dir(), reason=f"REAL RECORDS NOT CHECKED: {DATA} is missing")


@pytest.mark.parametrize(("row", "aspect"), cases_of(RECORDS, MISSING))
def test_a_record_is_answered_as_its_row_says(row, aspect):
    assert not failure(row, aspect)
