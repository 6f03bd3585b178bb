"""Results, models and stores from anyone: data that are read, and never code that runs."""

import copy
import json
import random
import sqlite3
import struct
import threading
from pathlib import Path

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from diransac.atomic import draft
from diransac.model import expressions
from diransac.model.library import BUILTIN
from diransac.model.model import _checksum
from diransac.plain_data import json_data, toml_table
from diransac.study import load, status
from diransac.study.store import Store
from studies import TINY

SIZES = {"q": 1, "v": 1, "a": 1, "u": 1, "p": 2}
AXIS = {"coordinates": {"x": "m"}, "inputs": {"f": "N"}}
PARAMETERS = {"m": dr.Parameter("kg", positive=True), "k": dr.Parameter("N/m")}


def axis(force):
    """A mass on an axis with a further force."""
    return dr.Model("axis", **AXIS, parameters=PARAMETERS, equations=lambda q, v, a, u, p: [p.m * a.x + force(q, p)])


def stored(model):
    """The model as it is read from a file."""
    return json.loads(json.dumps(model.to_dict()))


def signed(data):
    """The data with the checksum that anyone can compute."""
    data = {key: value for key, value in data.items() if key != "checksum"}
    return {**data, "checksum": _checksum(data)}


def instructions(function):
    """Instructions of a function with the bits of their constants, and where its results are zero."""
    found = []
    for k in range(function.n_instructions()):
        code = function.instruction_id(k)
        value = function.instruction_constant(k) if code == ca.OP_CONST else 0.0
        found.append((code, function.instruction_input(k), function.instruction_output(k), struct.pack("d", value)))
    return found, [str(function.sparsity_out(i)) for i in range(function.n_out())]


# ---------------------------------------------------------------------- equations as data


@pytest.mark.parametrize("name", BUILTIN)
def test_equations_of_a_file_are_those_that_were_stored_operation_by_operation(name):
    made = BUILTIN[name]()
    again = dr.Model.from_dict(stored(made))
    assert again == made
    for function in ("residual", "kinematics", "measurement", "dynamics", "rate_jacobians"):
        pair = getattr(made, function), getattr(again, function)
        assert pair == (None, None) or instructions(pair[0]) == instructions(pair[1])


def test_every_operation_and_all_bits_of_constants_survive():
    x, y = ca.SX.sym("x"), ca.SX.sym("y")
    values = [expressions.applied(name, *(x, y)[:n]) for name, n in expressions.OPERANDS.items()]
    values += [c * x for c in (0.1, 1 / 3, 5e-324, 1.7976931348623157e308, np.nextafter(1.0, 2.0), 2.0**60 + 1)]
    column = ca.vertcat(*values, ca.SX(1, 1))
    made = ca.Function("f", [ca.vertcat(x), ca.vertcat(y)], [column], ["x", "y"], ["z"])
    data = json.loads(json.dumps(expressions.stored("test", made)))
    again = expressions.restored("f", data, {"x": 1, "y": 1}, {"z": column.numel()})
    assert instructions(again) == instructions(made)


def test_serialised_code_in_a_model_is_refused_unread(monkeypatch):
    symbols = [ca.SX.sym(name, size) for name, size in SIZES.items()]
    code = ca.Function("residual", symbols, [symbols[4][0] * symbols[2]], list(SIZES), ["r"]).serialize()
    monkeypatch.setattr(ca.Function, "deserialize", lambda *_: pytest.fail("it was read"))
    data = stored(axis(lambda q, p: p.k * q.x))
    for key in ("residual", "kinematics", "measurement"):
        changed = {**data, key: code}
        if key == "kinematics":
            changed["velocities"] = {"w": "m/s"}
        if key == "measurement":
            changed["sensors"] = {"y": "m"}
        with pytest.raises(dr.ResultError, match="stored as an earlier version did"):
            dr.Model.from_dict(signed(changed))


