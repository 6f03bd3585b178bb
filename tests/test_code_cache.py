"""Machine code on disk: read by later processes, and harmless whatever happens to its folder."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from random import Random

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from command_line import CliRunner, app
from diransac.atomic import draft
from diransac.simulation import Measurements, RolloutBatch
from diransac.simulation.compiler import Map, Scan, machine_code
from diransac.simulation.compiler.code_cache import CodeCache, hashed
from diransac.simulation.compiler.machine_code import LANES, Target
from diransac.simulation.rollouts import Rollouts

KEY, OTHER_KEY = hashed(["one"]), hashed(["other"])
CODE = bytes(range(256)) * 40
FIT = """
import hashlib, numpy as np, diransac as dr
from diransac.simulation import Measurements, RolloutBatch, rollouts
from diransac.simulation.compiler import machine_code
emit, emitted = machine_code._optimise, []
machine_code._optimise = lambda *given: (emitted.append(1), emit(*given))
model = dr.models.planar_rotorcraft()
batch = RolloutBatch(np.array([[0.25, 0.004, 0.1]]), np.zeros(6), np.full((50, 2), [2.5, 0.01]), 0.01)
sums = rollouts(model).gauss_newton(batch, Measurements(np.zeros((50, 9)), np.ones(50, bool)), np.ones(9))
bits = b"".join(a.tobytes() for a in (sums.cost, sums.gradient, sums.normal_matrix, sums.final_slopes))
print(len(emitted), hashlib.sha256(bits).hexdigest())
"""
"""Prints the number of modules that were compiled, and the digest of what they compute."""

N_CHANGED = int(os.environ.get("FUZZ_EXAMPLES", "30"))
"""Bytes of entries that are changed, one at a time."""


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CodeCache:
    monkeypatch.setenv("DIRANSAC_CACHE", str(tmp_path / "code"))
    found = CodeCache.of_user()
    assert found is not None
    return found


@pytest.fixture
def compiled(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Keys of what is compiled from now on."""
    keys: list[str] = []
    plain = machine_code._object_code

    def recorded(emit, key, machine):
        return plain(lambda: (keys.append(key), emit())[1], key, machine)

    monkeypatch.setattr(machine_code, "_object_code", recorded)
    return keys


def square(factor: float = 1.0, target: Target | None = None) -> Map:
    """A new map, which no memory of this process holds."""
    x = ca.SX.sym("x", 2)
    return Map(ca.Function("square", [x], [factor * x * x]).serialize(), target)


def sledge(stiffness: float = 1.0) -> dr.Model:
    """A small model, of which many variants compile in little time."""
    return dr.Model(
        "sledge",
        {"x": "m"},
        {"force": "N"},
        {"mass": dr.Parameter("kg"), "drag": dr.Parameter("N s/m")},
        lambda q, v, a, u, p: [p.mass * a.x + p.drag * v.x + stiffness * q.x - u.force],
    )


def fresh_rollouts(stiffness: float = 1.0, **changes) -> Rollouts:
    model = sledge(stiffness)
    given = {"signals": model.signals, "integrator": "rk4", "substeps": 1, "hold": "zero-order", "target": None}
    return Rollouts(model, *(given | changes).values())


def in_processes(number: int, **environment: str) -> list[list[str]]:
    """What `FIT` prints in processes that run at the same time."""
    command, known = [sys.executable, "-c", FIT], os.environ | environment
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=known) for _ in range(number)]
    printed = [process.communicate()[0].split() for process in running]
    assert [process.returncode for process in running] == [0] * number
    return printed


# Across processes ----------------------------------------------------------------------------------------------------
def test_a_second_process_compiles_nothing_and_computes_the_same_bits(cache: CodeCache):
    (first,) = in_processes(1, PYTHONHASHSEED="1")
    (second,) = in_processes(1, PYTHONHASHSEED="2")
    (without,) = in_processes(1, DIRANSAC_CACHE="off")
    assert (first[0], second[0], without[0]) == ("1", "0", "1")
    assert first[1] == second[1] == without[1]


