"""The verdict on a result and its findings: what they rest on, and that print, JSON and page show the same."""

import copy
import html
import json
import pickle
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import diransac as dr
from command_line import MODEL, run, run_both, working_folder
from diransac.identification.evaluation.prediction import unexplained
from diransac.identification.finding import Finding, by_seriousness, next_line, shown, shown_lines, verdict_of
from results import changed

DT, N, MASS, DRAG = 0.01, 1000, 1.5, 2.0


def sledge(**parameters):
    """A mass with viscous drag."""
    known = {"mass": dr.Parameter("kg", positive=True), "drag": dr.Parameter("N s/m", lower=0.0)}
    equations = lambda q, v, a, u, p: [p.mass * a.s + p.drag * v.s - u.force]  # noqa: E731
    return dr.Model("sledge", {"s": "m"}, {"force": "N"}, known | parameters, equations)


def slide(push=0.0, noise=0.0, late=0, drift=0.0, seed=0, source="sledge"):
    """A log of the sledge, exact where forces are held; ``push`` N are not recorded, drag grows by ``drift`` of it."""
    rng = np.random.default_rng(seed)
    t = DT * np.arange(N + late)
    force = 3.0 * np.sin(1.1 * t) + 2.0 * np.sin(3.7 * t + 0.5) + np.sin(7.9 * t)
    total = np.r_[np.zeros(late), force][: N + late] + push * np.sign(np.sin(0.6 * t))
    state, drag = np.zeros((N + late + 1, 2)), DRAG * (1.0 + drift * np.arange(N + late) / (N + late))
    for k, final in enumerate(total / drag):
        gap, decay = state[k, 1] - final, np.exp(-drag[k] / MASS * DT)
        state[k + 1] = state[k, 0] + final * DT + gap * (1.0 - decay) * MASS / drag[k], final + gap * decay
    columns = {"s": state[:-1, 0], "s_dot": state[:-1, 1], "s_ddot": (total - drag * state[:-1, 1]) / MASS}
    columns = {n: x[late:] + noise * rng.normal(size=N) for n, x in columns.items()}
    return dr.Log.from_arrays(t[:N], {**columns, "force": force[late:]}, source=source)


def inverted(seed):
    """A model of an unstable machine, and a log of it under feedback: open loop it leaves the log within a second."""
    model = dr.Model(
        "inverted",
        {"x": "rad"},
        {"torque": "N m"},
        {"stiffness": dr.Parameter("1/s^2"), "gain": dr.Parameter("1/(kg m^2)")},
        lambda q, v, a, u, p: [a.x - p.stiffness * q.x - p.gain * u.torque],
    )
    rng, t = np.random.default_rng(seed), DT * np.arange(1500)
    x, torque = np.zeros((1501, 2)), np.zeros(1500)
    for k in range(1500):
        torque[k] = -12.0 * x[k, 0] - 4.0 * x[k, 1] + 2.0 * np.sin(2.0 * t[k]) + rng.normal(0.0, 0.5)
        for _ in range(20):
            x[k + 1] = x[k] if _ == 0 else x[k + 1]
            x[k + 1, 1] += DT / 20 * (25.0 * x[k + 1, 0] + 5.0 * torque[k])
            x[k + 1, 0] += DT / 20 * x[k + 1, 1]
    signals = {"x": x[:-1, 0] + 2e-3 * rng.normal(size=1500), "x_dot": x[:-1, 1] + 1e-2 * rng.normal(size=1500)}
    return model, dr.Log.from_arrays(t, {**signals, "torque": torque}, source=f"inverted {seed}")


@pytest.fixture(scope="module")
def cases():
    """Results of every verdict with the logs that they were identified from."""
    good, late, pushed, wrong = slide(noise=0.002), slide(late=6), slide(push=1.0), slide(noise=0.002)
    drifting = slide(drift=0.3, noise=0.002)
    reversed_ = dr.Log.from_arrays(wrong.time, {**wrong.signals, "force": -wrong["force"]}, source="reversed")
    ols = dr.identify(sledge(), good, "ols")
    bounded = dr.identify(sledge(drag=dr.Parameter("N s/m", lower=3.0)), good, "ols")
    others = [good, slide(noise=0.002, seed=1, source="second"), replace(reversed_, source="third")]
    return {
        "least squares": (ols, good),
        "lo-diransac": (dr.identify(sledge(), good), good),
        "a delay": (dr.identify(sledge(), late), late),
        "a push": (dr.identify(sledge(), pushed), pushed),
        "a drift": (dr.identify(sledge(), drifting), drifting),
        "a wrong sign": (dr.identify(sledge(), reversed_, "ols"), reversed_),
        "a violated bound": (bounded, good),
        "logs that disagree": (dr.identify(sledge(), [others[0], others[1], _heavy()], "ols"), others[:2]),
        "few samples": (dr.identify(sledge(), good, "i-diransac", settings=dr.Settings(max_iterations=5)), good),
        "derived signals": (dr.identify(sledge(), _positions(good), "ols", differentiate=True), _positions(good)),
    }


