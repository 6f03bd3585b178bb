"""Exported models: C that is compiled, Python, CasADi and YAML against the equations; what the ending names, or not."""

import ctypes
import runpy
import shutil
import subprocess

import casadi as ca
import numpy as np
import pytest

import diransac as dr
from command_line import run
from diransac.data.input_timing import InputTiming
from diransac.errors import ModelError, ResultError, SettingsError
from diransac.export import PortableModel, write_model
from diransac.model.library import BUILTIN
from results import changed
from simulated import MACHINES, as_log, flight

MODELS = {name: make() for name, make in BUILTIN.items()}
SWITCHING = dr.Model(
    "9 switches!",
    {"x": "m"},
    {"push": "N"},
    {"mass": dr.Parameter("kg", positive=True), "coulomb": dr.Parameter("N")},
    lambda q, v, a, u, p: [
        p.mass * a.x
        + p.coulomb * ca.sign(v.x)
        + ca.if_else(ca.logic_and(q.x > 0.1, v.x <= 2.0), ca.fmax(q.x, 0.5) ** 1.5, ca.atan2(v.x, 2.0) + ca.tanh(q.x))
        - u.push / ca.sqrt(1.0 + ca.fabs(q.x))
    ],
)


def portable(model: dr.Model, **changes) -> PortableModel:
    """A model with parameters drawn near 1, and a covariance."""
    rng = np.random.default_rng(1)
    values = dict(zip(model.parameters, rng.uniform(0.5, 1.5, model.n_p).tolist(), strict=True))
    errors = dict.fromkeys(values, 0.1)
    return PortableModel(model, values, errors, 0.01 * np.eye(model.n_p), **changes)


def states_of(model: dr.Model, n: int = 5) -> tuple[np.ndarray, np.ndarray]:
    """Random states, with unit quaternions, and inputs."""
    rng = np.random.default_rng(2)
    x, u = rng.uniform(0.2, 1.2, (n, len(model.state))), rng.uniform(0.2, 1.2, (n, model.n_u))
    for four in model.quaternions:
        x[:, four] /= np.linalg.norm(x[:, four], axis=1, keepdims=True)
    return x, u


