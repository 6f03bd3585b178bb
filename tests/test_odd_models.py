"""Models, names and stores that are a user's own error: one sentence, and nothing on the terminal."""

import sqlite3
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.study import run_study
from diransac.study.summary import summarise
from rebuilt import log
from studies import TINY


class Own(BaseException):
    """An exception that is none of Python's."""


class Silent(Exception):
    """An exception without a message."""

    def __str__(self):
        raise TypeError


def sledge(mass=None, before=None, gain=1.0, name="sledge"):
    def equations(q, v, a, u, p):
        if before is not None:
            raise before
        return [p.m * a.s + p.d * v.s - gain * u.f]

    parameters = {"m": mass or dr.Parameter("kg", positive=True), "d": dr.Parameter("1")}
    return dr.Model(name, {"s": "m"}, {"f": "N"}, parameters, equations)


def slid():
    t = 0.02 * np.arange(240)
    f = 3.0 * np.sin(1.1 * t) + 2.0 * np.sin(3.7 * t)
    v = np.convolve(f, 0.02 / 1.5 * np.exp(-2.0 / 1.5 * t))[:240]
    return dr.Log.from_arrays(t, {"s": np.cumsum(v) * 0.02, "s_dot": v, "s_ddot": (f - 2.0 * v) / 1.5, "f": f})


@pytest.mark.parametrize(
    "error", [Own("a\nb"), Silent(), SystemExit(3), GeneratorExit(), MemoryError(), OSError(5, "x"), StopIteration()]
)
def test_an_exception_of_any_class_in_equations_is_an_error_of_the_model(error):
    with pytest.raises(dr.ModelError, match=f'model "sledge": equations failed: {type(error).__name__}:') as caught:
        sledge(before=error)
    assert "\n" not in str(caught.value)


def test_an_interrupt_in_equations_is_one():
    with pytest.raises(KeyboardInterrupt):
        sledge(before=KeyboardInterrupt())


def test_an_exception_of_any_class_in_a_file_is_an_error_of_the_file(tmp_path):
    (tmp_path / "m.py").write_text("class Own(BaseException): pass\nraise Own('x')\n")
    log().write(tmp_path / "log.csv")
    done = run("identify", tmp_path / "log.csv", "--model", tmp_path / "m.py")
    assert (done.exit_code, "line 2: Own: x" in done.stderr) == (1, True)


@pytest.mark.parametrize("name", [5, None, b"x", ("a",)])
def test_names_units_and_sources_are_texts(name):
    with pytest.raises(dr.ModelError, match=r"the name of a model is .*; give a text"):
        sledge(name=name)
    with pytest.raises(dr.ModelError, match=r"the unit of a parameter is .*; give a text"):
        dr.Parameter(name)
    with pytest.raises(dr.LogError, match=r"the source of a log is .*; give a text"):
        dr.Log.from_arrays([0.0, 1.0], {"x": [0.0, 1.0]}, source=name)
    with pytest.raises(dr.ModelError, match="parameters are m, d; found"):
        dr.Plant(sledge(), {name: 1.0})


ODD = {
    "bounds far away": lambda: dr.identify(sledge(dr.Parameter("kg", 1e300, 1.1e300)), slid()),
    "a constant of 1e300": lambda: dr.identify(sledge(gain=1e300), slid()),
    "a fixed 1e300": lambda: dr.identify(sledge(), slid(), fixed={"m": 1e300}),
    "all fixed": lambda: dr.identify(sledge(), slid(), fixed={"m": 1.5, "d": 2.0}),
}


@pytest.mark.parametrize("case", ODD)
def test_odd_values_are_refused_in_a_sentence_without_text_of_lapack(case, capfd):
    with pytest.raises(dr.DiransacError):
        ODD[case]()
    assert capfd.readouterr() == ("", "")


def test_a_description_with_numbers_that_overflow_is_refused(tmp_path):
    pytest.importorskip("mujoco", reason="NOT CHECKED: mujoco is missing")
    inertial = '<inertial pos="0 0 1e300" mass="1e300" diaginertia="1 1 1"/>'
    body = f'<body><joint type="hinge" damping="1"/>{inertial}</body>'
    (tmp_path / "a.xml").write_text(f"<mujoco><worldbody>{body}</worldbody></mujoco>")
    with pytest.raises(dr.ModelError, match=r"1e\+50 or more|cannot be read"):
        dr.models.robot(tmp_path / "a.xml")


COPIES = {
    "bodies": ('<worldbody><replicate count="99999999"><body/></replicate></worldbody>', "more than 100,000 elements"),
    "cells": ('<asset><hfield name="h" nrow="60000" ncol="60000" size="1 1 1 1"/></asset>', "16,777,216 cells"),
    "a device": ('<include file="/dev/zero"/>', "not an ordinary file"),
}


@pytest.mark.parametrize("case", COPIES)
def test_a_description_of_any_size_is_refused_before_it_is_read(tmp_path, case):
    pytest.importorskip("mujoco", reason="NOT CHECKED: mujoco is missing")
    text, says = COPIES[case]
    (tmp_path / "a.xml").write_text(f"<mujoco>{text}</mujoco>")
    with pytest.raises(dr.ModelError, match=says):
        dr.models.robot(tmp_path / "a.xml")


@pytest.fixture(scope="module")
def kept(tmp_path_factory):
    path = tmp_path_factory.mktemp("store") / "a.db"
    run_study(
        TINY | {"name": "price $x_{$", "evaluation": {"trajectories": ["square"]}},
        store=path,
        executor=ThreadPoolExecutor(1),
    )
    return path


def test_a_name_with_dollar_signs_is_drawn_as_it_is(kept, tmp_path):
    done = run("study", "plot", kept, "--title", "a $\\frac$", "-o", tmp_path / "a.svg")
    assert done.exit_code == 0, done.stderr
    assert run("study", "plot", kept, "-o", tmp_path / "b.svg").exit_code == 0


@pytest.mark.parametrize("value", [-1.0, 1e308])
def test_a_row_with_an_impossible_error_is_damage(kept, tmp_path, value):
    (tmp_path / "a.db").write_bytes(kept.read_bytes())
    with closing(sqlite3.connect(tmp_path / "a.db")) as connection:
        connection.execute("UPDATE trials SET square_x = ?", (value,))
        connection.commit()
    with pytest.raises(dr.StudyError, match="is damaged: ValueError: square_x is"):
        summarise(tmp_path / "a.db")
