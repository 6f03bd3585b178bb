"""Names, units and descriptions of a crafted model: what they do to exported files, which is nothing."""

import ast
import csv
import re
import runpy
import shutil
import sqlite3
import subprocess
import tomllib
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from xml.etree import ElementTree

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from command_line import swim
from diransac.data.input_timing import InputTiming
from diransac.data.suggested_mapping import suggest_mapping
from diransac.errors import ModelError
from diransac.export import PortableModel, write_model
from diransac.model.robots.calibration import calibrated
from diransac.plain_text import cell, comment, identifier, literal
from diransac.plots.figure import draw_heading, empty_figure, name_panel, panel, svg, write
from diransac.study import identify_each, load
from diransac.study.fleet import export_fleet
from diransac.study.fleet_findings import summarise_fleet
from diransac.study.reading import export
from diransac.study.store import Store
from hostile import NAMES, TEXTS, named
from studies import row, tiny

VALUES = {"mass": 2.0, "drag": 0.5}
ROLES = [(*NAMES, *NAMES)[k : k + 4] for k in range(len(NAMES))]
LINES = {name: text for name, text in TEXTS.items() if "\n" not in text}
MODELS = [named(text) for text in LINES.values()] + [named("N*s/m", names) for names in ROLES]
"""Every text of one line as unit and name; every name as that of a coordinate, an input and either parameter."""


def exported(model: dr.Model, name: str = "") -> PortableModel:
    """A model with the parameters 2 and 0.5, of which one has two values, and delays, so that there are remarks."""
    values = dict(zip(model.parameters, VALUES.values(), strict=True))
    timing = InputTiming(delay=0.01, lag=0.02)
    return PortableModel(
        model, values, dict.fromkeys(values, 0.1), np.eye(2), {}, timing, "linear", dict.fromkeys(values, (1.0,)), name
    )


def whole(text: str) -> str:
    """The text with half characters replaced, as files have it."""
    return re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", text)


@pytest.mark.parametrize("text", [text for text in TEXTS.values() if "\n" in text])
def test_a_name_or_unit_of_several_lines_is_refused(text):
    with pytest.raises(ModelError, match=r"of a parameter is .*; give a text of one line"):
        dr.Parameter(text)
    with pytest.raises(ModelError, match=r"of a sensor is .*; give a text of one line"):
        dr.Sensor(text, lambda q, v, a, u, p: q.x)
    model = named()
    for changes in ({"name": text}, {"description": text}, {"coordinates": {"x": text}}, {"inputs": {"push": text}}):
        given = {"name": "m", "coordinates": {"x": "m"}, "inputs": {"push": "N"}, "parameters": model.parameters}
        with pytest.raises(ModelError, match=r"(name|description|unit) of .* is .*; give a text of one line"):
            dr.Model(**given | changes, equations=lambda q, v, a, u, p: [p.mass * a.x + p.drag * v.x - u.push])


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_a_comment_is_one_line_that_ends_nothing(text):
    shown = comment(text)
    assert shown.isprintable()
    assert not re.search(r'\\|\?\?|\*/|/\*|"""', shown)


# C --------------------------------------------------------------------------------------------------------------------
DIALECTS = {
    "c99": ("gcc", "-std=c99", "-trigraphs"),
    "c11": ("gcc", "-std=c11"),
    "c++": ("g++", "-x", "c++", "-std=c++14", "-trigraphs"),
}


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    """Folder of a program that checks the derivative of every model; their names in C begin with the crafted texts."""
    folder = tmp_path_factory.mktemp("c")
    checks, includes = [], ["#include <stdio.h>", "#include <stdlib.h>"]
    for k, model in enumerate(MODELS):
        text = list(TEXTS.values())[k % len(TEXTS)]
        one = exported(model, f"{k} {text}")
        write_model(one, folder / f"{k}.c", "c")
        includes.append(f'#include "{k}.c"')
        call = f"{one.identifier}_derivative(x, u, rate); {one.identifier}_step(x, u, 0.1, next);"
        checks.append(f"    {call} if (rate[0] != 3.0 || rate[1] != 0.25) return {1 + k % 255};")
    start = ["int main(void)", "{", "    const double x[2] = {1.0, 3.0}, u[1] = {2.0};", "    double rate[2], next[2];"]
    (folder / "all.c").write_text("\n".join([*includes, *start, *checks, '    puts("every one"); return 0;', "}", ""]))
    return folder


