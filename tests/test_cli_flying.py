"""The command line that flies: ``diransac simulate`` and ``diransac fly``."""

import json
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import contents, run, run_both
from diransac.cli.flight_options import NoiseOptions

IMBALANCE = ["--plant", "extended-rotorcraft", "--aerodynamic-imbalance", 1.4e-6, "--mass-imbalance", 0]
OUTLIERS = ["--outliers", 0.1, "--magnitude", 80]
# A machine in the same plane that is none of the paper's.
SLIDER = """
from diransac import Model, Parameter
model = Model(
    name="slider", coordinates={"x": "m", "z": "m"}, inputs={"push": "N", "lift": "N"},
    parameters={"mass": Parameter("kg", positive=True), "gravity": Parameter("m/s^2")},
    equations=lambda q, v, a, u, p: [p.mass * a.x - u.push, p.mass * (a.z + p.gravity) - u.lift],
)
"""


def twin(file: str) -> None:
    """Write a model file with the paper's equations under another name, which it says otherwise, too."""
    source = Path(dr.models.planar_rotorcraft.__code__.co_filename).read_text()
    Path(file).write_text(source.replace('name="planar-rotorcraft"', 'name="twin"') + "\nmodel = planar_rotorcraft()\n")


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def clean_log() -> dr.Log:
    """A square flown by the true parameters on the undisturbed plant."""
    plant = dr.Plant(dr.models.planar_rotorcraft(), dr.models.TABLE_I)
    trajectory = dr.square(plant)
    return dr.fly(plant, trajectory, dr.tvlqr(plant, trajectory))


@pytest.fixture(scope="module")
def found(clean_log: dr.Log) -> dr.Result:
    """What least squares finds in that log."""
    return dr.identify(dr.models.planar_rotorcraft(), clean_log, method="ols")


@pytest.fixture
def result(folder: Path, found: dr.Result) -> dr.Result:
    """The same, saved as ``model.json``."""
    found.save("model.json")
    return found


# ---------------------------------------------------------------- simulate


@pytest.mark.parametrize("plant", [["--model", "planar-rotorcraft"], [*IMBALANCE, "--convention", "physical"]])
def test_simulate_writes_the_flight_with_the_planted_outliers(folder: Path, plant: list[object]):
    done = run("simulate", "star", *plant, *OUTLIERS, "--seed", 1, "-o", "flight.csv", "--json")
    clean = run("simulate", "star", *plant, "--seed", 1, "-o", "clean.csv", "--json")
    assert (done.exit_code, done.stderr, clean.exit_code) == (0, "", 0)
    said, log, true = json.loads(done.stdout), dr.read_log("flight.csv"), dr.read_log("clean.csv")
    signals = dr.models.planar_rotorcraft().signals
    assert 2400 < said["rows"] == len(log) < 2600
    assert said["rate"] == pytest.approx(100.0)
    for name in signals:
        error = log[name] - true[name]
        assert said["faults"][name] == np.count_nonzero(error)
        assert np.count_nonzero(error) == pytest.approx(0.1 * len(log), abs=6 * np.sqrt(0.09 * len(log)))
        assert 70 < np.abs(error).max() <= 80
        assert error[0] == 0.0
    assert np.array_equal(log["thrust"], true["thrust"])
    assert not any(json.loads(clean.stdout)["faults"].values())


def test_simulate_flies_what_the_library_flies(folder: Path):
    run("simulate", "sine", *IMBALANCE, "--blade-flapping", 0.3, "--parameter", "mass=0.26", "-o", "flight.csv")
    plant = dr.models.extended_rotorcraft(1.4e-6, blade_flapping=0.3, parameters={**dr.models.TABLE_I, "mass": 0.26})
    trajectory = dr.sine(plant)
    expected = dr.fly(plant, trajectory, dr.tvlqr(plant, trajectory))
    found = dr.read_log("flight.csv")
    assert found.names == expected.names
    assert all(np.array_equal(found[name], expected[name]) for name in expected.names)


