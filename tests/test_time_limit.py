"""Limits of time: what was found so far, or one sentence; and Ctrl-C while compiled code or LLVM runs."""

import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from command_line import MODEL, run, working_folder
from diransac import time_limit
from diransac.data.dataset import Dataset
from diransac.identification.estimate import TIME_LIMIT
from diransac.identification.identify import _mistakes
from diransac.simulation.compiler import compile_map, machine_code
from diransac.simulation.compiler.machine_code import run_blocks
from diransac.time_limit import check_time, time_left, time_limited, time_unlimited
from simulated import ROTORCRAFT, as_log, flight, with_outliers
from studies import TINY, rows

ROTOR = dr.models.planar_rotorcraft()


@pytest.fixture(scope="module")
def log() -> dr.Log:
    signals, inputs = flight(ROTORCRAFT, 800, 0.01)
    return as_log(ROTORCRAFT, with_outliers(signals, 0.1, 80.0, 0), inputs, 0.01)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A clock that goes by a second whenever it is read; its readings."""
    readings: list[int] = []

    def tick() -> float:
        readings.append(len(readings))
        return float(len(readings))

    monkeypatch.setattr(time_limit, "monotonic", tick)
    return readings


@pytest.fixture
def interruptible() -> Iterator[None]:
    """Ctrl-C as a terminal has it; a shell's background jobs ignore it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


# ---------------------------------------------------------------- limits


def test_the_stricter_of_two_limits_holds(clock: list[int]):
    with time_limited(100.0), time_limited(1e6):
        assert time_left() < 100.0
        with time_limited(3.0):
            check_time()
            check_time()
            with pytest.raises(dr.TimeLimitError, match="limit of 3 s"):
                check_time()
            with time_unlimited():
                check_time()
        check_time()
    assert time_left() == np.inf


@pytest.mark.parametrize("seconds", [0.0, -1.0, np.nan])
def test_a_limit_that_is_no_time_is_refused(log: dr.Log, seconds: float):
    with pytest.raises(dr.SettingsError, match="time_limit"):
        dr.identify(ROTOR, log, "ols", time_limit=seconds)


def test_a_search_that_runs_out_of_time_is_one_of_fewer_iterations(log: dr.Log, clock: list[int]):
    every = dr.Settings(max_iterations=300, stop_inlier_fraction=None, refit="none")
    cut = dr.identify(ROTOR, log, "diransac", settings=every, time_limit=100.0)
    assert 0 < cut.iterations < 101
    assert cut.stop_reason == TIME_LIMIT
    assert any("time limit" in text and text.level == "care" for text in cut.findings)
    fewer = dr.Settings(max_iterations=cut.iterations, stop_inlier_fraction=None, refit="none")
    whole = dr.identify(ROTOR, log, "diransac", settings=fewer)
    assert cut.parameters == whole.parameters


def test_lo_diransac_returns_the_likeliest_explanation_so_far_or_one_sentence(log: dr.Log, clock: list[int]):
    whole = dr.identify(ROTOR, log, time_limit=1e6)
    n_checks = len(clock)
    ends = []
    for share in (0.1, 0.5, 0.95):
        try:
            found = dr.identify(ROTOR, log, time_limit=share * n_checks)
        except dr.TimeLimitError:
            ends.append("nothing")
            continue
        ends.append(found.stop_reason)
        assert found.verdict != "usable"
        for name, value in whole.parameters.items():
            assert abs(found.parameters[name] - value) < 4.0 * whole.standard_errors[name] + 0.01 * abs(value)
    assert ends[0] == "nothing"
    assert ends[-1] == TIME_LIMIT
    assert whole.stop_reason == "converged"


def test_logs_are_not_compared_with_what_was_cut_short(log: dr.Log, clock: list[int]):
    logs = [log.between(0.0, 3.5), log.between(4.0, 8.0)]
    settings = dr.Settings(max_iterations=20, stop_inlier_fraction=None, refit="none")
    found = dr.identify(ROTOR, logs, "i-diransac", settings=settings, time_limit=30.0)
    assert found.stop_reason != TIME_LIMIT
    assert sum("before the logs were compared" in note for note in found.notes) == 1


def test_cross_validation_says_which_logs_were_not_left_out(log: dr.Log, clock: list[int]):
    logs = [log.between(k, k + 2.5) for k in (0.0, 2.6, 5.2)]
    settings = dr.Settings(max_iterations=20, stop_inlier_fraction=None, refit="none")
    found = dr.cross_validate(ROTOR, logs, "i-diransac", settings=settings, time_limit=45.0)
    assert [isinstance(x, dr.Result) for x in found.results] == [True, True, False]
    assert "the time limit of 45 s was reached" in str(found)


def test_a_study_keeps_its_rows_and_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    class Clock:
        moment = 0.0

    monkeypatch.setattr(time_limit, "monotonic", lambda: Clock.moment)

    def progress(done: int, asked: int) -> None:
        Clock.moment = 10.0 * (0 < done < asked)

    with ThreadPoolExecutor(1) as here:
        options = {"executor": here, "tasks": 1, "batch_size": 1}
        cut = dr.run_study(TINY, store=tmp_path / "a.db", time_limit=5.0, progress=progress, **options)
        Clock.moment = 0.0
        assert 0 < cut.done < cut.asked
        assert dr.run_study(TINY, store=tmp_path / "a.db", **options).missing == 0
        dr.run_study(TINY, store=tmp_path / "b.db", **options)
    assert rows(tmp_path / "a.db") == rows(tmp_path / "b.db")