def test_processes_at_once_leave_one_sound_entry(cache: CodeCache):
    printed = in_processes(3)
    assert len({digest for _, digest in printed}) == 1
    assert [path.suffix for path in cache.folder.iterdir()] == [".code"]
    assert in_processes(1)[0] == ["0", printed[0][1]]


# Keys ----------------------------------------------------------------------------------------------------------------
def test_every_variant_of_a_loop_has_a_key_of_its_own(compiled: list[str], cache: CodeCache):
    rows = np.full((8, 1), 2.5)
    one = RolloutBatch(np.array([[2.0, 1.0]]), np.zeros(2), rows, 0.01)
    two = RolloutBatch(np.repeat(one.parameters, 2, axis=0), np.zeros(2), rows, 0.01, np.array([0, 3]), 4)
    many = RolloutBatch(np.repeat(one.parameters, LANES + 1, axis=0), np.zeros(2), rows, 0.01)
    narrow = Target("x86-64-v3", "+avx2,+fma,-avx512f") if "avx2" in Target.host().features else Target.host()

    def run(which: Rollouts) -> None:
        seen = Measurements(np.zeros((8, len(which.signals))), np.ones(8, bool))
        weights = np.ones(len(which.signals))
        for batch in (one, two):
            which.score(batch, seen, weights, 1)
        for batch in (one, two, many):  # few lanes share the machine code of lanes that start at different rows
            which.trajectories(batch)
        which.gauss_newton(one, seen, weights, unknowns=["mass"])
        which.gauss_newton(one, seen, weights, unknowns=["mass", "x"])

    signals = sledge().signals
    variants = [{}, {"integrator": "euler"}, {"substeps": 2}, {"hold": "linear"}, {"stiffness": 2.0}]
    variants += [{"signals": signals[:2]}, {"signals": signals[::-1]}, {"target": narrow}]
    for changes in variants:
        run(fresh_rollouts(**changes))
    n_different = 6 * len(variants) - 2 * 2  # trajectories have all signals, whichever are compared
    assert len(set(compiled)) == n_different
    run(fresh_rollouts())
    assert len(set(compiled)) == n_different


def test_functions_shared_arguments_and_processors_have_keys_of_their_own(compiled: list[str], cache: CodeCache):
    rows = np.arange(6.0).reshape(3, 2)
    assert np.array_equal(square()(rows)[0], rows**2)
    assert np.array_equal(square(2.0)(rows)[0], 2.0 * rows**2)
    assert np.array_equal(square()(rows[0])[0], rows[:1] ** 2)
    square(target=replace(Target.host(), features=""))(rows)
    carry, row, constant = (ca.SX.sym(name) for name in "crk")
    step = ca.Function("step", [carry, row, constant], [carry + row, carry * constant])
    Scan(step.serialize(), None)([[1.0]], rows[:, :1], [[2.0]])
    assert len(set(compiled)) == 5
    assert np.array_equal(square(2.0)(rows)[0], 2.0 * rows**2)
    assert len(compiled) == 5


def test_other_versions_of_the_libraries_or_of_this_package_find_nothing(
    compiled: list[str], cache: CodeCache, monkeypatch: pytest.MonkeyPatch
):
    square()([1.0, 2.0])
    versions = machine_code._versions()
    assert all(versions)
    for k in range(len(versions)):
        monkeypatch.setattr(machine_code, "_versions", lambda k=k: (*versions[:k], "other", *versions[k + 1 :]))
        square()([1.0, 2.0])
    assert len(set(compiled)) == len(compiled) == 1 + len(versions)


# Damage --------------------------------------------------------------------------------------------------------------
def damaged(content: bytes, how: str) -> bytes:
    """Content of an entry after damage."""
    middle = len(content) // 2
    return {
        "empty": b"",
        "cut": content[:middle],
        "head alone": content[:60],
        "one bit": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
        "longer": content + b"\0",
        "zeros": bytes(len(content)),
        "key": content.replace(KEY.encode(), OTHER_KEY.encode()),
    }[how]


