"""The report page: content, safety, and completeness of its figures."""

import base64
import dataclasses
import hashlib
import re
import subprocess
import sys
from html.parser import HTMLParser

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from jinja2 import UndefinedError

import diransac as dr
from diransac.arrays import bulk_range
from diransac.data.dataset import Dataset
from diransac.identification.evaluation.prediction import predictions
from diransac.identification.evaluation.scoring import judged_signals
from diransac.report import figures, labelled, rendering
from diransac.report.runs import simulate_on
from diransac.simulation import RolloutBatch, rollouts
from diransac.text_table import number, percent, share
from results import changed

VOID = {"meta", "input", "link"}
HOSTILE = '</script><script>alert(1)</script>"><img src=x onerror=alert(1)>'
PARAMETERS = {"mass": 40.0, "linear_drag": 8.0, "quadratic_drag": 12.0, "bias": 1.0}


# ---------------------------------------------------------------------- material


class Page(HTMLParser):
    """The elements of a page, in order; fails where they do not nest."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.words, self._open = [], [], []
        self.feed(text)
        self.close()
        assert not self._open

    def handle_starttag(self, name, attributes):
        """Note an element that opens."""
        self.elements.append((name, dict(attributes)))
        if name not in VOID:
            self._open.append(name)

    def handle_endtag(self, name):
        """Close the element that was opened last."""
        assert self._open.pop() == name

    def handle_data(self, data):
        """Keep what is read."""
        if not {"script", "style"} & set(self._open):
            self.words.append(data)

    @property
    def text(self):
        """What is read, with single spaces."""
        return " ".join(" ".join(self.words).split())

    def all(self, name, look=""):
        """Attributes of the elements of a name and CSS classes."""
        wanted = set(look.split())
        return [a for n, a in self.elements if n == name and wanted <= set((a.get("class") or "").split())]


@pytest.fixture(scope="module")
def model():
    return dr.models.underwater_vehicle()


def dive(model, n_rows=600, dt=0.02, source='log "dive.csv"'):
    """A noise-free dive: a thrust that sweeps, and what the vehicle does."""
    t = np.arange(n_rows) * dt
    thrust = 25.0 * np.sin(0.9 * t) + 12.0 * np.sin(2.3 * t + 0.4)
    flown = rollouts(model).trajectories(RolloutBatch([list(PARAMETERS.values())], np.zeros(2), thrust[:, None], dt))[0]
    signals = dict(zip(model.signals, flown.T, strict=True))
    return dr.Log.from_arrays(3.0 + t, {**signals, "thrust": thrust}, units=model.units, source=source)


def with_signals(log, **changed):
    return dr.Log.from_arrays(log.time, {**log.signals, **changed}, units=dict(log.units), source=log.source)


def spiked(log, rows, size=80.0):
    """The log with outliers in every signal but the input of some rows."""
    changed = {n: log[n].copy() for n in ("x", "x_dot", "x_ddot")}
    for values in changed.values():
        values[rows] += size
    return with_signals(log, **changed)


@pytest.fixture(scope="module")
def log(model):
    return dive(model)


@pytest.fixture(scope="module")
def result(model, log):
    return dr.identify(model, log, "ols")


def written(results, log, folder):
    path = folder / "report.html"
    dr.write_report(results, log, path)
    return path.read_text(encoding="utf-8")


def vertices(path):
    """Rows and heights of a path, by its grammar: relative pairs, ``h0`` making dots."""
    numbers = [int(x) for x in re.findall(r"-?\d+", path.replace("h0", ""))]
    return np.cumsum(np.reshape(numbers, (-1, 2)), axis=0)


# ---------------------------------------------------------------------- what the page says


def test_page_names_model_method_log_and_every_parameter_with_its_interval(result, log, tmp_path):
    text = Page(written(result, log, tmp_path)).text
    assert "underwater-vehicle an underwater vehicle" in text
    assert 'Identified by ols from log "dive.csv" (11.98 s at 50 Hz, 600 rows)' in text
    for name, (low, high) in result.intervals().items():
        assert f"{name} {result.units[name]}" in text
        assert f"{number(low, 5)} … {number(high, 5)}" in text


def test_page_holds_what_repeats_the_identification(model, log, tmp_path):
    settings = dr.Settings(max_iterations=7, stop_inlier_fraction=None)
    text = Page(written(dr.identify(model, log, "i-diransac", seed=5, settings=settings), log, tmp_path)).text
    assert all(words in text for words in ("method i-diransac", "seed 5", "max_iterations 7"))
    assert log.fingerprint in text
    assert "llvmlite" in text


def test_page_shows_the_equations_and_the_notes(result, log, tmp_path):
    noted = changed(result, notes=("the sea was rough",))
    text = Page(written(noted, log, tmp_path)).text
    assert all(" ".join(line.split()) in text for line in result.model.equations_text())
    assert "the sea was rough" in text


def test_every_measured_signal_has_a_figure_with_words_for_those_who_cannot_see_it(result, log, tmp_path):
    page = Page(written(result, log, tmp_path))
    labels = [a["aria-label"] for a in page.all("svg")]
    for name in ("x", "x_dot", "x_ddot"):
        assert any(label.startswith(f"{name} in ") for label in labels)
        assert any(label.startswith(f"Residuals of {name}") for label in labels)
    assert all(a["role"] == "img" for a in page.all("svg"))


def test_methods_stand_side_by_side_in_their_own_colours(model, log, tmp_path):
    few = dr.Settings(max_iterations=20)
    results = [dr.identify(model, log, m) for m in (dr.IDiransac(few), dr.Diransac(few), "ols")]
    page = Page(written(results, log, tmp_path))
    assert "in 3 ways (i-diransac, diransac, ols)" in page.text
    assert len(page.all("article", "card")) == 3
    assert len(page.all("span", "estimate")) == 3 * model.n_p
    assert len(page.all("path", "line m2")) >= 3


def test_a_log_of_one_signal_is_enough(model, log, tmp_path):
    settings = dr.Settings(initial_state={"x": log["x"][0], "x_dot": log["x_dot"][0]})
    found = dr.identify(model, log, "ols", settings=settings)
    alone = dr.Log.from_arrays(log.time, {"x": log["x"], "thrust": log["thrust"]}, source="position alone")
    page = Page(written(found, alone, tmp_path))
    assert "position alone" in page.text
    assert len([a for a in page.all("svg") if a["aria-label"].startswith("Residuals")]) == 1


def test_same_results_and_log_give_the_same_page(result, log, tmp_path):
    assert written(result, log, tmp_path) == written(result, log, tmp_path)


def test_labels_are_the_mappings_or_the_methods_numbered_where_they_repeat(result):
    assert list(labelled(result)) == ["ols"]
    assert list(labelled([result, result])) == ["ols", "ols #2"]
    assert list(labelled({"before": result, "after": result})) == ["before", "after"]


@pytest.mark.parametrize("nothing", [[], {}, ["model.json"], None])
def test_what_is_no_result_is_refused(nothing, log, tmp_path):
    with pytest.raises(dr.ResultError, match=r"results of diransac\.identify; found"):
        dr.write_report(nothing, log, tmp_path / "report.html")


# ---------------------------------------------------------------------- verdict and findings


def predicted(result, log):
    """A changed result with the predictions of its log made again."""
    recorded = log if result.diagnosis is None else log.measured
    dataset = Dataset.of(result.model, recorded, judged_signals(result.model, [recorded], result.settings), given=[log])
    (summary,) = predictions(result.estimate, result.evaluation, dataset)
    logs = (dataclasses.replace(result.logs[0], prediction=summary),)
    return dataclasses.replace(changed(result, logs=logs), predictions=dr.validate(result, log).predictions)


def level_of(result, log, words):
    levels = {str(finding): finding.level for finding in predicted(result, log).findings}
    found = [level for text, level in levels.items() if words in text]
    assert found, levels
    return found[0]


def test_a_noise_free_log_contradicts_nothing(result):
    assert {finding.level for finding in result.findings} == {"good", "note"}
    assert result.verdict == "usable"


def test_the_page_simulates_what_identify_has_simulated(result, diagnosed, log, hit):
    assert predicted(result, log).logs == result.logs
    again, before = predicted(diagnosed, hit).logs[0].prediction, diagnosed.logs[0].prediction
    assert again.unexplained == pytest.approx(before.unexplained, rel=1e-9)
    assert predicted(diagnosed, hit).predictions == diagnosed.predictions


def test_a_violated_bound_is_bad_and_says_which(result, log):
    broken = changed(result, parameters={**result.parameters, "linear_drag": -0.5})
    assert level_of(broken, log, "linear_drag = −0.5 N s/m is outside its bounds (≥ 0)") == "bad"


def test_a_parameter_of_unknown_uncertainty_needs_care(result, log, tmp_path):
    vague = changed(result, covariance=np.full((4, 4), np.inf))
    assert level_of(vague, log, "is unknown: 600 fitted rows are too few") == "care"
    assert "unknown" in Page(written(vague, log, tmp_path)).text


@pytest.mark.parametrize(("change", "level"), [(0.01, "good"), (-0.1, "care"), (0.5, "bad"), (np.nan, "care")])
def test_sensitivity_to_the_filters_bandwidth_is_graded(result, log, change, level):
    shaky = changed(result, bandwidth_sensitivity={"mass": (change, 0.0)})
    assert level_of(shaky, log, "the filter's bandwidth") == level


def test_a_wrong_parameter_shows_in_the_simulation(result, log):
    heavy = changed(result, parameters={**result.parameters, "mass": 400.0})
    assert level_of(heavy, log, "is off by") == "bad"


def test_a_diverging_simulation_is_reported_and_drawn_as_far_as_it_goes(result, log, tmp_path):
    wild = changed(result, parameters={**result.parameters, "quadratic_drag": -1e6}, fit_error=np.inf)
    assert level_of(wild, log, "The simulation diverges (whole log)") == "bad"
    page = Page(written(wild, log, tmp_path))
    assert "∞" in page.text
    assert page.all("path", "line m0")


def test_inlier_fraction_is_graded_and_a_bad_stretch_is_named(result, log):
    mask = np.ones(len(log), dtype=bool)
    mask[300:330] = False
    patchy = changed(result, inliers=mask, inlier_fraction=0.95)
    assert level_of(patchy, log, "95 % of 600 rows agree") == "good"
    assert level_of(patchy, log, "Between 9 and 9.5 s only 0 % of the rows agree") == "care"
    mask[:400] = False
    assert level_of(changed(result, inliers=mask, inlier_fraction=1.0 / 3.0), log, "33 % of 600 rows agree") == "care"


def test_another_log_makes_it_a_held_out_validation_with_inliers_of_its_own(model, result, log, tmp_path):
    other = spiked(dive(model, 500), np.arange(100, 150))
    run = simulate_on("ols", result, other)
    assert run.held_out
    assert not run.inliers[100:150].any()
    assert run.inlier_fraction == pytest.approx(1.0 - 50 / run.observations.n_rows)
    text = Page(written(result, other, tmp_path)).text
    assert "Held-out validation." in text
    assert other.fingerprint in text
    assert "Held-out" not in Page(written(result, log, tmp_path)).text


def test_rows_with_missing_samples_are_counted(model, log):
    gappy = log["x_dot"].copy()
    gappy[50:70] = np.nan
    holed = with_signals(log, x_dot=gappy)
    found = dr.identify(model, holed, "ols")
    assert level_of(found, holed, "20 of 600 rows are excluded") == "note"


def test_stretches_that_are_left_out_are_bands_with_their_reasons(model, log, tmp_path):
    n = len(log)
    rows = np.arange(n)
    held = with_signals(log, diving=np.where((rows < 20) | ((rows > n // 2) & (rows < n // 2 + 40)), 0.0, 1.0))
    kept = dr.keep_while(held, ["diving"])
    text = written(dr.identify(model, kept, "ols"), kept, tmp_path)
    (ends, middle) = kept.history[-1]["left_out"]
    assert middle[0] == pytest.approx(held.time[n // 2 + 1])
    assert f"Left out: {ends[0]:.4g} to {ends[1]:.4g} s (not diving), {middle[0]:.4g} to {middle[1]:.4g} s" in text
    assert 'class="band left-out"' in text
    assert "left out" in text
    assert "Left out" not in written(dr.identify(model, log, "ols"), log, tmp_path)


def test_a_log_of_positions_is_differentiated_as_the_results_was(model, log):
    bare = dr.Log.from_arrays(log.time, {"x": log["x"], "thrust": log["thrust"]}, source="bare")
    found = dr.identify(model, bare, "ols", differentiate=True)
    run = simulate_on("ols", found, bare)
    assert set(run.observations.signals) == {"x", "x_dot", "x_ddot"}
    assert not run.held_out
    inside = slice(20, -20)
    np.testing.assert_allclose(run.observations.column("x_dot")[inside], log["x_dot"][run.rows][inside], atol=0.05)


def test_a_log_that_cannot_be_simulated_is_refused_and_leaves_the_old_page(result, log, tmp_path):
    path = tmp_path / "report.html"
    path.write_text("the old page")
    blind = dr.Log.from_arrays(log.time, {"x": log["x"]}, source="no thrust")
    with pytest.raises(
        dr.ResultError, match=r'"underwater-vehicle" cannot be simulated on this log: no thrust: .*thrust'
    ):
        dr.write_report(result, blind, path)
    assert path.read_text() == "the old page"
    assert list(tmp_path.iterdir()) == [path]


def test_a_page_that_cannot_be_written_is_an_error_that_names_it(result, log, tmp_path):
    with pytest.raises(dr.ResultError, match=r"nowhere.report\.html: cannot be written"):
        dr.write_report(result, log, tmp_path / "nowhere" / "report.html")


# ---------------------------------------------------------------------- several logs


@pytest.fixture(scope="module")
def other(model):
    """A second, shorter dive with fifty outliers."""
    return spiked(dive(model, 500, source="another dive"), np.arange(100, 150))


def test_several_logs_have_a_table_and_a_block_each_of_which_the_first_is_open(result, log, other, tmp_path):
    page = Page(written(result, [log, other], tmp_path))
    assert f"{log.source} 11.98 50 600 100 % {number(result.fit_error)} another dive" in page.text
    assert "another dive 9.98 50 500 90 % – held out" in page.text
    assert ["open" in a for a in page.all("details")] == [True, False]
    labels = [a["aria-label"] for a in page.all("svg")]
    assert sum(label.startswith("x_dot in ") for label in labels) == 2
    assert f"Identified by ols from {log.source}; held-out validation on another dive (21.96 s in all, 1,100 rows)" in (
        page.text
    )
    assert other.fingerprint in page.text


def test_a_single_log_in_a_list_gives_the_page_of_the_log(result, log, tmp_path):
    assert written(result, [log], tmp_path) == written(result, log, tmp_path)


def test_findings_over_several_logs_are_on_the_worst_one_and_on_all_rows(model, log):
    other = spiked(dive(model, 500, source="another dive"), np.arange(100, 150), 20.0)
    result = dr.identify(
        model, [log, other], dr.IDiransac(dr.Settings(max_iterations=50, sample_size=10)), compare_logs=False
    )
    assert any("95 % of 1,100 rows agree" in text for text in result.findings)
    assert any("s of another dive only 0 % of the rows agree" in text for text in result.findings)
    assert any("the prediction of" in text for text in result.findings)


def test_findings_on_a_held_out_log_join_those_of_the_result(result, log, other, tmp_path):
    page = Page(written(result, [log, other], tmp_path))
    held_out, own = page.text.partition("Held out, another dive")[2].split(f"Identification from {log.source}", 1)
    assert "Over the whole log the prediction of x_dot is off by" in held_out
    of_predictions = [x for x in result.findings if "predicted" in x or "prediction" in x]
    good = [x for x in result.findings if x.level == "good"]
    assert all((str(x) in own) == (x not in of_predictions) for x in good), page.text  # held-out ones replace them
    assert f"</span> {dr.validate(result, other).verdict}</h3>" in (tmp_path / "report.html").read_text()
    assert "Held out" not in Page(written(result, log, tmp_path)).text


def test_parts_of_one_log_are_told_apart_by_their_times(model, tmp_path):
    log = dive(model, 900)
    result = dr.identify(model, log.between(3.0, 10.0), method="ols")
    page = Page(written(result, log.between(10.0, 17.0), tmp_path))
    assert f"evaluated on {log.source} from 10 to 17 s, not used for identification" in page.text
    assert f"Identification from {log.source} from 3 to 10 s" in page.text


def test_a_model_that_fails_on_a_held_out_log_is_not_to_be_relied_on(model, result, tmp_path):
    truth = dive(model, 500)
    wrong = with_signals(truth, thrust=-truth["thrust"])
    assert result.verdict == "usable"
    assert "ols do not rely on this" in Page(written(result, wrong, tmp_path)).text


def test_logs_of_one_name_are_numbered(result, log, tmp_path):
    page = Page(written(result, [log, log], tmp_path))
    assert f"{log.source} #2" in page.text


@pytest.mark.parametrize(("logs", "found"), [([], "found none"), (["dive.csv"], "found a str"), (None, "found a None")])
def test_what_is_not_a_log_is_refused(result, logs, found, tmp_path):
    with pytest.raises(dr.ResultError, match=rf"a report shows logs; {found}"):
        dr.write_report(result, logs, tmp_path / "report.html")


# ---------------------------------------------------------------------- what a diagnosis adds


HIT = np.arange(10, 600, 37)


@pytest.fixture(scope="module")
def hit(log):
    """A log whose velocity alone has outliers."""
    speed = log["x_dot"].copy()
    speed[HIT] += 30.0
    return with_signals(log, x_dot=speed)


@pytest.fixture(scope="module")
def diagnosed(model, hit):
    return dr.identify(model, hit, seed=0)


def figure_of(page, name):
    """Paths of the figure of a signal, as (name that is read, attributes)."""
    begin = next(i for i, (n, a) in enumerate(page.elements) if n == "svg" and a["aria-label"].startswith(f"{name} in"))
    paths = []
    for element, attributes in page.elements[begin + 1 :]:
        if element == "svg":
            return paths
        if element == "path" and "data-name" in attributes:
            paths.append((attributes["data-name"], attributes))
    return paths


def test_noise_outliers_and_unmodelled_accelerations_stand_in_a_table_with_units(diagnosed, hit, tmp_path):
    page = Page(written(diagnosed, hit, tmp_path))
    found = diagnosed.diagnosis
    share = percent(found.outlier_fraction["x_dot"])
    assert f"x_dot m/s {number(found.noise_std['x_dot'], 2)} {share}" in page.text
    left = np.sqrt(np.mean(found.unmodelled_accelerations["x_ddot"] ** 2))
    assert f" {number(left, 2)} Unmodelled generalised forces" in page.text
    assert any(a["aria-label"] == "Unmodelled force on x in N" for a in page.all("svg"))
    assert page.all("section")[2]["id"] == "diagnosis"


def test_a_page_without_a_diagnosis_has_no_such_section_and_starts_at_the_first_row(result, log, tmp_path):
    page = Page(written(result, log, tmp_path))
    assert "diagnosis" not in [a["id"] for a in page.all("section")]
    assert "starts from a state that is estimated with the model, from the first samples" in page.text
    assert not page.all("path", "long")


def test_outliers_are_marked_in_their_own_signal_and_apart_from_rows_that_disagree(diagnosed, hit, tmp_path):
    mask = np.ones(len(hit), dtype=bool)
    mask[[7, 300]] = False
    page = Page(written(changed(diagnosed, inliers=mask), hit, tmp_path))
    speed, place = dict(figure_of(page, "x_dot")), dict(figure_of(page, "x"))
    assert set(HIT) <= set(vertices(speed["measured (outlier)"]["d"])[:, 0].tolist())
    assert speed["measured (outlier)"]["class"].split() == ["trace", "dots", "fault"]
    if "measured (outlier)" in place:
        assert not set(HIT) & set(vertices(place["measured (outlier)"]["d"])[:, 0].tolist())
    assert vertices(place["measured (row disagrees)"]["d"])[:, 0].tolist() == [7, 300]
    assert set(HIT).isdisjoint(vertices(speed["measured"]["d"])[:, 0].tolist())


def test_simulations_restart_after_the_judged_horizon_from_estimated_states(model, log, tmp_path):
    t = log.time - log.time[0]
    pushed = with_signals(log, thrust=log["thrust"] - 3.0 * np.sin(0.2 * t) ** 2)  # a part of the force is not logged
    found = dr.identify(model, pushed, seed=0)
    page = tmp_path / "report.html"
    dr.write_report(found, pushed, page, horizon=1.0)
    run = simulate_on("it", found, pushed, horizon=1.0)
    assert run.restart_period == 1.0
    begin, end = 50, 100
    batch = RolloutBatch(
        [list(found.parameters.values())], run.simulated[begin, :2], pushed["thrust"][begin:end, None], pushed.dt
    )
    expected = rollouts(model, substeps=found.estimate.resolution.substeps).trajectories(batch)[0]
    np.testing.assert_allclose(run.simulated[begin:end], expected, rtol=1e-12)
    np.testing.assert_allclose(run.simulated[begin, :2], run.observations.measured[begin, :2], atol=0.05)
    drift = np.abs(run.open_loop - run.observations.measured).max(axis=0)
    assert (np.nanmax(np.abs(run.errors), axis=0)[:2] < drift[:2]).all()
    page = Page(page.read_text(encoding="utf-8"))
    assert "restarts every 1 s" in page.text
    assert [a for name, a in figure_of(page, "x") if name == "whole-log simulation"]


def test_every_method_restarts_at_the_same_times(diagnosed, model, hit, tmp_path):
    ols = dr.identify(model, hit, "ols")
    page = Page(written([ols, diagnosed], hit, tmp_path))
    assert [a["id"] for a in page.all("section")].count("diagnosis") == 1
    assert not page.all("path", "long")
    names = [name for name, _ in figure_of(page, "x")]
    assert "ols" in names
    assert "lo-diransac" in names
    runs = [simulate_on("", result, hit, horizon=1.0) for result in (ols, diagnosed)]
    assert [run.restart_period for run in runs] == [1.0, 1.0]
    assert [run.screened for run in runs] == [False, True]


def test_a_held_out_log_is_not_assessed_by_another_logs_diagnosis(diagnosed, model, tmp_path):
    other = dive(model, 500, source="another dive")
    page = Page(written(diagnosed, other, tmp_path))
    assert "Held-out validation" in page.text
    assert not page.all("path", "fault")
    assert not any("Unmodelled" in a["aria-label"] for a in page.all("svg"))


def test_an_unidentifiable_parameter_has_no_number(diagnosed, hit, tmp_path):
    covariance = diagnosed.covariance.copy()
    covariance[3] = covariance[:, 3] = np.inf
    vague = changed(
        diagnosed,
        covariance=covariance,
        parameters={**diagnosed.parameters, "bias": 123.456},
        diagnosis=dataclasses.replace(diagnosed.diagnosis, unidentifiable=("bias",)),
    )
    page = Page(written([vague, dr.identify(vague.model, hit, "ols")], hit, tmp_path))
    assert "bias N lo-diransac not identifiable ols" in page.text
    assert "bias is not identifiable from this log; excite it." in page.text
    assert "123.4" not in page.text
    alone = Page(written(vague, hit, tmp_path))
    assert "bias N lo-diransac not identifiable" in alone.text


def test_an_input_delay_is_reported_and_the_simulation_includes_it(model, log, tmp_path):
    late = with_signals(log, thrust=np.r_[log["thrust"][4:], np.full(4, log["thrust"][-1])])
    found = dr.identify(model, late, seed=0)
    assert level_of(found, late, "Inputs act 80 ms later than recorded, which the estimate includes") == "care"
    assert "The estimate and the simulations shown include it." in Page(written(found, late, tmp_path)).text
    run = simulate_on("it", found, late)
    assert run.median_errors["x_dot"] < 0.01 * np.ptp(log["x_dot"])


def test_positions_alone_are_simulated_from_the_smoothed_states(model, log, tmp_path):
    bare = dr.Log.from_arrays(log.time, {"x": log["x"], "thrust": log["thrust"]}, source="bare")
    found = dr.identify(model, bare)
    page = Page(written(found, bare, tmp_path))
    assert "x_ddot m/s^2 not measured" in page.text
    assert "method lo-diransac" in page.text


@pytest.mark.parametrize(("size", "level"), [(0.0, "good"), (0.2, "care"), (2.0, "care")])
def test_the_unexplained_share_of_an_acceleration_is_graded_but_predictions_decide(diagnosed, hit, size, level):
    """Forces that no prediction shows, as those of vibration, need care at worst."""
    left = size * np.sqrt(np.mean(hit["x_ddot"] ** 2))
    latent = {"x_ddot": diagnosed.diagnosis.unmodelled_accelerations["x_ddot"] + left}
    pushed = changed(diagnosed, diagnosis=dataclasses.replace(diagnosed.diagnosis, unmodelled_accelerations=latent))
    assert (
        level_of(
            pushed, hit, f"The model leaves {percent(size / (1.0 + size))} of x_ddot" if size else "The model leaves"
        )
        == level
    )


# ---------------------------------------------------------------------- safe to open


def test_page_loads_nothing_and_runs_its_own_script_alone(result, log, tmp_path):
    text = written(result, log, tmp_path)
    page = Page(text)
    policy = next(a["content"] for a in page.all("meta") if a.get("http-equiv") == "Content-Security-Policy")
    script = re.search(r"<script>(.*)</script>", text, re.DOTALL).group(1)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert policy == f"default-src 'none'; style-src 'unsafe-inline'; script-src 'sha256-{digest}'"
    assert not re.search(r"https?:|src=|@import|url\(", text)


def test_hostile_names_stay_text(model, log, tmp_path):
    named = dr.Model(
        HOSTILE, model.coordinates, model.inputs, model.parameters, _vehicle, description=HOSTILE + "description"
    )
    hostile = dataclasses.replace(log, source=HOSTILE, notes=(HOSTILE,))
    found = dr.identify(named, hostile, "ols")
    steps = ({"step": HOSTILE, HOSTILE: [HOSTILE, {HOSTILE: None}]},)
    summaries = (dataclasses.replace(found.logs[0], preparation=steps, remark=HOSTILE),)
    found = changed(
        found, notes=(HOSTILE,), stop_reason=HOSTILE, logs=summaries, rejected={HOSTILE: 1}, estimator=HOSTILE
    )
    page = Page(written({HOSTILE: found}, hostile, tmp_path))
    assert len(page.all("script")) == 1
    assert not page.all("img")
    assert not any(key.startswith("on") for _, attributes in page.elements for key in attributes)
    assert page.text.count("alert(1)") >= 10


def test_hostile_names_stay_text_on_a_page_of_several_logs(result, log, tmp_path):
    hostile = dataclasses.replace(log, source=HOSTILE)
    page = Page(written({HOSTILE: result}, [log, hostile, dive(result.model, 300, source=HOSTILE)], tmp_path))
    assert len(page.all("script")) == 1
    assert not page.all("img")
    assert page.text.count("alert(1)") >= 10


def _vehicle(q, v, a, u, p):
    return [p.mass * a.x + p.linear_drag * v.x + p.quadratic_drag * v.x * abs(v.x) + p.bias - u.thrust]


def test_an_undecodable_file_name_is_written_with_replacements(result, log, tmp_path):
    odd = changed(result, logs=(dataclasses.replace(result.logs[0], source="dive\udcff.csv"),))
    assert "dive?.csv" in written(odd, log, tmp_path)


@given(st.text(), st.text())
def test_templates_give_back_exactly_the_text_and_attribute_that_went_in(text, value):
    elements, words = [], []
    parser = HTMLParser()
    parser.handle_starttag = lambda name, attributes: elements.append((name, dict(attributes)))
    parser.handle_data = words.append
    template = rendering.environment().from_string('<p title="{{ value }}">{{ text }}</p>')
    parser.feed(rendering.encodable(template.render(text=text, value=value)))
    parser.close()
    kept = text.encode(errors="replace").decode()
    assert elements == [("p", {"title": value.encode(errors="replace").decode()})]
    assert "".join(words) == kept


def test_templates_refuse_undefined_names():
    with pytest.raises(UndefinedError, match="nothing"):
        rendering.environment().from_string("{{ nothing }}").render()


def test_jinja_is_imported_only_when_a_page_is_written(log, tmp_path):
    log.write(tmp_path / "dive.csv")
    words = ["identify", str(tmp_path / "dive.csv"), "--model", "underwater-vehicle", "--method", "ols"]
    code = f"""
