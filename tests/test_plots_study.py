"""Pictures and pages of studies: what is averaged and what is counted, that failures show, and files that repeat."""

import io
import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.colors import to_hex

from command_line import contents, run
from diransac.errors import SettingsError, StudyError
from diransac.plots.figure import PAPER, REFERENCE
from diransac.plots.paths import levels_with_paths, plot_paths
from diransac.plots.study import method_looks, plot_study
from diransac.report.stores import write_study_report
from diransac.study import load
from diransac.study.store import Store
from diransac.study.summary import summarise
from studies import row, tiny

STATES = ("x", "z", "theta", "x_dot", "z_dot", "theta_dot")
LEVELS, METHODS, N_TRIALS = ("0", "40"), ("true", "ols", "quick"), 5
# Tracking errors of one method at one level, of which the last two trials have none.
SPOILT = np.array([0.1, 0.4, 0.7])
CIRCLE = np.column_stack([f(np.linspace(0.0, 6.28, 90)) for f in (np.sin, np.cos, np.zeros_like)]).astype(np.float32)


def packed(**flown: np.ndarray) -> bytes:
    memory = io.BytesIO()
    np.savez_compressed(memory, **flown)
    return memory.getvalue()


def errors(size: float) -> dict[str, float]:
    return {f"square_{state}": size * (1 + k) for k, state in enumerate(STATES)}


def made_up(level: str, method: str, trial: int) -> dict:
    """A row: `ols` fails twice at level 40, all its figures at level 0 are equal."""
    if method == "ols" and level == "40" and trial >= len(SPOILT):
        return row(level, trial, method, status="failed", error="square: no plan <was> found")
    size = {"true": 0.001, "quick": 0.01 * (1 + trial)}.get(method, 0.2 if level == "0" else SPOILT[trial % 3])
    return row(level, trial, method, **errors(size))


@pytest.fixture
def store(tmp_path: Path) -> Path:
    with Store(tmp_path / "a.db", load(tiny(trials=N_TRIALS))) as kept:
        kept.add([made_up(level, m, trial) for level in LEVELS for m in METHODS for trial in range(N_TRIALS)])
    return tmp_path / "a.db"


@pytest.fixture
def store_with_paths(tmp_path: Path) -> Path:
    """Five circles a method; of `ols` one wanders off, and the last trial failed."""
    study = load(tiny(trials=N_TRIALS, evaluation__keep_paths=True, axis__levels=[40]))
    with Store(tmp_path / "p.db", study) as kept:
        for method in METHODS:
            for trial in range(N_TRIALS):
                if (method, trial) == ("ols", 4):
                    kept.add([row("40", trial, method, status="failed", error="square: no plan")])
                    continue
                flown = CIRCLE * (9.0 if (method, trial) == ("ols", 0) else 1.0)
                kept.add([row("40", trial, method, **errors(0.1), paths=packed(square=flown))])
    return tmp_path / "p.db"


def panel(figure, name):
    return next(axes for axes in figure.axes if axes.get_title(loc="left") == name)


def texts(figure):
    return [text.get_text() for text in figure.texts]


def marks(axes, method):
    """Height of every mean that is drawn, and whether it is hollow."""
    colour, marker = (method_looks(METHODS)[method][key] for key in ("color", "marker"))
    return {
        round(float(y), 9): to_hex(line.get_markerfacecolor()) == PAPER
        for line in axes.lines
        if line.get_marker() == marker and to_hex(line.get_color()) == colour
        for y in line.get_ydata()
    }


# ---------------------------------------------------------------------- what is counted


def test_a_mean_is_over_the_flights_and_a_median_over_all_trials(store: Path):
    flights = summarise(store).flights["square"]
    i, k = LEVELS.index("40"), METHODS.index("ols")
    assert flights.mean("x")[i, k] == pytest.approx(0.4)
    assert flights.deviation("x")[i, k] == pytest.approx(0.3)
    assert flights.median("x")[i, k] == pytest.approx(0.7)  # of 0.1, 0.4, 0.7, infinity, infinity
    assert flights.failure_share[i, k] == pytest.approx(2 / 5)
    assert flights.failure_share.sum() == pytest.approx(2 / 5)


def test_equal_errors_have_no_deviation_at_all(store: Path):
    assert summarise(store).flights["square"].deviation("z")[0, METHODS.index("ols")] == 0.0


