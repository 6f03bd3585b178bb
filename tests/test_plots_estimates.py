"""Pictures and pages of studies that judge parameters, or whose levels are words."""

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
from matplotlib.colors import to_hex

from command_line import run
from diransac.errors import SettingsError
from diransac.plots.estimates import LogAxis, MarkRow, plot_estimates
from diransac.plots.figure import PAPER
from diransac.plots.study import method_looks, plot_study
from diransac.report.stores import write_study_report
from diransac.study import load
from diransac.study.store import Store
from diransac.study.summary import summarise
from studies import row, tiny

METHODS = ("true", "ols", "quick")
OWN = {"mass": 0.249, "inertia": 0.004, "drag": 0.025}
WORDS = [*(f"scenario {k}" for k in range(6)), "a scenario with a name of forty-odd letters"]
JUDGED = tiny(
    plant={"kind": "extended-rotorcraft"},
    evaluation={"trajectories": [], "parameters": True},
    trials=3,
    axis={"name": "scenario", "levels": {"clean": {}, "pushed": {"plant.aerodynamic_imbalance": 1.4e-6}}},
)


def judged(level: str, trial: int, method: str, error: float | None, best_mass: float = 0.249) -> dict:
    """A row in which the mass is off by that share of the best; None: nothing was found."""
    best = {f"pseudo_true_{name}": x for name, x in {**OWN, "mass": best_mass}.items()}
    if error is None:
        return row(level, trial, method, status="failed", error="nothing <was> found", **best)
    mass = best_mass * (1 + error)
    found = {f"parameter_{name}": x for name, x in {**OWN, "mass": mass}.items()}
    return row(level, trial, method, **best, **found, low_mass=mass - 0.01, high_mass=mass + 0.01)


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """`ols` is 1, 2, 40 % off and `quick` mostly without an estimate; where it is pushed, the best mass is 0.2 kg."""
    with Store(tmp_path / "a.db", load(JUDGED)) as kept:
        kept.add([judged("clean", k, "ols", error) for k, error in enumerate((0.02, 0.4, 0.01))])
        kept.add([judged("clean", k, "quick", error) for k, error in enumerate((None, 1e-9, None))])
        kept.add([judged("clean", k, "true", 0.0) for k in range(3)])
        kept.add([judged("pushed", k, "true", 0.245, 0.2) for k in range(3)])
        kept.add([judged("pushed", k, "quick", 1e-9, 0.2) for k in range(3)])
    return tmp_path / "a.db"


def marks(axes, method: str) -> list[tuple[int, float, bool]]:
    """Row, place in decades and hollowness of every mark of a method."""
    colour = to_hex(method_looks(METHODS)[method]["color"])
    return [
        (int(line.get_ydata()[0]), float(line.get_xdata()[0]), to_hex(line.get_markerfacecolor()) == PAPER)
        for line in axes.lines
        if line.get_marker() not in ("None", "") and to_hex(line.get_color()) == colour
        if np.isfinite(line.get_xdata()[0])
    ]


def worst(axes, method: str) -> list[float]:
    """Where the lines of a method end, in decades."""
    colour = to_hex(method_looks(METHODS)[method]["color"])
    lines = [one for one in axes.lines if to_hex(one.get_color()) == colour and len(one.get_xdata()) == 2]
    return [float(one.get_xdata()[1]) for one in lines if np.isfinite(one.get_xdata()[1])]


def texts(figure) -> list[str]:
    return [text.get_text() for text in figure.texts]


def column(axes, name: str) -> float:
    """Where a name stands along an axis."""
    names = [text.get_text() for text in axes.get_xticklabels()]
    return float(axes.get_xticks()[names.index(name)])