@pytest.mark.parametrize(
    "line",
    [
        "16 = sin 15",
        "2 = system 0 1",
        "2 = mul 0 2",
        "2 = mul 0 -1",
        "2 = mul 0",
        "2 = const nan",
        "2 = const 1e999",
        "2 = p 2",
        "2 = call 0 1",
        "2 =  mul 0 1",
        "2 = mul 0 ²",
        "2 = const " + "1" * 100,
        17,
    ],
)
def test_a_line_that_is_no_operation_is_refused(line):
    data = stored(axis(lambda q, p: p.k * q.x))
    data["residual"]["operations"][2] = line
    with pytest.raises(dr.ResultError, match="damaged"):
        dr.Model.from_dict(signed(data))


def test_what_equations_cannot_hold_is_refused_where_the_model_is_made():
    x = ca.SX.sym("x")
    kept_apart = ca.Function("table", [x], [x**2], {"never_inline": True})
    with pytest.raises(dr.ModelError, match="call another function"):
        axis(lambda q, p: p.k * kept_apart(q.x))


def test_deep_equations_are_printed_in_parts_and_endless_ones_refused(monkeypatch):
    def nested(n):
        def force(q, p):
            value = q.x
            for _ in range(n):
                value = ca.sin(value)
            return p.k * value

        return force

    texts = axis(nested(2000)).equations_text()
    assert texts[-1].startswith("0 = ")
    assert sum(text.count("sin(") for text in texts) == 2000
    assert max(map(len, texts)) < 5000
    monkeypatch.setattr(expressions, "MOST_OPERATIONS", 1000)
    with pytest.raises(dr.ModelError, match=r"have 1,\d\d\d operations; up to 1,000 are possible"):
        axis(nested(1001))


def test_a_model_made_in_another_thread_is_the_same():
    made = []
    thread = threading.Thread(target=lambda: made.append(BUILTIN["quadrotor"]()))
    thread.start()
    thread.join()
    here = BUILTIN["quadrotor"]()
    assert made[0].fingerprint == here.fingerprint
    assert instructions(made[0].dynamics) == instructions(here.dynamics)


# ---------------------------------------------------------------------- damaged files


def places(node, way=()):
    """Ways to all values of nested lists and mappings."""
    if way:
        yield way
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    for key, value in items:
        yield from places(value, (*way, key))


def mutated(data, rng):
    """A copy with one value replaced by something else, and a checksum that fits."""
    odd = [None, True, 0, -1, 10**200, 1e308, 5e-324, "", "nan", [], {}, "9" * 100, [1, "a"], 2**63]
    changed = copy.deepcopy(data)
    node, way = changed, rng.choice(list(places(data)))
    for key in way[:-1]:
        node = node[key]
    if rng.random() < 0.3 and isinstance(node[way[-1]], str):
        text = node[way[-1]]
        k = rng.randrange(len(text) + 1)
        node[way[-1]] = text[:k] + rng.choice("0189 =-.epv") + text[k + 1 :]
    else:
        node[way[-1]] = rng.choice(odd)
    if isinstance(changed.get("model"), dict):
        changed["model"] = signed(changed["model"])
    return changed


@pytest.fixture(scope="module")
def result():
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 6.0, 0.05)
    thrust = 40.0 * np.sin(time) + 25.0 * np.sin(3.0 * time)
    v = np.cumsum(thrust) * 0.05 / 120.0
    a = (thrust - 20.0 * v - 35.0 * abs(v) * v - 3.0) / 120.0 + 1e-3 * rng.standard_normal(len(time))
    columns = {"x": np.cumsum(v) * 0.05, "x_dot": v, "x_ddot": a, "thrust": thrust}
    return dr.identify(dr.models.underwater_vehicle(), dr.Log.from_arrays(time, columns), "ols")