import sys
import diransac
from diransac.cli import main

def ran(*words):
    sys.argv = ["diransac", *words]
    try:
        main()
    except SystemExit as done:
        return not done.code

assert ran(*{words})
assert diransac.write_report
assert "jinja2" not in sys.modules
assert ran(*{words}, "--report", {str(tmp_path / "page.html")!r})
assert "jinja2" in sys.modules
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


# ---------------------------------------------------------------------- figures that hide nothing


@pytest.mark.parametrize("kind", ["line", "dots"])
def test_a_long_signal_keeps_every_stretchs_extremes_and_draws_samples_alone(kind):
    rng = np.random.default_rng(0)
    values = rng.normal(size=25_000)
    rows, scale, timeline = np.arange(25_000), figures.Scale(-5.0, 5.0), figures.Timeline(25_000, 0.0, 0.01)
    drawn = vertices(figures.path_data(figures.Trace("noise", "m0", kind, rows, values), scale, timeline))
    assert len(drawn) <= 2_200
    np.testing.assert_array_equal(drawn[:, 1], scale.height(values)[drawn[:, 0]])
    assert {int(values.argmin()), int(values.argmax())} <= set(drawn[:, 0].tolist())
    for begin in range(0, 25_000, 250):
        inside = drawn[(drawn[:, 0] >= begin) & (drawn[:, 0] < begin + 250), 1]
        stretch = scale.height(values[begin : begin + 250])
        assert (inside.min(), inside.max()) == (stretch.min(), stretch.max())