# What is drawn --------------------------------------------------------------------------------------------------------
def test_marks_stand_at_medians_and_lines_end_at_the_worst(store: Path):
    (axes,) = plot_estimates(store).axes
    ((at, place, hollow),) = marks(axes, "ols")
    assert (at, hollow) == (0, False)
    assert 10.0**place == pytest.approx(2.0)
    assert [10.0**end for end in worst(axes, "ols")] == pytest.approx([40.0])


def test_what_is_mostly_without_an_estimate_is_hollow_and_apart_and_what_is_exact_is_less_than_all(store: Path):
    (axes,) = plot_estimates(store).axes
    clean, pushed, _ = marks(axes, "quick")
    assert clean == (0, pytest.approx(column(axes, "none")), True)
    assert pushed == (1, pytest.approx(column(axes, "<0.001")), False)
    assert column(axes, "none") > column(axes, "100") > column(axes, "<0.001")


def test_where_the_best_are_not_the_plants_own_there_is_a_second_row_and_the_truth_has_a_mark(store: Path):
    figure = plot_estimates(store)
    assert [text for text in texts(figure) if text in ("clean", "pushed", "relative to the true ones")] == [
        "clean", "pushed", "relative to the true ones",
    ]  # fmt: skip
    ((at, place, _),) = marks(figure.axes[0], "true")
    assert (at, 10.0**place) == (1, pytest.approx(24.5))
    assert 10.0 ** marks(figure.axes[0], "quick")[2][1] == pytest.approx(100 * (1 - 0.2 / 0.249), rel=1e-6)


def test_the_truth_is_left_out_where_it_is_the_best_everywhere(tmp_path: Path):
    with Store(tmp_path / "b.db", load(JUDGED)) as kept:
        kept.add([judged("clean", 0, method, 0.0) for method in ("true", "ols")])
    figure = plot_estimates(tmp_path / "b.db")
    assert [text.get_text() for text in figure.legends[0].texts] == ["ols", "quick"]


@pytest.mark.parametrize("rows", [[judged("clean", 0, "true", 0.0)], [row("clean", 0, "true", status="failed")]])
def test_a_study_that_has_nothing_to_show_yet_has_a_picture_and_a_page(rows: list, tmp_path: Path):
    with Store(tmp_path / "b.db", load(JUDGED).subset(methods=["true"])) as kept:
        kept.add(rows)
    assert not marks(plot_estimates(tmp_path / "b.db").axes[0], "true")
    write_study_report(tmp_path / "b.db", tmp_path / "page.html")


def test_a_level_whose_trials_have_no_data_is_drawn_as_without_an_estimate(tmp_path: Path):
    with Store(tmp_path / "b.db", load(JUDGED)) as kept:
        kept.add([judged("clean", 0, "ols", 0.01)])
        kept.add([row("pushed", k, m, status="failed", error="diverged") for k in range(3) for m in METHODS])
    (axes,) = plot_estimates(tmp_path / "b.db").axes
    for method in ("ols", "quick"):
        assert marks(axes, method)[-1] == (1, pytest.approx(column(axes, "none")), True)


def test_levels_stand_below_what_varies_with_its_unit_and_power_of_ten(tmp_path: Path):
    axis = {"name": "mass imbalance", "unit": "kg m^2", "path": "plant.mass_imbalance", "levels": [6e-5, 9e-5]}
    with Store(tmp_path / "b.db", load(JUDGED | {"axis": axis})) as kept:
        kept.add([judged(level, 0, "ols", 0.01) for level in ("6e-05", "9e-05")])
    figure = plot_estimates(tmp_path / "b.db")
    figure.draw_without_rendering()
    heading, *levels = (
        next(text for text in figure.texts if text.get_text() == wanted).get_window_extent()
        for wanted in ("mass imbalance, 10⁻⁵ kg m²", "6", "9")
    )
    assert heading.x0 > 0.0
    assert all(level.y1 < heading.y0 and level.x1 == pytest.approx(heading.x1, abs=1.0) for level in levels)
    assert heading.x1 < figure.axes[0].get_window_extent().x0