@pytest.mark.parametrize("command", [["identify", "swim.csv"], ["compare", "swim.csv", "--methods", "lo-diransac"]])
def test_a_command_without_an_answer_in_time_says_so(
    command: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    working_folder(tmp_path, monkeypatch)
    done = run(*command, *MODEL, "--time-limit", "1e-9")
    assert (done.exit_code, done.stdout) == (1, "")
    assert "the time limit of 1e-09 s was reached before an answer was found" in done.stderr


# ---------------------------------------------------------------- Ctrl-C


@pytest.mark.usefixtures("interruptible")
def test_ctrl_c_does_not_wait_for_llvm(monkeypatch: pytest.MonkeyPatch):
    finished = threading.Event()

    def endless(*_: object) -> bytes:
        signal.raise_signal(signal.SIGINT)
        finished.wait()
        return b""

    monkeypatch.setenv("DIRANSAC_CACHE", "off")
    monkeypatch.setattr(machine_code, "_compiled", endless)
    try:
        with pytest.raises(KeyboardInterrupt):
            compile_map(ROTOR.dynamics)(np.zeros((9, 6)), np.ones((9, 2)), np.ones((9, 3)))
    finally:
        finished.set()


@pytest.mark.usefixtures("interruptible")
@pytest.mark.parametrize("threads", [1, 2])
def test_ctrl_c_ends_a_loop_between_two_blocks(threads: int):
    """No block begins later: its arrays may be gone."""
    begun: list[int] = []

    def loop(first: int, end: int) -> None:
        begun.append(first)
        if len(begun) == 3:
            signal.raise_signal(signal.SIGINT)
        time.sleep(0.01)

    with pytest.raises(KeyboardInterrupt):
        run_blocks(loop, [], 10**9, threads)
    n = len(begun)
    assert n < 100 * threads  # a second
    with ThreadPoolExecutor(1) as other:
        other.submit(lambda: None).result()
    assert len(begun) == n


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("n_blocks", [0, 1, 7, 100])
@pytest.mark.parametrize("moment", [0.0, np.inf])
def test_every_block_runs_once(threads: int, n_blocks: int, moment: float, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(machine_code, "_MOMENT", moment)
    done, seen, both = np.zeros(n_blocks, int), set[int](), threading.Barrier(2, timeout=60.0)
    is_shared = threads > 1 and moment == 0.0 and n_blocks > 1

    def loop(first: int, end: int) -> None:
        done[first:end] += 1
        if threading.get_ident() not in seen:
            seen.add(threading.get_ident())
            if is_shared:
                both.wait()

    run_blocks(loop, [], n_blocks, threads)
    np.testing.assert_array_equal(done, 1)
    assert len(seen) == (2 if is_shared else min(n_blocks, 1))


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("kind", [ZeroDivisionError, IndexError])
def test_an_error_in_a_loop_is_raised(threads: int, kind: type[Exception], monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(machine_code, "_MOMENT", 0.0)

    def broken(first: int, end: int) -> None:
        if first > 0:
            raise kind("planted")

    call: Callable[..., None] = broken
    with pytest.raises(kind, match="planted"):
        run_blocks(call, [], 20, threads)


def test_an_error_in_another_thread_is_raised(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(machine_code, "_MOMENT", 0.0)
    both, seen = threading.Barrier(2, timeout=60.0), set[int]()

    def broken(first: int, end: int) -> None:
        if threading.get_ident() not in seen:
            seen.add(threading.get_ident())
            both.wait()
        if threading.current_thread() is not threading.main_thread():
            raise ZeroDivisionError("planted")

    with pytest.raises(ZeroDivisionError, match="planted"):
        run_blocks(broken, [], 20, 2)


def test_no_thread_goes_on_where_another_cannot_begin(monkeypatch: pytest.MonkeyPatch):
    """Arrays of a loop are gone once it is left."""
    begun, refused, ran = threading.Event(), threading.Event(), list[int]()

    class Exhausted(ThreadPoolExecutor):
        def submit(self, *given: Any) -> Any:
            if begun.is_set():
                refused.set()
                raise RuntimeError("can't start new thread")
            found = super().submit(*given)
            assert begun.wait(60.0)
            return found

    def loop(first: int, end: int) -> None:
        ran.append(first)
        begun.set()
        assert refused.wait(60.0)

    pool = Exhausted(1)
    monkeypatch.setattr(machine_code, "_MOMENT", 0.0)
    monkeypatch.setattr(machine_code, "_pool", lambda *_: pool)
    with pytest.raises(RuntimeError, match="new thread"):
        run_blocks(loop, [], 10**9, 3)
    n = len(ran)
    pool.shutdown()
    assert len(ran) == n


def test_a_search_for_mistakes_that_time_ended_is_made_again():
    """Methods on one dataset share its result; an empty one would be no result."""
    model = dr.Model(
        "slide", {"s": "m"}, {"force": "N"},
        {"mass": dr.Parameter("kg", positive=True), "k": dr.Parameter("1/s", positive=True)},
        lambda q, v, a, u, p: [p.mass * a.s + ca.tanh(p.k * v.s) - u.force],
    )  # fmt: skip
    t = 0.01 * np.arange(300)
    columns = {"s": np.sin(t), "s_dot": np.cos(t), "s_ddot": -np.sin(t), "force": np.tanh(np.cos(t)) - 2.0 * np.sin(t)}
    dataset = Dataset.of(model, [dr.Log.from_arrays(t, columns)], pointwise=True)
    with time_limited(1e-9):
        assert _mistakes(dataset) == ([], 0)
    assert _mistakes(dataset)[1] > 0