@pytest.mark.parametrize("how", ["empty", "cut", "head alone", "one bit", "longer", "zeros", "key"])
def test_a_damaged_entry_is_no_entry(cache: CodeCache, how: str):
    cache.write(KEY, CODE)
    assert cache.read(KEY) == CODE
    (path,) = cache.sizes()
    path.write_bytes(damaged(path.read_bytes(), how))
    assert cache.read(KEY) is None
    cache.write(KEY, CODE)
    assert cache.read(KEY) == CODE


def test_an_entry_under_the_name_of_another_key_is_not_run(cache: CodeCache):
    cache.write(KEY, CODE)
    (path,) = cache.sizes()
    path.rename(path.with_name(f"{OTHER_KEY}.code"))
    assert cache.read(OTHER_KEY) is None


def test_code_is_compiled_again_where_its_entry_is_damaged(cache: CodeCache, compiled: list[str]):
    square()([3.0, 4.0])
    (path,) = cache.sizes()
    path.write_bytes(path.read_bytes()[:-1])
    assert np.array_equal(square()([3.0, 4.0])[0], [[9.0, 16.0]])
    assert np.array_equal(square()([3.0, 4.0])[0], [[9.0, 16.0]])
    assert len(compiled) == 2


def scanned() -> np.ndarray:
    carry, row, constant = (ca.SX.sym(name) for name in "crk")
    step = ca.Function("step", [carry, row, constant], [carry + row, carry * constant])
    return Scan(step.serialize(), None)([[1.0]], np.arange(6.0).reshape(6, 1), [[2.0]])[0]


def rolled_out() -> np.ndarray:
    batch = RolloutBatch(np.array([[2.0, 1.0]]), np.zeros(2), np.full((8, 1), 2.5), 0.01)
    return fresh_rollouts().trajectories(batch)


@pytest.mark.slow
def test_no_changed_byte_of_an_entry_changes_a_number(cache: CodeCache, compiled: list[str]):
    rng, runs = Random(0), [lambda: square(3.0)([3.0, 4.0])[0], scanned, rolled_out]
    entries = []
    for run in runs:
        numbers, (path,) = run(), cache.sizes().keys() - {path for _, _, path, _ in entries}
        entries.append((run, numbers, path, path.read_bytes()))
    compiled.clear()
    for k in range(N_CHANGED):
        run, numbers, path, content = entries[k % len(entries)]
        at = rng.randrange(len(content))
        path.write_bytes(content[:at] + bytes([content[at] ^ rng.randrange(1, 256)]) + content[at + 1 :])
        assert np.array_equal(run(), numbers)
        assert len(compiled) == k + 1
        assert path.read_bytes() == content


# Folders -------------------------------------------------------------------------------------------------------------
def test_a_folder_is_private_and_so_are_its_files(cache: CodeCache):
    cache.write(KEY, CODE)
    (path,) = cache.sizes()
    assert cache.folder.stat().st_mode & 0o777 == 0o700
    assert path.stat().st_mode & 0o777 == 0o600


@pytest.mark.parametrize("mode", [0o720, 0o702, 0o777, 0o1777])
def test_a_folder_that_others_can_write_to_is_not_used(cache: CodeCache, mode: int):
    cache.write(KEY, CODE)
    cache.folder.chmod(mode)
    cache.write(OTHER_KEY, CODE)
    assert cache.read(KEY) is None
    assert len(cache.sizes()) == 1
    assert cache.objection() == "other users can write to it"


def test_a_folder_of_another_user_is_not_used(cache: CodeCache, monkeypatch: pytest.MonkeyPatch):
    cache.write(KEY, CODE)
    monkeypatch.setattr(os, "geteuid", lambda: cache.folder.stat().st_uid + 1)
    assert cache.read(KEY) is None
    assert cache.objection() == "it belongs to another user"


def test_a_file_in_place_of_the_folder_changes_nothing(cache: CodeCache):
    cache.folder.write_text("mine")
    assert np.array_equal(square()([3.0, 4.0])[0], [[9.0, 16.0]])
    assert cache.folder.read_text() == "mine"
    assert cache.objection() == "it is not a folder"