def test_none_is_explained_where_it_is_drawn_alone(tmp_path: Path):
    wordy = {"name": "scenario", "levels": {"calm": {"noise.outlier_magnitude": 0}}}
    with Store(tmp_path / "w.db", load(tiny(trials=2, axis=wordy, evaluation__parameters=True))) as kept:
        kept.add([judged("calm", 0, method, 0.01) for method in METHODS])
        assert "none:" not in " ".join(texts(plot_estimates(tmp_path / "w.db")))
        kept.add([judged("calm", 1, "ols", None)])
    assert "none: no estimate" in " ".join(texts(plot_estimates(tmp_path / "w.db")))


def test_what_is_missing_is_said_below_the_picture(store: Path):
    assert "3 of 18 rows are missing." in texts(plot_estimates(store))


def test_an_axis_holds_all_that_is_beyond_it_in_order():
    values = np.array([0.0, 1e-9, 0.01, 3.0, 9e3, 1e12, np.inf])
    scale = LogAxis.of([MarkRow("a", values[:-1], values[1:])])
    places = scale.place(values)
    assert places[2:5] == pytest.approx(np.log10([0.01, 3.0, 9e3]))
    assert places[0] == places[1]
    assert (np.diff(places[1:]) > 0).all()
    low, high = scale.ends
    assert low < places[0]
    assert places[-1] < high
    assert scale.names(9.0)[places[-2]] == f">{10**scale.high:,}"


@pytest.mark.parametrize("width", [2.0, 9.0])
def test_names_along_an_axis_do_not_touch(width: float):
    scale = LogAxis.of([MarkRow("a", np.array([0.002, 50.0]), np.array([np.inf, 1e9]))])
    at = np.sort(list(scale.names(width)))
    assert len(at) > 4
    assert np.diff(at).min() * width / (scale.ends[1] - scale.ends[0]) > 0.3


def test_long_names_of_many_levels_are_within_the_picture_and_beside_their_panel(tmp_path: Path):
    wordy = {"name": "scenario", "levels": {x: {"noise.outlier_magnitude": k} for k, x in enumerate(WORDS)}}
    with Store(tmp_path / "w.db", load(tiny(trials=1, axis=wordy, evaluation__parameters=True))) as kept:
        kept.add([judged(name, 0, method, 0.01) for name in WORDS for method in METHODS])
    figure = plot_estimates(tmp_path / "w.db")
    figure.draw_without_rendering()
    (axes,) = figure.axes
    left = axes.get_window_extent().x0
    names = [text for text in figure.texts if text.get_text().startswith(("scenario ", "a scenario"))]
    assert len(names) == len(WORDS)
    assert "\n" in names[-1].get_text()
    for name in names:
        box = name.get_window_extent()
        assert box.x0 > 0.0
        assert box.x1 < left


def test_no_line_joins_levels_that_are_words_however_few(tmp_path: Path):
    wordy = {"name": "scenario", "levels": {"calm": {}, "gusts": {"noise.outlier_magnitude": 1}}}
    with Store(tmp_path / "w.db", load(tiny(trials=1, axis=wordy))) as kept:
        kept.add(
            [
                row(w, 0, m, **{f"square_{s}": 0.1 for s in ("x", "z", "theta")})
                for w in wordy["levels"]
                for m in METHODS
            ]
        )
    figure = plot_study(tmp_path / "w.db")
    for axes in figure.axes:
        assert all(line.get_linestyle() == "None" or len(line.get_xdata()) == 1 for line in axes.lines
                   if to_hex(line.get_color()) == to_hex(method_looks(METHODS)["ols"]["color"]))  # fmt: skip