def rates(exported: PortableModel, x: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Derivatives of states by the model's own function."""
    p = list(exported.parameters.values())
    return np.array([np.array(exported.model.dynamics(a, b, p)[0])[:, 0] for a, b in zip(x, u, strict=True)])


def stepped(exported: PortableModel, x: np.ndarray, u: np.ndarray, dt: float) -> np.ndarray:
    """States after dt by a hundred steps of the midpoint rule."""
    h = dt / 100
    for _ in range(100):
        x = x + h * rates(exported, x + 0.5 * h * rates(exported, x, u), u)
    return x


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    """All models in one shared library, compiled strictly."""
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("EXPORTED C NOT CHECKED: there is no C compiler, cc")
    folder = tmp_path_factory.mktemp("exported")
    sources = []
    for k, model in enumerate([*MODELS.values(), SWITCHING]):
        write_model(portable(model), folder / f"model{k}.c", "c")
        sources.append(f'#include "model{k}.c"\n')
    (folder / "all.c").write_text("".join(sources))
    flags = ["-std=c99", "-O1", "-ffp-contract=off", "-Wall", "-Wextra", "-Werror", "-pedantic", "-shared", "-fPIC"]
    subprocess.run([compiler, *flags, "-o", folder / "all.so", folder / "all.c", "-lm"], check=True)
    return ctypes.CDLL(str(folder / "all.so"))


def called(function, n_out: int, *arguments) -> np.ndarray:
    """Result of a C function of arrays and numbers."""
    given = [x.ctypes.data_as(ctypes.POINTER(ctypes.c_double)) if isinstance(x, np.ndarray) else x for x in arguments]
    found = np.full(n_out, np.nan)
    function(*given, found.ctypes.data_as(ctypes.POINTER(ctypes.c_double)))
    return found


@pytest.mark.parametrize("model", [*MODELS.values(), SWITCHING], ids=[*MODELS, "switching"])
def test_c_has_the_derivatives_of_the_model(library, model):
    exported = portable(model)
    x, u = states_of(model)
    wanted = rates(exported, x, u)
    function = getattr(library, f"{exported.identifier}_derivative")
    found = [called(function, len(model.state), *pair) for pair in zip(x, u, strict=True)]
    assert np.abs(found - wanted).max() <= 1e-12 * np.abs(wanted).max()


@pytest.mark.parametrize("name", ["quadrotor", "cart-pole"])
def test_steps_of_c_and_python_are_those_of_a_fine_simulation(library, tmp_path, name):
    exported = portable(MODELS[name])
    x, u = states_of(exported.model)
    dt, n_x = 1e-3, len(exported.model.state)
    wanted = stepped(exported, x, u, dt)
    for four in exported.model.quaternions:
        wanted[:, four] /= np.linalg.norm(wanted[:, four], axis=1, keepdims=True)
    function = getattr(library, f"{exported.identifier}_step")
    in_c = np.array([called(function, n_x, a, b, ctypes.c_double(dt)) for a, b in zip(x, u, strict=True)])
    write_model(exported, tmp_path / "dynamics.py", "python")
    in_python = runpy.run_path(str(tmp_path / "dynamics.py"))["step"](x, u, dt)
    assert in_c == pytest.approx(wanted, rel=1e-6, abs=1e-7)
    assert in_python == pytest.approx(in_c, rel=1e-12, abs=1e-14)
    for four in exported.model.quaternions:
        assert np.linalg.norm(in_c[:, four], axis=1) == pytest.approx(1.0, abs=1e-15)


@pytest.mark.parametrize("model", [*MODELS.values(), SWITCHING], ids=[*MODELS, "switching"])
def test_python_and_casadi_have_the_derivatives_of_the_model(tmp_path, model):
    exported = portable(model)
    x, u = states_of(model)
    wanted = rates(exported, x, u)
    write_model(exported, tmp_path / "dynamics.py", "python")
    write_model(exported, tmp_path / "dynamics.casadi", "casadi")
    derivative = runpy.run_path(str(tmp_path / "dynamics.py"))["derivative"]
    assert np.abs(derivative(x, u) - wanted).max() <= 1e-12 * np.abs(wanted).max()
    assert derivative(x[:, None], u[:, None]).shape == (len(x), 1, x.shape[1])
    first = next(iter(exported.parameters))
    draws = {**exported.parameters, first: exported.parameters[first] * np.ones((3, 1))}
    assert derivative(x, u, draws) == pytest.approx(np.tile(wanted, (3, 1, 1)), rel=1e-12)
    function = ca.Function.load(str(tmp_path / "dynamics.casadi"))
    found = np.array([np.array(function(state=a, inputs=b)["derivative"])[:, 0] for a, b in zip(x, u, strict=True)])
    assert np.abs(found - wanted).max() <= 1e-12 * np.abs(wanted).max()


@pytest.fixture(scope="module")
def result():
    machine = MACHINES["planar-rotorcraft"]
    found = dr.identify(dr.models.planar_rotorcraft(), as_log(machine, *flight(machine, 150, 0.02), 0.02), "ols")
    resolution = dr.identification.estimate.Resolution(timing=InputTiming(delay=0.012, lag=0.03))
    return changed(found, resolution=resolution)


def test_yaml_has_estimates_covariance_draws_and_timing(result, tmp_path):
    yaml = pytest.importorskip("yaml", reason="EXPORTED YAML NOT READ: PyYAML is missing")
    result.export(tmp_path / "model.yaml")
    document = yaml.safe_load((tmp_path / "model.yaml").read_text())
    assert {n: x["value"] for n, x in document["parameters"].items()} == result.parameters
    assert {n: x["standard_error"] for n, x in document["parameters"].items()} == result.standard_errors
    assert document["parameters"]["drag"]["upper"] == np.inf
    assert list(document["covariance"].values()) == result.covariance.tolist()
    assert document["samples"] == {n: x.tolist() for n, x in result.sample(1000).items()}
    assert document["input_timing"]["delay_s"] == {"thrust": 0.012, "moment": 0.012}
    assert document["input_timing"]["lag_s"] == {"thrust": 0.03, "moment": 0.03}


def test_delay_and_lag_are_said_to_be_the_callers(result, tmp_path):
    for name in ("dynamics.c", "dynamics.py", "model.yaml"):
        assert result.export(tmp_path / name) == ()
        text = (tmp_path / name).read_text()
        assert "the caller delays thrust by 12 ms, moment by 12 ms" in text
        assert "first-order lags with the time constants 30 ms of thrust, 30 ms of moment" in text


@pytest.mark.parametrize(
    ("name", "arguments", "message"),
    [
        ("model.toml", {}, r'exported to ".toml"; there are c \(.c\), python'),
        ("model", {"to": "fmu"}, 'exported to "fmu"; there are c'),
        ("model.sdf", {"to": "sdf"}, "SDF is not written"),
        ("model.c", {"to": "python"}, "ending of c, not of python"),
        ("model.xml", {}, "mjcf is a robot's description with the estimates in it; give it"),
        ("model.c", {"into": "go2.xml"}, "has no use"),
    ],
)
def test_what_cannot_be_exported_is_refused_in_a_sentence(result, tmp_path, name, arguments, message):
    with pytest.raises(SettingsError, match=message):
        result.export(tmp_path / name, **arguments)
    assert not list(tmp_path.iterdir())


def test_equations_without_a_form_in_a_language_leave_no_file(tmp_path):
    model = dr.Model(
        "bent",
        {"x": "m"},
        {"push": "N"},
        {"mass": dr.Parameter("kg", positive=True)},
        lambda q, v, a, u, p: [p.mass * a.x + ca.erf(q.x) - u.push],
    )
    with pytest.raises(ModelError, match="ERF, which NumPy lacks; export to CasADi"):
        write_model(portable(model), tmp_path / "dynamics.py", "python")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("name", ["state", "inputs", "derivative"])
def test_a_parameter_that_hides_an_argument_or_the_result_is_refused(tmp_path, name):
    model = dr.Model("m", {"x": "m"}, {"u": "N"}, {name: dr.Parameter("kg", positive=True)}, lambda q, v, a, u, p: [
        p[name] * a.x - u.u
    ])  # fmt: skip
    with pytest.raises(ModelError, match=f"a parameter is named {name}, as"):
        write_model(portable(model), tmp_path / "dynamics.casadi", "casadi")


def test_export_from_the_command_line(result, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result.save("model.json")
    done = run("export", "model.json", "-o", "dynamics.c")
    assert (done.exit_code, done.stdout) == (0, "wrote dynamics.c\n")
    result.export("same.c")
    assert (tmp_path / "dynamics.c").read_text() == (tmp_path / "same.c").read_text()
    assert run("export", "model.json", "--to", "python", "-o", "dynamics").exit_code == 0
    for words, message in ((["-o", "model.toml"], "there are c (.c)"), (["--to", "sdf", "-o", "a"], "SDF")):
        done = run("export", "model.json", *words)
        assert done.exit_code == 2
        assert message in done.stderr
    done = run("export", "model.json", "-o", "model.xml")
    assert done.exit_code == 1
    assert sorted(x.name for x in tmp_path.iterdir()) == ["dynamics", "dynamics.c", "model.json", "same.c"]


def test_a_folder_that_is_missing_is_said(result, tmp_path):
    with pytest.raises(ResultError, match="cannot be written"):
        result.export(tmp_path / "none" / "dynamics.c")


def test_means_over_logs_and_parameters_of_sensors_are_said(tmp_path):
    yaml = pytest.importorskip("yaml", reason="EXPORTED YAML NOT READ: PyYAML is missing")
    model = dr.Model(
        "slope",
        {"x": "m"},
        {"push": "N"},
        {"mass": dr.Parameter("kg", positive=True), "tilt": dr.Parameter("N", per_log=True)},
        lambda q, v, a, u, p: [p.mass * a.x + p.tilt - u.push],
        sensors=dr.sensors.encoder("x", unit="m", name="encoder"),
    )
    exported = portable(model, per_log={"tilt": (1.0, 2.5)})
    (of_sensor,) = exported.of_sensors
    for to, ending in (("c", "c"), ("python", "py"), ("yaml", "yaml")):
        write_model(exported, tmp_path / f"model.{ending}", to)
        text = (tmp_path / f"model.{ending}").read_text()
        assert "tilt has a value for each log (1, 2.5); what stands here is their mean." in text
        assert f"The motion does not depend on {of_sensor}" in text
    document = yaml.safe_load((tmp_path / "model.yaml").read_text())["parameters"]
    assert document["tilt"]["per_log"] == [1.0, 2.5]
    assert [name for name, x in document.items() if x.get("sensor_only")] == [of_sensor]


def test_two_results_of_one_model_are_linked_together_under_names_of_their_own(tmp_path):
    compiler = shutil.which("cc")
    if compiler is None:
        pytest.skip("EXPORTED C NOT LINKED: there is no C compiler, cc")
    for name in ("left wheel", "right wheel"):
        write_model(portable(MODELS["servo-axis"], name=name), tmp_path / f"{name}.c", "c")
    words = [compiler, "-std=c99", "-shared", "-fPIC", "-o", tmp_path / "both.so"]
    subprocess.run([*words, *sorted(tmp_path.glob("*.c")), "-lm"], check=True)
    both = ctypes.CDLL(str(tmp_path / "both.so"))
    assert both.left_wheel_step
    assert both.right_wheel_step