def test_a_folder_that_is_read_only_serves_what_it_holds(
    cache: CodeCache, compiled: list[str], monkeypatch: pytest.MonkeyPatch
):
    square()([3.0, 4.0])

    def refuse(*given, **named):
        raise PermissionError(13, "read-only")

    for name in ("mkstemp", "mkdtemp"):
        monkeypatch.setattr(f"tempfile.{name}", refuse)
    monkeypatch.setattr(os, "utime", refuse)
    assert np.array_equal(square()([3.0, 4.0])[0], [[9.0, 16.0]])
    assert np.array_equal(square(2.0)([3.0, 4.0])[0], [[18.0, 32.0]])
    assert len(compiled) == 2
    assert len(list(cache.folder.iterdir())) == 1


def test_entries_used_the_longest_ago_leave_first(cache: CodeCache):
    small = replace(cache, size_limit=5 * len(CODE))
    keys = [f"{'0' if k > 3 else 'f'}{hashed([str(k)])[1:]}" for k in range(6)]  # of which the last two tidy up
    for age, key in enumerate(keys[:4]):
        small.write(key, CODE)
        os.utime(small.folder / f"{key}.code", (1e9 + age, 1e9 + age))
    assert small.read(keys[0]) == CODE  # used now
    for key in keys[4:]:
        small.write(key, CODE)
    assert [key for key in keys if small.read(key)] == [keys[0], *keys[3:]]
    assert sum(small.sizes().values()) <= small.size_limit


def test_files_of_killed_processes_are_removed_and_those_of_others_are_left(cache: CodeCache):
    cache.write(KEY, CODE)
    left, mine = cache.folder / ".diransac-01234567.part", cache.folder / "notes.txt"
    left.mkdir()
    for path in (left / f"{KEY}.code", mine):
        path.write_text("")
    with draft(cache.folder / f"{KEY}.code") as recent:
        cache.write(OTHER_KEY, CODE)
        assert not left.exists()
        assert recent.parent.exists()
    cache.clear()
    assert mine.exists()
    assert not cache.sizes()


# Where it is ---------------------------------------------------------------------------------------------------------
def test_off_reads_and_writes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compiled: list[str]):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("DIRANSAC_CACHE", "off")
    square()([1.0, 2.0])
    square()([1.0, 2.0])
    assert len(compiled) == 2
    assert not list(tmp_path.iterdir())


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have other cache directories")
def test_without_a_variable_it_is_in_the_users_cache_directory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.delenv("DIRANSAC_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "own"))
    assert CodeCache.of_user() == CodeCache(tmp_path / "own" / "diransac" / "code")
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert CodeCache.of_user() == CodeCache(tmp_path / ".cache" / "diransac" / "code")


# On the command line -------------------------------------------------------------------------------------------------
def cache_command(*words: str) -> str:
    done = CliRunner().invoke(app, ["cache", *words])
    assert done.exit_code == 0, done.output
    return done.stdout


def test_the_command_shows_the_folder_and_clears_it(cache: CodeCache):
    cache.write(KEY, CODE)
    state = json.loads(cache_command("--json"))
    assert state["folder"] == str(cache.folder)
    assert (state["entries"], state["bytes"]) == (1, sum(cache.sizes().values()))
    assert f"{cache.folder}\n1 entries" in cache_command()
    assert json.loads(cache_command("--clear", "--json"))["entries"] == 0
    assert cache.read(KEY) is None


def test_the_command_says_why_a_folder_is_not_used(cache: CodeCache, monkeypatch: pytest.MonkeyPatch):
    cache.write(KEY, CODE)
    cache.folder.chmod(0o777)
    assert "not used: other users can write to it" in cache_command()
    monkeypatch.setenv("DIRANSAC_CACHE", "off")
    assert cache_command("--clear") == "no machine code is kept: DIRANSAC_CACHE is off\n"
