"""Fixtures that every test may use."""

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_DATA = REPOSITORY.parent / "shared" / "data"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real logs; they are not part of the repository, and a test that needs them says so when skipped."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"REAL LOGS NOT CHECKED: {SHARED_DATA} is missing")
    return SHARED_DATA