def test_simulate_shows_tracking_errors_and_faults_by_signal(folder: Path, monkeypatch: pytest.MonkeyPatch):
    words = ("simulate", "square", *IMBALANCE, "--dropouts", 0.01, "-o", "flight.csv")
    text, said = run_both(monkeypatch, *words)
    shown = text.splitlines()
    rows = {line.split()[0]: line.split()[1:] for line in shown[2:]}
    assert "100 Hz" in shown[0]
    assert "seed 0" in shown[0]
    assert rows["x_dot"] == ["m/s", f"{said['tracking_error']['x_dot']:.4g}", str(said["faults"]["x_dot"])]
    assert rows["thrust"][0] == "N"
    assert set(said["tracking_error"]) == {"x", "z", "theta", "x_dot", "z_dot", "theta_dot"}
    assert said["faults"]["x_dot"] == np.isnan(dr.read_log("flight.csv")["x_dot"]).sum() > 0


@pytest.mark.parametrize("name", ["a.csv", "a.csv.gz", "a.parquet", "a.npz", "A.CSV"])
def test_simulate_gives_the_same_bytes_for_the_same_seed(folder: Path, name: str):
    words = ["simulate", "square", *IMBALANCE, "--rotor-phase", "any", *OUTLIERS]
    files = []
    for seed, to in ((3, name), (3, f"again-{name}"), (4, f"other-{name}")):
        assert run(*words, "--seed", seed, "-o", to).exit_code == 0
        files.append(Path(to).read_bytes())
    first, again, other = files
    assert first == again != other
    assert dr.read_log(name)["z"].shape == dr.read_log(f"other-{name}")["z"].shape


def test_simulate_takes_every_field_of_the_noise(folder: Path):
    told = {
        "--outliers": 0.1, "--magnitude": 5, "--outliers-hit": "rows", "--acceleration-noise": 0.5, "--rate-noise": 0.1,
        "--angular-acceleration-noise": 2, "--integrated-noise": "random-walk", "--first-row": "corrupted",
        "--bursts": 0.01, "--burst-length": 4, "--stuck": 0.02, "--stuck-length": 5,
        "--dropouts": 0.03, "--dropout-length": 6,
        "--leverage": 0.2, "--leverage-offset": 3, "--leverage-signal": "thrust",
        "--leverage-quantile": 0.8, "--delay": 0.02, "--quantisation": "x=0.001",
    }  # fmt: skip
    words = [word for pair in told.items() for word in pair]
    done = run("simulate", "square", *words, "--correlated", "--seed", 2, "-o", "flight.csv", "--json")
    noise = dr.Noise(0.1, 5, 0.5, 0.1, 2, "random-walk", "corrupted", 0.01, 4, 0.02, 5, 0.03, 6, True, 0.2, 3, "thrust",
                     0.8, 0.02, {"x": 0.001}, "rows")  # fmt: skip
    run("simulate", "square", "--seed", 2, "-o", "clean.csv")
    flown = dr.read_log("clean.csv")
    model = dr.models.planar_rotorcraft()
    log = dr.Log.from_arrays(flown.time, flown.signals, units=model.units)
    expected = dr.corrupt(log, noise, 2, signals=model.signals)
    found = dr.read_log("flight.csv")
    assert done.exit_code == 0
    assert json.loads(done.stdout)["noise"] == noise.changed
    assert set(noise.changed) == set(vars(noise)) == set(vars(NoiseOptions()))
    assert all(np.array_equal(found[name], expected[name], equal_nan=True) for name in expected.names)


def test_simulate_draws_the_flight_beside_the_log(folder: Path):
    done = run("simulate", "square", *OUTLIERS, "-o", "flight.csv", "--plot", "flight.png")
    assert done.exit_code == 0
    assert set(contents(folder)) == {"flight.csv", "flight.csv-metadata.json", "flight.png"}
    assert Path("flight.png").read_bytes().startswith(b"\x89PNG")


def test_simulate_flies_a_model_of_one_s_own_with_all_its_parameters(folder: Path):
    Path("slider.py").write_text(SLIDER)
    words = ["simulate", "square", "--model", "slider.py", "-o", "flight.csv"]
    partly = run(*words, "--parameter", "mass=2")
    done = run(*words, "--parameter", "mass=2,gravity=9.81")
    assert partly.exit_code == 1
    assert "--parameter gravity=VALUE" in partly.stderr
    assert done.exit_code == 0
    log = dr.read_log("flight.csv")
    assert np.array_equal(log["x_ddot"], log["push"] / 2)