def test_long_names_of_levels_and_the_table_of_failures_stand_clear_of_the_panels(tmp_path: Path):
    wordy = {"name": "scenario", "levels": {x: {"noise.outlier_magnitude": k} for k, x in enumerate(WORDS)}}
    with Store(tmp_path / "w.db", load(tiny(trials=3, axis=wordy))) as kept:
        flown = {f"square_{s}": 0.1 for s in ("x", "z", "theta", "x_dot", "z_dot", "theta_dot")}
        kept.add([row(name, k, m, **flown) for name in WORDS for k in (1, 2) for m in METHODS])
        kept.add([row(WORDS[0], 0, "ols", status="failed", error="no plan")])
    figure = plot_study(tmp_path / "w.db")
    figure.savefig(tmp_path / "w.png")
    *panels, table = figure.axes
    axis = next(text for text in figure.texts if text.get_text() == "scenario").get_window_extent()
    lowest = min(x.get_window_extent().y0 for x in panels[-1].get_xticklabels())
    highest = max(x.get_window_extent().y1 for x in table.get_xticklabels())
    assert lowest > axis.y1 > axis.y0 > highest
    assert [text.get_text() for text in table.texts] == ["33"]


# Files, page and commands ---------------------------------------------------------------------------------------------
@pytest.mark.parametrize("ending", ["png", "svg", "pdf"])
def test_the_same_rows_give_the_same_file(store: Path, tmp_path: Path, ending: str):
    first, second = tmp_path / f"1.{ending}", tmp_path / f"2.{ending}"
    plot_estimates(store, first)
    plot_estimates(store, second)
    assert first.read_bytes() == second.read_bytes()


def test_the_page_has_errors_of_every_parameter_and_counts_intervals(store: Path, tmp_path: Path):
    write_study_report(store, tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text()
    for figure in re.findall(r"<svg.*?</svg>", text, re.DOTALL):
        ElementTree.fromstring(figure)
    assert text.count("<svg") == 1, "nothing was flown"
    assert "<td>2 [40]</td>" in text
    assert "<td>∞ [∞]</td>" in text
    assert all(f"<summary>{name}</summary>" in text for name in OWN)
    assert "… relative to the true ones" in text
    assert "<td>0.67 of 3</td><td>–</td>" in text, "of ols: 1 and 2 % off are within 0.01 kg of 0.249, 40 % is not"
    assert "nothing &lt;was&gt; found" in text
    assert "In short" not in text


def test_the_page_has_no_seconds_of_stages_that_the_study_lacks(store: Path, tmp_path: Path):
    write_study_report(store, tmp_path / "page.html")
    (table,) = re.findall(r"<caption>Seconds of one process.*?</table>", (tmp_path / "page.html").read_text())
    assert re.findall(r"<th[^>]*>([^<]*)</th>", table)[:4] == ["method", "record", "identify", "all"]
    assert "<td>1.5</td><td>0.75</td><td>2.25</td>" in table, "of three rows of ols"


def test_the_command_draws_what_a_study_judges(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    plot_estimates(store, "wanted.svg")
    for words in ([], ["--parameters"]):
        assert run("study", "plot", store, "-o", "found.svg", *words).exit_code == 0
        assert Path("found.svg").read_bytes() == Path("wanted.svg").read_bytes()
    nothing = run("study", "plot", store, "-o", "a.svg", "--errors")
    assert (nothing.exit_code, nothing.stderr.count("\n")) == (1, 1)
    assert "no trajectories to evaluate" in nothing.stderr
    assert run("study", "plot", store, "-o", "a.svg", "--errors", "--parameters").exit_code == 2


def test_a_study_that_judges_no_parameters_draws_none(tmp_path: Path):
    with Store(tmp_path / "n.db", load(tiny())) as kept:
        kept.add([row()])
    with pytest.raises(SettingsError, match=r"evaluates no parameters; run one with evaluation\.parameters = true"):
        plot_estimates(tmp_path / "n.db", tmp_path / "a.png")
    assert not (tmp_path / "a.png").exists()
    assert summarise(tmp_path / "n.db").estimates is None
