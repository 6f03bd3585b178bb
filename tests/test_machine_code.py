"""How many threads a process takes."""

import multiprocessing
import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor

import pytest

from diransac.errors import SettingsError
from diransac.simulation import default_threads


@pytest.fixture(autouse=True)
def _nobody_says(monkeypatch):
    monkeypatch.delenv("DIRANSAC_THREADS", raising=False)


def test_a_process_of_its_own_takes_the_cores_that_it_may_use():
    assert 1 <= default_threads() <= os.cpu_count()
    code = (
        "import os; os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})\n"
        "from diransac.simulation import default_threads; assert default_threads() == 1"
    )
    if hasattr(os, "sched_setaffinity"):
        assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


def test_a_system_without_affinity_takes_all_cores(monkeypatch):
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert default_threads() == os.cpu_count()


def test_a_worker_of_a_pool_takes_one():
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        assert pool.submit(default_threads).result() == 1


def test_the_environment_has_the_last_word(monkeypatch):
    monkeypatch.setenv("DIRANSAC_THREADS", "7")
    assert default_threads() == 7
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        assert pool.submit(default_threads).result() == 7


@pytest.mark.parametrize("value", ["0", "-1", "many", "1.5", "9" * 5000])
def test_an_environment_that_makes_no_sense_is_refused(monkeypatch, value):
    monkeypatch.setenv("DIRANSAC_THREADS", value)
    with pytest.raises(SettingsError, match=f"DIRANSAC_THREADS is {value!r:.20}"):
        default_threads()