def test_simulate_knows_table_i_for_the_paper_s_equations_under_any_name(folder: Path):
    twin("twin.py")
    for model, to in (("twin.py", "a.csv"), ("planar-rotorcraft", "b.csv")):
        assert run("simulate", "square", "--model", model, "-o", to).exit_code == 0
    assert dr.read_log("a.csv").fingerprint == dr.read_log("b.csv").fingerprint


# ---------------------------------------------------------------- fly


def test_fly_reaches_the_accuracy_of_the_true_parameters_where_they_were_found(result: dr.Result):
    done = run("fly", "model.json", "--trajectory", "sine", "--json")
    said = json.loads(done.stdout)
    assert (done.exit_code, done.stderr) == (0, "")
    assert max(said["tracking_error"].values()) < 1e-6
    assert max(said["true"]["tracking_error"].values()) < 1e-6
    assert said["true"]["parameters"] == dict(dr.models.TABLE_I)
    assert said["parameters"] == dict(result.parameters)


def test_fly_flies_what_the_library_flies(result: dr.Result):
    done = run("fly", "model.json", "--trajectory", "square", *IMBALANCE, "-o", "flown.csv", "--json")
    plant = dr.models.extended_rotorcraft(1.4e-6)
    trajectory = dr.square(result)
    log = dr.fly(plant, trajectory, dr.tvlqr(result, trajectory))
    said, flown = json.loads(done.stdout), dr.read_log("flown.csv")
    assert said["tracking_error"] == dr.tracking_error(trajectory, log)
    assert all(np.array_equal(flown[name], log[name]) for name in log.names)
    for name, (low, high) in trajectory.input_limits.items():
        assert said["at_limit"][name] == np.mean((log[name] <= low) | (log[name] >= high))


def test_fly_shows_errors_with_units_beside_those_of_the_true_parameters(
    result: dr.Result, monkeypatch: pytest.MonkeyPatch
):
    words = ["fly", "model.json", "--trajectory", "square", *IMBALANCE, "--parameter", "mass=0.22"]
    shown, said = run_both(monkeypatch, *words)
    rows = {line.split()[0]: line.split()[1:] for line in shown.splitlines()[1:] if line}
    error, ideal = said["tracking_error"]["z"], said["true"]["tracking_error"]["z"]
    assert rows["z"] == ["m", f"{error:.4g}", f"{ideal:.4g}"]
    assert error > 2 * ideal > 0
    assert rows["mass"][0] == "kg"
    assert float(rows["mass"][1]) == pytest.approx(0.249, rel=1e-4)
    assert float(rows["mass"][2]) == 0.22
    assert rows["thrust"][:4] == ["N", "0", "..", "5"]


@pytest.mark.slow
def test_fly_says_how_often_inputs_are_at_their_limits(result: dr.Result):
    heavy = ["--parameter", "mass=0.45"]
    said = json.loads(run("fly", "model.json", "--trajectory", "square", *heavy, "--json").stdout)
    assert said["at_limit"]["thrust"] > 0.01


@pytest.mark.slow
def test_fly_says_when_the_true_parameters_cannot_fly_themselves(result: dr.Result, monkeypatch: pytest.MonkeyPatch):
    shown, said = run_both(monkeypatch, "fly", "model.json", "--trajectory", "square", "--parameter", "mass=0.5")
    assert "! the flight with the true parameters failed" in shown
    assert "thrust" in said["true"]["refused"]


def test_fly_draws_and_repeats_itself(result: dr.Result):
    words = ["fly", "model.json", "--trajectory", "square", *IMBALANCE, "--rotor-phase", "any", "--seed"]
    first = run(*words, 5, "-o", "a.csv", "--plot", "a.png")
    again = run(*words, 5, "-o", "b.csv", "--plot", "b.png")
    other = run(*words, 6, "-o", "c.csv")
    assert first.stdout == again.stdout != other.stdout
    assert Path("a.csv").read_bytes() == Path("b.csv").read_bytes() != Path("c.csv").read_bytes()
    assert Path("a.png").read_bytes() == Path("b.png").read_bytes()