def test_a_short_signal_is_drawn_whole_and_a_line_breaks_where_samples_are_missing():
    values = np.array([0.0, 1.0, np.nan, 3.0, 4.0])
    trace = figures.Trace("x", "m0", "line", np.arange(5), values)
    path = figures.path_data(trace, figures.Scale(0.0, 4.0), figures.Timeline(5, 0.0, 0.1))
    assert path == "M0 1000h0l1-250m2-500h0l1-250"


def test_extremes_are_each_cells_smallest_and_largest():
    values, cells = np.array([3.0, 1.0, 2.0, 5.0, 5.0, 9.0]), np.array([0, 0, 0, 1, 1, 2])
    assert figures.extremes(values, cells).tolist() == [0, 1, 3, 4, 5]


def test_an_outlier_of_eighty_does_not_set_the_range_and_is_counted(result, log, tmp_path):
    rows = np.arange(10, 600, 37)
    hit = spiked(log, rows)
    page = Page(written(result, hit, tmp_path))
    shown = next(a for a in page.all("svg") if a["aria-label"].startswith("x_dot in"))
    assert float(shown["data-high"]) < 3.0 * log["x_dot"].max()
    assert "data-full" in shown
    assert f"{len(rows)} samples outside of this range, from" in page.text


def test_a_rare_manoeuvre_that_the_simulation_follows_is_in_range(model):
    t = np.arange(2000) * 0.02
    thrust = np.where((t > 30.0) & (t < 31.0), 400.0, np.sin(t))
    batch = RolloutBatch([list(PARAMETERS.values())], np.zeros(2), thrust[:, None], 0.02)
    flown = rollouts(model).trajectories(batch)[0]
    log = dr.Log.from_arrays(t, {**dict(zip(model.signals, flown.T, strict=True)), "thrust": thrust})
    low, high = simulate_on("ols", dr.identify(model, log, "ols"), log).ranges["x_ddot"]
    assert (low, high) == (log["x_ddot"].min(), log["x_ddot"].max())
    assert bulk_range(log["x_ddot"])[1] < 0.2 * high