def _positions(log):
    return dr.Log.from_arrays(log.time, {"s": log["s"], "force": log["force"]}, source="positions")


def _heavy():
    log = slide(noise=0.002, seed=2)
    return dr.Log.from_arrays(log.time, {**log.signals, "force": 2.0 * log["force"]}, source="heavy")


NAMES = "least squares|lo-diransac|a delay|a push|a drift|a wrong sign|a violated bound|logs that disagree|few samples"
CASES = pytest.mark.parametrize("name", [*NAMES.split("|"), "derived signals"])


# ---------------------------------------------------------------------- the same everywhere


@CASES
def test_json_has_all_findings_and_print_and_page_the_most_serious(cases, name, tmp_path):
    result, log = cases[name]
    data = json.loads(json.dumps(result.to_dict()))
    assert data["verdict"] == result.verdict
    assert data["findings"] == [{"level": x.level, "text": str(x), "action": x.action} for x in result.findings]
    lines = str(result).splitlines()
    assert lines.count(f"verdict: {result.verdict}") == 1
    printed = [line[2:] for line in lines if line.startswith(("! ", "· "))]
    assert printed == shown(result.findings)[0]
    assert lines[-1] == next_line(result.findings)
    dr.write_report(result, log, tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert re.search(r'<span class="method">.*?</span> (.*?)</h3>', page).group(1) == result.verdict
    listed = re.findall(r'<li class="(\w+)"><span class="sign".*?</span> (.*?)</li>', page)
    few = shown(result.findings, good=True)[0]
    assert [(level, html.unescape(text)) for level, text in listed] == [(x.level, str(x)) for x in few]
    assert html.unescape(re.search(r'<p class="next">(.*?)</p>', page).group(1)) == next_line(result.findings)


@CASES
def test_findings_are_read_back_as_they_were_saved(cases, name, tmp_path):
    result, _ = cases[name]
    result.save(tmp_path / "model.json")
    loaded = dr.Result.load(tmp_path / "model.json")
    assert loaded.verdict == result.verdict
    assert [(x.level, x) for x in loaded.findings] == [(x.level, x) for x in result.findings]
    assert loaded.logs == result.logs


@CASES
def test_every_finding_is_a_sentence_and_the_most_serious_stand_first(cases, name):
    found = cases[name][0].findings
    assert all(isinstance(x, str) and x.endswith(".") and x[0] == x[0].lstrip() for x in found)
    assert [x.seriousness for x in found] == sorted((x.seriousness for x in found), reverse=True)


@CASES
def test_each_finding_against_a_result_has_an_action(cases, name):
    assert all(x.action and x.endswith(f"; {x.action}.") for x in cases[name][0].findings if x.level in ("bad", "care"))


def test_five_findings_are_shown_and_the_others_counted():
    found = [Finding("care", f"Signal {k} is late", f"shift {k}") for k in range(7)]
    found += [Finding("note", "Time stamps jitter."), Finding("bad", "The time runs backwards", "sort the rows")]
    few, more = shown(found)
    assert (len(few), more) == (5, 3)
    assert few[0] == "The time runs backwards; sort the rows."
    assert shown_lines(found)[-1] == "  and 3 more in the JSON"
    assert next_line(found) == "Next: sort the rows."


def test_findings_with_one_action_are_shown_as_the_first():
    found = [Finding("bad", f"{name} is off", "add the drag") for name in "xyz"]
    assert shown(found) == ([found[0]], 2)


def test_a_result_that_nothing_opposes_is_to_be_validated(cases):
    assert str(cases["lo-diransac"][0]).splitlines()[-1].startswith("Next: predict a log that it was not identified")


def test_a_mistake_of_a_column_explains_all_that_is_bad(cases):
    result = cases["a wrong sign"][0]
    against = [x for x in result.findings if x.level in ("bad", "care")]
    assert len(against) > 2
    assert {x.action for x in against} == {"identify again with --scale force=-1"}
    assert "The sign of force or s is reversed" in against[0]


def test_results_of_the_format_before_are_read(cases):
    """Their findings are sentences without actions, and no columns were tested."""
    result = cases["a drift"][0]
    data = json.loads(json.dumps(result.to_dict()))
    for one in (*data["checks"], *data["findings"]):
        del one["action"]
    for one in (*data["suggestions"], *(data["possible_terms"] or ())):
        del one["name"]
    del data["mistakes"], data["n_columns_tested"]
    old = dr.Result.from_dict({**data, "format": 9})
    assert old.verdict == result.verdict
    assert old.parameters == result.parameters


# ---------------------------------------------------------------------- what a verdict rests on


@pytest.mark.parametrize(
    ("name", "verdict", "reason"),
    [
        ("least squares", "usable", ""),
        ("lo-diransac", "usable", ""),
        ("a delay", "usable with care", "Inputs act 60 ms later than recorded, which the estimate includes"),
        ("a push", "do not rely on this", "Over the whole log the prediction of s is off by"),
        ("a drift", "usable with care", "drag changes during the log"),
        ("a wrong sign", "do not rely on this", "mass = −1.5 kg is outside its bounds"),
        ("a violated bound", "do not rely on this", "is outside its bounds (≥ 3)"),
        ("logs that disagree", "do not rely on this", "heavy disagrees with the other logs"),
    ],
)
def test_a_verdict_has_its_reason_among_the_findings(cases, name, verdict, reason):
    result, _ = cases[name]
    assert result.verdict == verdict, result.findings
    assert any(reason in finding for finding in result.findings), result.findings


def test_an_unstable_machine_is_judged_by_restarted_simulations_of_held_out_logs_too(tmp_path):
    model, log = inverted(seed=3)
    result = dr.identify(model, log, differentiate=True)
    assert result.parameters["stiffness"] == pytest.approx(25.0, rel=0.05)
    assert result.inlier_fraction < 0.5
    assert result.verdict == "usable", result.findings
    assert result.predictions.judged.horizon < 0.2 * (len(log) - 1) * DT
    dr.write_report(result, inverted(seed=4)[1], tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert "</span> usable</h3>" in page
    falling = changed(result, parameters={"stiffness": -25.0, "gain": 5.0})
    dr.write_report(falling, inverted(seed=4)[1], tmp_path / "page.html")
    assert "</span> do not rely on this</h3>" in (tmp_path / "page.html").read_text()


def test_predictions_find_wrong_parameters(cases):
    """Parameters that do not belong to the diagnosis beside them leave the motion."""
    result, log = cases["lo-diransac"]
    light = dr.validate(changed(result, parameters={"mass": 0.5 * MASS, "drag": 0.2 * DRAG}), log)
    assert light.verdict == "do not rely on this"
    assert any("the prediction of" in x and x.level == "bad" for x in light.findings)


def test_a_coordinate_at_rest_is_no_evidence_against_the_model():
    """Relative to an acceleration of nothing, all of what is left of it would be unexplained."""
    units = {"x_ddot": "m/s^2", "y_ddot": "m/s^2", "turn_ddot": "rad/s^2"}
    left = {"x_ddot": 0.1, "y_ddot": 1e-9, "turn_ddot": 1e-3}
    modelled = {"x_ddot": 0.9, "y_ddot": 0.0, "turn_ddot": 1e-3}
    unmodelled = {n: np.array([x, -x]) for n, x in left.items()}
    found = unexplained(unmodelled, {n: np.full(5, x) for n, x in modelled.items()}, units)
    assert found == pytest.approx({"x_ddot": 0.1, "turn_ddot": 0.5})


@pytest.mark.parametrize(("outliers", "level"), [(0.3, "note"), (0.6, "care"), (0.9, "bad")])
def test_a_signal_that_is_mostly_outliers_is_no_evidence_for_the_model(cases, outliers, level):
    result, _ = cases["lo-diransac"]
    fractions = {**result.diagnosis.outlier_fraction, "s_dot": outliers}
    doubtful = changed(result, diagnosis=replace(result.diagnosis, outlier_fraction=fractions))
    assert next(x.level for x in doubtful.findings if "(s_dot) are outliers" in x) == level


def test_noise_that_is_larger_than_the_signal_explains_no_error(cases):
    """A fit that takes a signal for noise has wrong parameters and small errors beside that noise."""
    result, log = cases["lo-diransac"]
    found = result.diagnosis
    lost = replace(
        found, noise_std=dict.fromkeys(found.noise_std, 1e6), outliers={n: ~x for n, x in found.outliers.items()}
    )
    wrong = changed(result, parameters={"mass": 1e-7, "drag": 1e-7}, diagnosis=lost)
    assert dr.validate(wrong, log).verdict == "do not rely on this"


@pytest.mark.parametrize(
    ("unidentifiable", "verdict"), [(("drag",), "usable with care"), (("mass", "drag"), "do not rely on this")]
)
def test_one_undetermined_parameter_needs_care_and_all_of_them_are_no_model(cases, unidentifiable, verdict):
    result, _ = cases["lo-diransac"]
    vague = changed(result, diagnosis=replace(result.diagnosis, unidentifiable=unidentifiable))
    assert vague.verdict == verdict


def test_less_than_half_inliers_of_least_squares_need_care_and_of_lo_diransac_are_a_note(cases):
    words = "4 % of 1,000 rows agree"
    poor = [changed(cases[name][0], inlier_fraction=0.4 / 100.0) for name in ("least squares", "lo-diransac")]
    levels = [next(x.level for x in one.findings if words in x) for one in poor]
    assert levels == ["care", "note"]
    assert [one.verdict for one in poor] == ["usable with care", "usable"]


def test_what_no_simulation_supports_is_not_usable(cases):
    """A log without its initial state has no prediction."""
    result, _ = cases["least squares"]
    unsupported = replace(result, predictions=None)
    assert unsupported.verdict == "usable with care"
    assert any("No prediction is compared" in finding for finding in unsupported.findings)
    assert dr.Result.from_dict(json.loads(json.dumps(unsupported.to_dict()))).findings == unsupported.findings


def test_a_methods_own_checks_are_findings_and_are_kept(cases, tmp_path):
    result, _ = cases["lo-diransac"]
    alarm = Finding("bad", "Plain least squares lies outside the interval: record a set point.")
    alarmed = changed(result, checks=(alarm, Finding("note", "The encoder has no bias.")))
    assert alarmed.verdict == "do not rely on this"
    assert alarmed.findings[0] == alarm
    alarmed.save(tmp_path / "model.json")
    assert dr.Result.load(tmp_path / "model.json") == alarmed


@pytest.mark.parametrize(
    ("levels", "verdict"),
    [
        ([], "usable with care"),
        (["note"], "usable with care"),
        (["note", "good"], "usable"),
        (["good", "care"], "usable with care"),
        (["good", "bad", "care"], "do not rely on this"),
    ],
)
def test_the_verdict_is_that_of_the_most_serious_finding_and_usable_is_earned(levels, verdict):
    assert verdict_of(Finding(level, "It is so.") for level in levels) == verdict


def test_a_finding_is_a_string_with_a_level_that_survives_copies():
    finding = Finding("care", "Inputs act late.")
    for other in (copy.deepcopy(finding), pickle.loads(pickle.dumps(finding))):
        assert (other, other.level, type(other)) == (finding, "care", Finding)
    assert json.dumps(finding) == '"Inputs act late."'
    with pytest.raises(ValueError, match="level 'fatal'"):
        Finding("fatal", "It burns.")
    assert [x.level for x in by_seriousness([Finding("note", "A."), finding])] == ["care", "note"]


# ---------------------------------------------------------------------- the command line


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A good log, ``swim.csv``, and ``back.csv`` with its thrust reversed."""
    working_folder(tmp_path, monkeypatch)
    log = dr.read_log("swim.csv")
    dr.Log.from_arrays(log.time, {**log.signals, "thrust": -log["thrust"]}).write("back.csv")
    return tmp_path


@pytest.mark.parametrize(("log", "strict", "code"), [("swim", True, 0), ("back", True, 3), ("back", False, 0)])
def test_strict_has_an_exit_code_of_its_own_after_all_outputs(folder, log, strict, code):
    words = ["--method", "ols", "-o", "model.json", "--report", "page.html", *(["--strict"] if strict else [])]
    done = run("identify", f"{log}.csv", *MODEL, *words)
    assert done.exit_code == code
    result = dr.Result.load("model.json")
    assert (result.verdict == "do not rely on this") == (log == "back")
    assert f"verdict: {result.verdict}" in done.stdout
    assert result.verdict in Path("page.html").read_text()


def test_strict_prints_whole_json_before_it_ends(folder):
    done = run("identify", "back.csv", *MODEL, "--method", "ols", "--json", "--strict")
    assert done.exit_code == 3
    assert json.loads(done.stdout)["verdict"] == "do not rely on this"


def test_compare_shows_each_methods_verdict_and_sentences(folder, monkeypatch):
    text, data = run_both(monkeypatch, "compare", "back.csv", *MODEL, "--methods", "ols,tls")
    for name, found in data["methods"].items():
        assert found["verdict"] == "do not rely on this"
        (row,) = [line for line in text.splitlines() if line.startswith(f"{name} ")]
        assert row.endswith(found["verdict"])
        parts = [(x["level"], x["text"].removesuffix(f"; {x['action']}."), x["action"]) for x in found["findings"]]
        few, more = shown(Finding(*x) for x in parts)
        assert few
        assert all(f" {name}: {x}" in text for x in few)
        assert f"{name}: and {more} more in the JSON" in text