def test_a_damaged_result_is_refused_or_harmless(result):
    data, rng, messages = json.loads(json.dumps(result.to_dict())), random.Random(1), []
    for _ in range(200):
        try:
            found = dr.Result.from_dict(mutated(data, rng))
        except dr.DiransacError as error:
            messages.append(str(error))
        else:
            assert str(found)
            found.to_dict()
    assert 70 < len(messages) < 200
    assert not any("\n" in message for message in messages)


@pytest.mark.parametrize("text", ["[" * 100_000, '{"seed": ' + "9" * 5000 + "}", "NaN", '{"a": Infinity}'])
def test_endless_json_is_refused_in_words(text):
    with pytest.raises(ValueError, match=r"deeply|digits|number of JSON"):
        json_data(text)


@pytest.mark.parametrize("text", ["a = " + "[" * 100_000, "a = " + "9" * 5000, "a" + ".a" * 100_000 + " = 1"])
def test_endless_toml_is_refused_in_words(text):
    with pytest.raises(ValueError, match=r"deeply|digits"):
        toml_table(text)


# ---------------------------------------------------------------------- stores


@pytest.mark.parametrize(
    ("statement", "says"),
    [
        ("CREATE VIEW more AS WITH RECURSIVE n(i) AS (SELECT 1 UNION ALL SELECT i FROM n) SELECT i FROM n", "has view"),
        ("CREATE TRIGGER later AFTER INSERT ON trials BEGIN DELETE FROM trials; END", "has trigger"),
        ("CREATE INDEX fast ON trials (abs(trial))", "has index"),
        ("DROP TABLE asked", "has no asked"),
        ("INSERT INTO asked VALUES (x'00', 0, 'ols', 9)", "damaged"),
        ("INSERT INTO asked VALUES ('0', 0, x'ff', 9)", "damaged"),
        ("UPDATE about SET value = '[[[' WHERE key = 'name'", "damaged"),
    ],
)
def test_a_store_that_no_study_wrote_is_refused_and_stays(tmp_path: Path, statement: str, says: str):
    path = tmp_path / "a.db"
    with Store(path, load(TINY).subset(methods=["ols"])):
        pass
    connection = sqlite3.connect(path)
    connection.execute(statement.replace("INSERT INTO", "INSERT OR REPLACE INTO"))
    connection.commit()
    connection.close()
    before = path.read_bytes()
    with pytest.raises(dr.StudyError, match=says):
        status(path)
    assert path.read_bytes() == before


def test_a_journal_that_would_delete_another_file_is_refused(tmp_path: Path):
    path, victim = tmp_path / "a.db", tmp_path / "precious"
    with Store(path, load(TINY)):
        pass
    victim.write_text("mine")
    name = str(victim).encode()
    header = bytes.fromhex("d9d505f920a163d7") + struct.pack(">5I", 0, 0, path.stat().st_size // 4096, 512, 4096)
    tail = struct.pack(">I", 1) + name + struct.pack(">2I", len(name), sum(name)) + bytes.fromhex("d9d505f920a163d7")
    (tmp_path / "a.db-journal").write_bytes(header.ljust(512, b"\0") + tail)
    with pytest.raises(dr.StudyError):
        status(path)
    assert victim.read_text() == "mine"


# ---------------------------------------------------------------------- files that are written


def test_drafts_are_private_and_those_of_killed_processes_are_removed(tmp_path: Path):
    left = tmp_path / ".diransac-abcdefgh.part"
    left.mkdir()
    (left / "a.csv").write_text("half")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / ".diransac-linklink.part").symlink_to(tmp_path / "elsewhere")
    with draft(tmp_path / "a.csv") as first, draft(tmp_path / "a.csv") as second:
        assert not left.exists()
        assert first.parent != second.parent
        assert first.parent.stat().st_mode & 0o077 == 0
        assert first.name == second.name == "a.csv"
    assert {path.name for path in tmp_path.iterdir()} == {"elsewhere", ".diransac-linklink.part"}