def test_fly_knows_table_i_for_the_paper_s_equations_under_any_name(
    folder: Path, clean_log: dr.Log, monkeypatch: pytest.MonkeyPatch
):
    twin("twin.py")
    clean_log.write("log.csv")
    assert run("identify", "log.csv", "--model", "twin.py", "--method", "ols", "-o", "model.json").exit_code == 0
    shown, said = run_both(monkeypatch, "fly", "model.json", "--trajectory", "square", *IMBALANCE)
    assert said["model"] == "twin"
    assert said["true"]["parameters"] == dict(dr.models.TABLE_I)
    assert "other equations" not in shown


def test_fly_takes_a_model_with_other_equations_for_the_same_machine_and_says_so(folder: Path, clean_log: dr.Log):
    dr.identify(dr.models.planar_rotorcraft(gravity=9.80665), clean_log, method="ols").save("model.json")
    unknown = run("fly", "model.json", "--trajectory", "square")
    done = run("fly", "model.json", "--trajectory", "square", *IMBALANCE)
    assert unknown.exit_code == 1
    assert "--parameter mass=VALUE" in unknown.stderr
    assert done.exit_code == 0
    assert "! the model has other equations" in done.stdout


# ---------------------------------------------------------------- how it ends

SIMULATE = ["simulate", "square", "-o", "flight.csv"]
FLY = ["fly", "model.json", "--trajectory", "square"]


@pytest.mark.parametrize(
    "words",
    [
        ["simulate"],
        ["simulate", "square"],
        ["simulate", "circle", "-o", "flight.csv"],
        ["simulate", "square", "-o", "flight.txt"],
        ["simulate", "square", "-o", ""],
        [*SIMULATE, "--plot", "flight.csv"],
        [*SIMULATE, "--seed", "-1"],
        [*SIMULATE, "--plant", "aeroplane"],
        [*SIMULATE, "--aerodynamic-imbalance", "1e-6"],
        [*SIMULATE, "--mass-imbalance", "0"],
        [*SIMULATE, "--convention", "physical"],
        [*SIMULATE, "--phase", "integrated"],
        [*SIMULATE, "--blade-flapping", "0.3"],
        [*SIMULATE, "--rotor-phase", "any"],
        [*SIMULATE, "--plant", "extended-rotorcraft", "--aerodynamic-imbalance", "nan"],
        [*SIMULATE, "--plant", "extended-rotorcraft", "--convention", "plain"],
        [*SIMULATE, "--plant", "extended-rotorcraft", "--rotor-phase", "somewhere"],
        [*SIMULATE, "--parameter", "mass"],
        [*SIMULATE, "--parameter", "mass=heavy"],
        [*SIMULATE, "--parameter", "mass=1", "--parameter", "mass=2"],
        [*SIMULATE, "--outliers", "1.1", "--magnitude", "80"],
        [*SIMULATE, "--outliers", "0.1"],
        [*SIMULATE, "--magnitude", "80"],
        [*SIMULATE, "--bursts", "0.1"],
        [*SIMULATE, "--correlated"],
        [*SIMULATE, "--leverage", "0.1", "--leverage-offset", "3"],
        [*SIMULATE, "--first-row", "dirty"],
        [*SIMULATE, "--quantisation", "x"],
        ["fly"],
        ["fly", "model.json"],
        [*FLY, "--aerodynamic-imbalance", "1e-6"],
        [*FLY, "-o", "flown.txt"],
        ["fly", "model.json", "--trajectory", "circle"],
    ],
)
def test_wrong_usage_ends_with_2(result: dr.Result, folder: Path, words: list[str]):
    before = contents(folder)
    done = run(*words)
    assert (done.exit_code, done.stdout) == (2, "")
    assert contents(folder) == before