def test_an_infinite_error_that_a_damaged_store_holds_is_an_infinite_deviation(tmp_path: Path):
    with Store(tmp_path / "b.db", load(tiny(trials=2))) as kept:
        kept.add([row("0", trial, "ols", **errors(x)) for trial, x in enumerate((0.1, np.inf))])
    flights = summarise(tmp_path / "b.db").flights["square"]
    assert np.isinf(flights.deviation("x")[0, METHODS.index("ols")])
    plot_study(tmp_path / "b.db", tmp_path / "b.svg")


def test_where_most_trials_failed_there_is_no_finite_median_and_where_all_did_no_mean(tmp_path: Path):
    with Store(tmp_path / "b.db", load(tiny(trials=3))) as kept:
        failed = [row("0", trial, "ols", status="failed", error="no") for trial in range(3)]
        mostly = [row("40", trial, "ols", status="failed", error="no") for trial in (0, 2)]
        kept.add([*failed, *mostly, row("40", 1, "ols", **errors(0.3))])
    flights, k = summarise(tmp_path / "b.db").flights["square"], METHODS.index("ols")
    assert np.isnan(flights.mean("x")[0, k])
    assert flights.mean("x")[1, k] == pytest.approx(0.3)
    assert np.isinf(flights.median("x")[:, k]).all()
    assert np.isnan(flights.deviation("x")[1, k])
    assert np.isnan(flights.failure_share[:, METHODS.index("quick")]).all(), "what was not run has not failed"


def test_levels_are_in_the_order_of_their_numbers_however_they_were_asked_for(tmp_path: Path):
    with Store(tmp_path / "c.db", load(tiny(axis__levels=[100, 9]))) as kept:
        kept.add([row("100", 0, "true", **errors(1.0)), row("9", 0, "true", **errors(2.0))])
    summary = summarise(tmp_path / "c.db")
    assert summary.levels == ("9", "100")
    assert summary.flights["square"].mean("x")[:, 0].tolist() == [2.0, 1.0]


# ---------------------------------------------------------------------- what is drawn


def test_every_state_has_a_panel_with_the_mean_of_every_method(store: Path):
    figure, summary = plot_study(store), summarise(store)
    flights = summary.flights["square"]
    for state in STATES:
        axes = panel(figure, state)
        assert axes.get_title(loc="right") == summary.units[state]
        for method in ("ols", "quick"):
            means = {round(float(y), 9) for y in flights.mean(state)[:, METHODS.index(method)]}
            assert set(marks(axes, method)) == means
        (true,) = [line for line in axes.lines if to_hex(line.get_color()) == REFERENCE]
        assert np.array_equal(true.get_ydata(), flights.mean(state)[:, 0])


def test_bars_are_one_standard_deviation_and_end_at_zero(store: Path):
    axes = panel(plot_study(store), "x")
    ends = np.sort([segment[:, 1] for one in axes.collections for segment in one.get_segments()], axis=1)
    assert any(np.allclose(end, (0.1, 0.7)) for end in ends), "0.4 and 0.3 to either side"
    assert (ends >= 0.0).all()


def test_a_mean_that_leaves_trials_out_is_hollow_and_their_share_is_written(store: Path):
    figure = plot_study(store)
    assert marks(panel(figure, "x"), "ols") == {0.2: False, 0.4: True}
    assert set(marks(panel(figure, "x"), "quick").values()) == {False}
    assert "Trials that failed, %" in texts(figure)
    table = figure.axes[-1]
    assert [text.get_text() for text in table.texts] == ["40"], "per cent of the trials"
    assert table.texts[0].get_position()[0] == [text.get_text() for text in table.get_xticklabels()].index("40")
    assert "quick" not in texts(figure), "a method that never failed has no row"


def test_a_study_without_failures_says_so(store_with_paths: Path, tmp_path: Path):
    with Store(tmp_path / "d.db", load(tiny(trials=1))) as kept:
        kept.add([row(level, 0, method, **errors(0.1)) for level in LEVELS for method in METHODS])
    assert "No trial failed." in texts(plot_study(tmp_path / "d.db"))


def test_errors_of_other_orders_of_magnitude_are_told_apart(tmp_path: Path):
    sizes = {"true": 0.001, "quick": 0.01, "ols": 90.0}
    with Store(tmp_path / "e.db", load(tiny(trials=1))) as kept:
        kept.add([row(level, 0, method, **errors(sizes[method])) for level in LEVELS for method in METHODS])
    axes = panel(plot_study(tmp_path / "e.db"), "x")
    low, high, of_quick, of_ols = axes.transData.transform([(0, y) for y in (*axes.get_ylim(), 0.01, 90.0)])[:, 1]
    assert 0.02 < (of_quick - low) / (high - low) < 0.5 < (of_ols - low) / (high - low) < 1.0
    labels = [text.get_text() for text in axes.get_yticklabels()]
    assert "0" in labels
    assert {"0.1", "1", "10"} & set(labels)
    assert not [text for text in labels if "$" in text]  # figures are written without formulas


