"""Fixtures that every test may use, one thread per worker of pytest-xdist, and machine code kept from run to run."""

import gc
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

# How quickly a busy machine draws examples is no promise of the package; examples and their number stay as they are.
settings.register_profile("untimed", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("untimed")

if "PYTEST_XDIST_WORKER" in os.environ:  # there is a worker per core; BLAS reads its variable when NumPy is imported
    os.environ.setdefault("DIRANSAC_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

REPOSITORY = Path(__file__).resolve().parents[1]
SHARED_DATA = REPOSITORY.parent / "shared" / "data"

# A key of the cache holds the compiler's sources: code of an earlier run is that which this one would compile.
os.environ["DIRANSAC_CACHE"] = str(REPOSITORY / ".pytest_cache" / "machine-code")
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # without byte code, each process compiles the whole package again


def pytest_collection_finish() -> None:
    """Take the modules and tests, which live to the end, out of every later search for garbage."""
    gc.freeze()


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real logs; they are not part of the repository, and a test that needs them says so when skipped."""
    if not SHARED_DATA.is_dir():
        pytest.skip(f"REAL LOGS NOT CHECKED: {SHARED_DATA} is missing")
    return SHARED_DATA


@pytest.fixture
def trials_in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Run trials of studies, and logs of fleets, in a thread of this process in place of processes."""
    monkeypatch.setattr("diransac.study.engine.Processes", lambda _jobs: ThreadPoolExecutor(1))
