"""Settings of the process: as before, when the last who asked for another is done."""

import os
import platform
import subprocess
import sys

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from diransac.process import single_threaded


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


@pytest.fixture
def two_threads():
    with threadpool_limits(limits=2, user_api="blas"):
        assert blas_threads() == {2}
        yield


def test_one_thread_lasts_until_the_last_has_done_with_it_whoever_began(two_threads):
    first, second = single_threaded(), single_threaded()
    first.__enter__()
    second.__enter__()
    first.__exit__(None, None, None)
    assert blas_threads() == {1}
    second.__exit__(None, None, None)
    assert blas_threads() == {2}


def test_an_error_gives_the_threads_back(two_threads):
    with pytest.raises(ZeroDivisionError), single_threaded():
        raise ZeroDivisionError
    assert blas_threads() == {2}


FAULTS = """
import numpy as np, resource
from contextlib import nullcontext
from diransac.process import memory_kept

def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        np.ones(6_000_000)
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before

def resident():
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize()

before = faults()
with memory_kept():
    with memory_kept():
        np.ones(6_000_000)
    within, held = faults(), resident()
print(before, within, held, resident(), faults())
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another allocator of memory, whose options it leaves")
def test_large_arrays_leave_their_memory_to_the_next_and_to_the_system_at_the_end():
    plain = {name: x for name, x in os.environ.items() if name != "GLIBC_TUNABLES" and not name.startswith("MALLOC_")}
    process = subprocess.run([sys.executable, "-c", FAULTS], env=plain, check=True, capture_output=True, text=True)
    before, within, held, at_the_end, after = (int(number) for number in process.stdout.split())
    assert within < 0.1 * before
    assert at_the_end < held - 30e6
    assert after > 10 * within