@pytest.mark.parametrize("dialect", DIALECTS)
def test_c_compiles_without_a_warning_and_runs_nothing_else(sources, dialect):
    compiler, *words = DIALECTS[dialect]
    if shutil.which(compiler) is None:
        pytest.skip(f"EXPORTED C NOT CHECKED AS {dialect}: there is no {compiler}")
    program = sources / f"all-{dialect.rstrip('+')}"
    warnings = ["-Wall", "-Wextra", "-Werror", "-pedantic"]
    subprocess.run([compiler, *words, *warnings, "-o", program, sources / "all.c", "-lm"], check=True)
    assert subprocess.run([program], capture_output=True, check=True).stdout == b"every one\n"


def test_no_two_functions_of_c_have_one_name_and_none_is_a_word_of_a_language():
    for text in (*TEXTS.values(), *NAMES, "class", "None", "Hess", "for_"):
        name = identifier(text)
        assert re.fullmatch("[A-Za-z][A-Za-z0-9]*(_[A-Za-z0-9]+)*", name)
        assert len(name) <= 70
        assert name == identifier(name)
        ca.Function(name, [ca.SX.sym("x")], [1.0])


# Python, CasADi -------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("models", [MODELS[: len(LINES)], MODELS[len(LINES) :]], ids=["texts", "names"])
def test_python_is_imported_with_the_names_of_the_model_and_runs_nothing_else(tmp_path, models):
    for model in models:
        write_model(exported(model), tmp_path / "m.py", "python")
        source = (tmp_path / "m.py").read_bytes()
        kinds = [type(one).__name__ for one in ast.parse(source).body]
        assert kinds == ["Expr", "Import", "Assign", "Assign", "Assign", "FunctionDef", "FunctionDef"]
        module = runpy.run_path(str(tmp_path / "m.py"))
        assert module["STATES"] == list(model.state)
        assert module["INPUTS"] == list(model.inputs)
        assert module["PARAMETERS"] == dict(zip(model.parameters, VALUES.values(), strict=True))
        assert module["derivative"]([1.0, 3.0], [2.0]) == pytest.approx([3.0, 0.25])


def test_casadi_has_the_derivative_or_says_what_to_rename(tmp_path):
    for model in MODELS:
        try:
            write_model(exported(model), tmp_path / "m.casadi", "casadi")
        except ModelError as error:
            assert re.search("named (state|inputs|derivative), .*; rename it$", str(error))  # noqa: PT017
            continue
        function = ca.Function.load(str(tmp_path / "m.casadi"))
        assert function.name() == identifier(model.name)
        first, second = model.parameters
        found = function.call({"state": [1.0, 3.0], "inputs": [2.0], first: 4.0, second: 0.0})["derivative"]
        assert np.array(found).ravel() == pytest.approx([3.0, 0.5])