def test_outliers_are_marked_at_the_rows_that_are_no_inliers(result, log, tmp_path):
    mask = np.ones(len(log), dtype=bool)
    mask[[7, 300, 301]] = False
    page = Page(written(changed(result, inliers=mask), log, tmp_path))
    marked = page.all("path", "dots outlier")
    assert marked
    assert all(vertices(a["d"])[:, 0].tolist() == [7, 300, 301] for a in marked)


def test_a_log_of_25_000_rows_stays_light(model, tmp_path):
    long = dive(model, 25_000, 0.001)
    assert len(written(dr.identify(model, long, "ols"), long, tmp_path)) < 250_000


@given(st.floats(-1e6, 1e6), st.floats(1e-9, 1e9))
def test_ticks_are_round_distinct_and_within_the_range(low, width):
    width = max(width, 1e-6 * abs(low))
    found = figures.ticks(low, low + width)
    assert 2 <= len(found) <= 7
    assert all(low - 1e-6 * width <= x <= low + 1.000001 * width for x, _ in found)
    assert len({text for _, text in found}) == len(found)


def test_numbers_are_printed_as_a_reader_expects_them():
    assert [number(x) for x in (-1.5, 1.2e-6, np.inf, np.nan)] == ["−1.5", "1.2×10⁻⁶", "∞", "–"]
    assert [percent(x) for x in (0.0042, 0.131, 0.996, 0.9999, 1.0, 1e-6, -1e-6)] == [
        "0.42 %",
        "13 %",
        "99.6 %",
        "99.9 %",
        "100 %",
        "< 0.01 %",
        "> −0.01 %",
    ]
    assert share(0.02, "its range") == "2 % of its range"
    assert share(19.3, "its range") == "19 times its range"