def test_a_median_above_every_mean_is_within_its_panel(tmp_path: Path):
    """Two of five failed: the median is the largest error of the other three."""
    with Store(tmp_path / "f.db", load(tiny(trials=5))) as kept:
        failed = [row("0", trial, "ols", status="failed", error="no") for trial in (0, 1)]
        kept.add(
            [*failed, *(row("0", trial, "ols", **errors(size)) for trial, size in ((2, 0.1), (3, 0.2), (4, 60.0)))]
        )
        kept.add([row("40", 0, "quick", **errors(0.01))])
    axes = panel(plot_study(tmp_path / "f.db"), "x")
    dashes = [y for line in axes.lines if line.get_marker() == "_" for y in line.get_ydata()]  # of bars' ends, too
    assert max(dashes) == 60.0
    assert axes.get_ylim()[1] > 60.0


def test_what_is_missing_of_a_study_is_said_below_its_pictures_and_on_its_page(
    store: Path, store_with_paths: Path, tmp_path: Path
):
    with Store(tmp_path / "half.db", load(tiny(trials=4))) as kept:
        kept.add([row("0", trial, "ols", **errors(0.1)) for trial in range(3)])
    with Store(store_with_paths, load(tiny(trials=6, evaluation__keep_paths=True, axis__levels=[40]))):
        pass
    write_study_report(tmp_path / "half.db", tmp_path / "half.html")
    write_study_report(store, tmp_path / "whole.html")
    assert "21 of 24 rows are missing." in texts(plot_study(tmp_path / "half.db"))
    assert texts(plot_paths(store_with_paths))[-1].endswith(". 3 of 18 rows are missing.")
    assert "<p>21 of 24 rows are missing.</p>" in (tmp_path / "half.html").read_text()
    assert not [text for text in texts(plot_study(store)) if "missing" in text]
    assert "missing" not in (tmp_path / "whole.html").read_text()


def test_paths_are_drawn_for_every_trial_that_has_one(store_with_paths: Path):
    figure = plot_paths(store_with_paths)
    assert len(figure.axes) == len(METHODS)
    drawn = [sum(len(one.get_segments()) for one in axes.collections) for axes in figure.axes]
    assert drawn == [0, 4, 5], "what the true parameters fly is the broad line below"
    for axes in figure.axes:
        assert axes.get_xlim()[0] < -1.0 < 1.0 < axes.get_xlim()[1]
        assert axes.get_xlim()[1] < 3.0, "a flight that wanders off leaves the others readable"
    assert "1 of 5 leave the panel\n1 of 5 failed" in texts(figure)


def test_the_reference_of_each_method_is_dashed_beside_its_flights(store_with_paths: Path):
    study = load(tiny(trials=N_TRIALS + 1, evaluation__keep_paths=True, axis__levels=[40]))
    with Store(store_with_paths, study) as kept:
        found = packed(square=CIRCLE, **{"square planned": CIRCLE * 1.2})
        kept.add([row("40", N_TRIALS, "ols", **errors(0.1), paths=found)])
    figure = plot_paths(store_with_paths)
    dashed = [one for axes in figure.axes for one in axes.collections if one.get_linestyle()[0][1] is not None]
    (reference,) = [segment for one in dashed for segment in one.get_segments()]
    assert np.abs(reference).max() == pytest.approx(1.2 * np.abs(CIRCLE[:, :2]).max(), rel=1e-2)
    assert "reference of the method" in [text.get_text() for text in figure.legends[0].get_texts()]


def test_paths_have_x_and_z_to_one_scale(store_with_paths: Path):
    figure = plot_paths(store_with_paths)
    figure.draw_without_rendering()
    origin, right, up = figure.axes[0].transData.transform([(0, 0), (1, 0), (0, 1)])
    assert right[0] - origin[0] == pytest.approx(up[1] - origin[1], rel=1e-6)


def test_methods_look_different(store: Path):
    looks = method_looks(["true", *(f"m{i}" for i in range(6))])
    assert len({(look["color"], look.get("marker")) for look in looks.values()}) == 7
    assert len({look["color"] for look in looks.values()}) == 7