# YAML -----------------------------------------------------------------------------------------------------------------
def test_yaml_reads_back_with_every_name_and_unit(tmp_path):
    yaml = pytest.importorskip("yaml", reason="EXPORTED YAML NOT READ: PyYAML is missing")
    for model in MODELS:
        write_model(exported(model), tmp_path / "m.yaml", "yaml")
        raw = (tmp_path / "m.yaml").read_bytes()
        for loader in (yaml.SafeLoader, getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
            found = yaml.load(raw, loader)
            assert found["model"] == whole(model.name)
            for group, names in (("states", model.state), ("inputs", model.inputs)):
                assert found[group] == {name: whole(model.units[name]) for name in names}
            assert list(found["parameters"]) == list(found["covariance"]) == list(model.parameters)
            assert [x["value"] for x in found["parameters"].values()] == list(VALUES.values())
            assert [x["unit"] for x in found["parameters"].values()] == [
                whole(x.unit) for x in model.parameters.values()
            ]


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_a_literal_reads_back_in_python_toml_and_yaml(text):
    assert literal(text).isprintable()
    assert ast.literal_eval(literal(text)) == whole(text)
    assert tomllib.loads(f"a = {literal(text)}") == {"a": whole(text)}


# TOML -----------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_a_guessed_mapping_reads_back_with_the_topics_and_fields_of_the_log(text):
    fields = {f"imu {text}": ["thrust", f"state {text}"], f"pose {text}": [f"x {text}"]}
    found = suggest_mapping(fields, {}, dr.models.underwater_vehicle(), f"log {text}")
    table = tomllib.loads(found.toml())
    assert table.keys() <= {"time", "differentiate", "signals"}
    assert {entry["name"]: (entry["topic"], entry["field"]) for entry in table["signals"]} == {
        name: (whole(entry.topic), whole(entry.fields[0])) for name, entry in found.entries.items()
    }
    assert all(line.isprintable() for line in found.toml().split("\n"))


# XML ------------------------------------------------------------------------------------------------------------------
MARKED = "e ]]&gt; -- &quot; &amp;lt; %s ??/ \\ &#x85;&#x9b; é"
FILES = {
    "arm.xml": f"""<mujoco><!-- ]]> - "hinge" --><worldbody><body name="b {MARKED}">
      <joint name='{MARKED}' type="hinge" axis="0 1 0" damping="0.1"/>
      <inertial pos="0 0 -0.2" mass="1.5" diaginertia="0.02 0.02 0.01"/></body></worldbody></mujoco>""",
    "arm.urdf": f"""<robot name="{MARKED}"><link name="w"/><link name="b {MARKED}"><inertial><origin xyz="0 0 -0.2"/>
      <mass value="1.5"/><inertia ixx="0.02" iyy="0.02" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name='{MARKED}' type="continuous"><parent link="w"/><child link="b {MARKED}"/><axis xyz="0 1 0"/>
      <dynamics damping="0.1"/></joint></robot>""",
}


@pytest.mark.parametrize("file", FILES)
def test_a_description_has_the_elements_and_names_that_it_had_with_other_numbers(tmp_path, file):
    pytest.importorskip("mujoco", reason="DESCRIPTIONS NOT CHECKED: mujoco is missing")
    (tmp_path / file).write_text(FILES[file], encoding="utf-8")
    model = dr.models.robot(tmp_path / file, unknown=("damping",))
    (tmp_path / "out.xml").write_text(
        calibrated(tmp_path / file, model.parameters, np.array([0.25]), np.eye(1))[0], encoding="utf-8"
    )
    before, after = (list(ElementTree.parse(tmp_path / name).iter()) for name in (file, "out.xml"))
    assert [x.tag for x in before] == [x.tag for x in after]
    changed = [(x.attrib, y.attrib) for x, y in zip(before, after, strict=True) if x.attrib != y.attrib]
    assert [(x | {"damping": "0.25"}) == y for x, y in changed] == [True]


# Figures --------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("ending", ["svg", "pdf", "png"])
def test_texts_of_a_figure_are_no_formulas_and_leave_a_file_that_reads_back(tmp_path, ending):
    figure = empty_figure(9.0)
    draw_heading(figure, [(text[:100], {}) for text in TEXTS.values() if text], TEXTS["mathematics"])
    axes = panel(figure, 0.0, 6.0, 9.0, 3.0)
    name_panel(axes, TEXTS["mathematics"], TEXTS["c1"])
    axes.plot([1.0, 1e6], [1e-9, 2e-9])
    for _ in range(2):
        write(figure, tmp_path / f"a.{ending}")
    assert (tmp_path / f"a.{ending}").stat().st_size > 1000
    if ending == "svg":
        text = svg(figure)
        assert text.isprintable() or all(line.isprintable() for line in text.split("\n"))
        shown = "".join(ElementTree.fromstring(text).itertext())
        assert shown.count(TEXTS["mathematics"]) == 3
        assert r"m\u009b2J" in shown


# CSV ------------------------------------------------------------------------------------------------------------------
def test_signals_of_any_name_are_read_back_from_csv(tmp_path):
    t = 0.1 * np.arange(5)
    names = [name for name in NAMES if name != "step"]
    dr.Log(t, {name: k + t for k, name in enumerate(names)}, dict.fromkeys(names, TEXTS["spliced end"])).write(
        tmp_path / "a.csv"
    )
    header, *rows = (tmp_path / "a.csv").read_text(encoding="utf-8").splitlines()
    assert (tmp_path / "a.csv-metadata.json").read_text(encoding="utf-8").isascii()
    assert next(csv.reader([header])) == ["t", *names]
    assert len(rows) == len(t)
    assert list(dr.read_log(tmp_path / "a.csv").signals) == names


@pytest.fixture
def fleet(tmp_path):
    """A store of one log, with a further one asked for per crafted text, which is its name, vehicle and time."""
    t = 0.05 * np.arange(80)
    dr.Log.from_arrays(t, swim(t)).write(tmp_path / "a.csv")
    store = tmp_path / "fleet.db"
    identify_each(
        dr.models.underwater_vehicle(), [tmp_path / "a.csv"], "ols", store=store, executor=ThreadPoolExecutor(1)
    )
    with closing(sqlite3.connect(store)) as connection, connection:
        texts = [text for text in TEXTS.values() if text == whole(text)]
        connection.executemany("INSERT INTO asked VALUES (?, ?, ?, ?)", [(x, k + 1, x, x) for k, x in enumerate(texts)])
        connection.execute("UPDATE trials SET error = ?, verdict = ?", [TEXTS["formula"], TEXTS["c1"]])
    return store


def test_a_table_of_a_fleet_has_a_line_per_log_and_no_formula(fleet, tmp_path):
    export_fleet(fleet, tmp_path / "fleet.csv")
    text = (tmp_path / "fleet.csv").read_text(encoding="utf-8")
    header, *rows = csv.reader(text.splitlines(), strict=True)
    assert header[:3] == ["log", "vehicle", "time"]
    assert [line[0] for line in rows[1:]] == [cell(text) for text in TEXTS.values() if text == whole(text)]
    assert {len(line) for line in rows} == {len(header)}
    for value in (value for line in rows for value in line):
        assert value.isprintable()
        assert not value.lstrip().startswith(("=", "+", "@"))
    assert rows[0][header.index("error")] == "'" + TEXTS["formula"]


@pytest.mark.parametrize("letter", ["=", "\x1b"])
def test_a_cell_is_no_longer_than_spreadsheets_and_python_read(letter):
    shown = cell(letter * 1_000_000)
    assert len(shown) <= 32_767
    assert next(csv.reader([shown])) == [shown]


def test_bytes_in_a_store_of_a_fleet_are_damage(fleet, tmp_path):
    with closing(sqlite3.connect(fleet)) as connection, connection:
        connection.execute("UPDATE trials SET verdict = zeroblob(100000)")
    with pytest.raises(dr.StudyError, match=r"is damaged: TypeError: .* is no text; begin a new one"):
        export_fleet(fleet, tmp_path / "fleet.csv")
    assert not (tmp_path / "fleet.csv").exists()


@pytest.mark.parametrize("number", [1.1e150, -1e308])
def test_an_estimate_whose_square_overflows_is_damage(fleet, number):
    with closing(sqlite3.connect(fleet)) as connection, connection:
        connection.execute("UPDATE trials SET parameter_mass = ?", (number,))
    with pytest.raises(dr.StudyError, match="the square of an estimate overflows"):
        summarise_fleet(fleet)


def test_a_table_of_a_study_has_a_line_per_trial_and_no_formula(tmp_path):
    with Store(tmp_path / "a.db", load(tiny(trials=3))) as kept:
        kept.add([row(trial=0), row(trial=1, status="failed", error=TEXTS["formula"]), row(trial=2, host=TEXTS["c1"])])
    export(tmp_path / "a.db", tmp_path / "a.csv", "csv")
    header, *rows = csv.reader((tmp_path / "a.csv").read_text(encoding="utf-8").splitlines(), strict=True)
    assert sorted(line[header.index("error")] for line in rows) == ["", "", "'" + TEXTS["formula"]]
    assert all(value.isprintable() for line in rows for value in line)