def test_an_option_without_its_company_is_refused_in_the_command_line_s_words(folder: Path):
    assert "--outliers needs --magnitude" in run(*SIMULATE, "--outliers", 0.1).stderr
    assert "--magnitude needs --outliers or --bursts" in run(*SIMULATE, "--magnitude", 8).stderr
    assert "--mass-imbalance needs --plant extended-rotorcraft" in run(*SIMULATE, "--mass-imbalance", 1e-4).stderr


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([*SIMULATE, "--model", "absent"], "planar-rotorcraft"),
        ([*SIMULATE, "--model", "servo-axis"], "true parameters"),
        ([*SIMULATE, "--parameter", "weight=3"], "weight"),
        ([*SIMULATE, "--parameter", "mass=nan"], "mass"),
        ([*SIMULATE, "--parameter", "mass=-0.2"], "mass = -0.2, which is outside its bounds"),
        ([*SIMULATE, "--parameter", "mass=0.7"], "thrust"),
        ([*SIMULATE, "--model", "slider.py", "--plant", "extended-rotorcraft"], "slider"),
        ([*SIMULATE, "--outliers", "0.1", "--magnitude", "inf"], "outlier_magnitude"),
        ([*SIMULATE, "--quantisation", "y=0.1"], '"y"'),
        ([*SIMULATE, "--delay", "100"], "delay"),
        ([*SIMULATE, "--plot", "nowhere/flight.png"], "nowhere"),
        (["fly", "absent.json", "--trajectory", "square"], "absent.json"),
        (["fly", "slider.py", "--trajectory", "square"], "slider.py"),
        ([*FLY, "--parameter", "weight=3"], "weight"),
    ],
)
def test_what_cannot_be_done_ends_with_1_and_leaves_no_file(
    result: dr.Result, folder: Path, words: list[str], message: str
):
    Path("slider.py").write_text(SLIDER)
    before = contents(folder)
    done = run(*words)
    assert (done.exit_code, done.stdout) == (1, "")
    assert done.stderr.startswith("error: ")
    assert message in done.stderr
    assert contents(folder) == before


def test_a_plan_that_fails_writes_nothing_over_what_is_there(folder: Path, clean_log: dr.Log):
    heavy = {**clean_log.signals, "thrust": 3.0 * clean_log["thrust"]}
    log = dr.Log.from_arrays(clean_log.time, heavy)
    dr.identify(dr.models.planar_rotorcraft(), log, method="ols").save("model.json")
    Path("flown.csv").write_text("mine")
    before = contents(folder)
    done = run(*FLY, "-o", "flown.csv", "--plot", "flight.png")
    assert (done.exit_code, done.stdout) == (1, "")
    assert len(done.stderr.splitlines()) == 1
    assert contents(folder) == before


@pytest.mark.parametrize("words", [SIMULATE, [*FLY, "-o", "flown.csv"]])
def test_a_flight_that_diverges_says_when_and_writes_nothing(result: dr.Result, folder: Path, words: list[str]):
    before = contents(folder)
    done = run(*words, "--plot", "flight.png", "--plant", "extended-rotorcraft", "--aerodynamic-imbalance", "1e304")
    assert (done.exit_code, done.stdout) == (1, "")
    assert "square: the flight diverged at t = 0" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert contents(folder) == before


@pytest.mark.parametrize("words", [SIMULATE, [*FLY, "-o", "flown.csv"]])
def test_interrupt_ends_with_130_and_writes_nothing(
    result: dr.Result, folder: Path, monkeypatch: pytest.MonkeyPatch, words: list[str]
):
    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("diransac.cli.commands.flight.fly", interrupt)
    before = contents(folder)
    done = run(*words)
    assert (done.exit_code, done.stderr) == (130, "interrupted\n")
    assert contents(folder) == before


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["simulate", "square", "-o", "nowhere/flight.csv"], "does not exist"),
        ([*FLY, "-o", "folder.csv"], "not an ordinary file"),
        ([*FLY, "--plot", "link.png"], "reads"),
    ],
)
def test_outputs_are_checked_before_the_work(
    result: dr.Result, folder: Path, monkeypatch: pytest.MonkeyPatch, words: list[str], message: str
):
    monkeypatch.setattr("diransac.cli.commands.flight.tvlqr", lambda *_, **__: pytest.fail("the work has begun"))
    Path("folder.csv").mkdir()
    Path("link.png").symlink_to("model.json")
    before = contents(folder)
    done = run(*words)
    assert done.exit_code == 1
    assert message in done.stderr
    assert contents(folder) == before
