"""How many threads linear algebra takes: the process's own number, again, when the last who asked for one is done."""

import pytest
from threadpoolctl import threadpool_info, threadpool_limits

from diransac.blas import single_threaded


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
