"""Same seed, same bits: every method's result, wherever its model is built and however it came there."""

import json
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import pytest

import diransac as dr
import rebuilt
from rebuilt import built, digest, digests


@pytest.fixture(scope="module")
def here():
    """Digests of this thread and process."""
    return digests(built())


def in_another_process(start, model=None):
    """Digests of a process that is started in a way, of a model that is sent or built there."""
    with ProcessPoolExecutor(1, multiprocessing.get_context(start)) as pool:
        return pool.submit(digests, model).result()


def test_a_model_built_anew_gives_the_same_bits(here):
    assert digests() == here


def test_a_model_built_in_another_thread_gives_the_same_bits(here):
    with ThreadPoolExecutor(1) as pool:
        assert pool.submit(digests).result() == here


def test_a_model_of_another_thread_gives_the_same_bits_in_this_one(here):
    with ThreadPoolExecutor(1) as pool:
        made = pool.submit(built).result()
    assert digests(made) == here


def test_a_model_built_in_a_spawned_process_gives_the_same_bits(here):
    assert in_another_process("spawn") == here


def test_a_pickled_model_in_a_spawned_process_gives_the_same_bits(here):
    assert in_another_process("spawn", built()) == here


def test_a_model_from_a_file_gives_the_same_bits(here):
    assert digests(dr.Model.from_dict(json.loads(json.dumps(built().to_dict())))) == here


def test_another_log_has_other_digests(here, monkeypatch):
    """The digests can differ."""
    monkeypatch.setattr(rebuilt, "TIME", 1.01 * rebuilt.TIME)
    assert all(digest(name) != one for name, one in here.items())