# ---------------------------------------------------------------------- files


@pytest.mark.parametrize("draw", [plot_study, plot_paths])
def test_what_cannot_be_drawn_leaves_the_folder_as_it_was(draw, store: Path, tmp_path: Path):
    before = contents(tmp_path)
    with pytest.raises(SettingsError, match=r"\.png, \.svg, \.pdf"):
        draw(store, tmp_path / "a.jpg")
    with pytest.raises(StudyError, match="does not exist"):
        draw(tmp_path / "no.db", tmp_path / "a.png")
    assert contents(tmp_path) == before


def test_a_store_without_rows_or_paths_says_what_to_do(store: Path, tmp_path: Path):
    Store(tmp_path / "empty.db", load(tiny())).__exit__(None, None, None)
    with pytest.raises(StudyError, match="no rows yet; run its study"):
        plot_study(tmp_path / "empty.db")
    with pytest.raises(SettingsError, match="keep_paths = true"):
        plot_paths(store)


def test_of_several_levels_with_paths_one_is_named(store_with_paths: Path):
    with Store(store_with_paths, load(tiny(trials=1, evaluation__keep_paths=True, axis__levels=[60]))) as kept:
        kept.add([row("60", 0, "ols", **errors(0.1), paths=packed(square=CIRCLE))])
    assert levels_with_paths(store_with_paths) == ["40", "60"]
    with pytest.raises(SettingsError, match="several levels; name one of 40, 60"):
        plot_paths(store_with_paths)
    with pytest.raises(SettingsError, match='no paths at level "7"; name one of 40, 60'):
        plot_paths(store_with_paths, level="7")
    assert len(plot_paths(store_with_paths, level="60").axes[1].collections[0].get_segments()) == 1


# ---------------------------------------------------------------------- page and commands


def test_the_page_holds_figures_numbers_and_failures_and_loads_nothing(store_with_paths: Path, tmp_path: Path):
    page = tmp_path / "page.html"
    write_study_report(store_with_paths, page)
    text = page.read_text()
    assert text.count("<svg") == 2, "errors and paths"
    for figure in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        ElementTree.fromstring(figure)
    assert "default-src &#39;none&#39;" in text
    assert "<script" not in text
    assert not re.findall(r'(?:src|href)="(?!#)', text), "only references into the page"
    assert "Over all levels and trajectories" in text
    again = tmp_path / "again.html"
    write_study_report(store_with_paths, again)
    assert again.read_text() == text


def test_the_page_escapes_what_a_store_says(store: Path, tmp_path: Path):
    write_study_report(store, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    assert "no plan &lt;was&gt; found" in text
    assert "<was>" not in text


def test_the_command_draws_errors_over_an_axis_and_paths_at_a_single_level_and_the_same_file_again(
    store: Path, store_with_paths: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """Files of the other kinds are written by the function that `test_plots` writes them with."""
    monkeypatch.chdir(tmp_path)
    for source, draw, options in (
        (store, plot_study, [[]]),
        (store_with_paths, plot_paths, [[], ["--paths", "--level", "40"]]),
        (store_with_paths, plot_study, [["--errors"]]),
    ):
        draw(source, "wanted.svg")
        assert len(Path("wanted.svg").read_bytes()) > 5000
        for words in options:
            assert run("study", "plot", source, "-o", "found.svg", *words).exit_code == 0
            assert Path("found.svg").read_bytes() == Path("wanted.svg").read_bytes(), words
    assert run("study", "plot", store, "-o", "a.png", "--errors", "--level", "40").exit_code == 2


def test_the_command_writes_the_page_and_never_over_the_store(store: Path, tmp_path: Path):
    assert run("study", "report", store, "-o", tmp_path / "page.html").exit_code == 0
    assert (tmp_path / "page.html").read_text().startswith("<!DOCTYPE html>")
    before = contents(tmp_path)
    for words in (("report", store, "-o", store), ("plot", store, "-o", store), ("plot", store, "-o", "a.jpg")):
        assert run("study", *words).exit_code == 1
    assert contents(tmp_path) == before


def test_the_command_takes_a_title_of_ones_own(store: Path, tmp_path: Path):
    assert run("study", "plot", store, "-o", tmp_path / "a.svg", "--title", "As printed").exit_code == 0
    plot_study(store, tmp_path / "b.svg", title="As printed")
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
