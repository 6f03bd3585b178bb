"""The paper's evaluation: run its studies, and print the number behind every claim. docs/paper.md shows it.

    python benchmarks/paper.py [--trials 50] [--stores out/paper] [--jobs 2] [--only fig2,fig5] [--methods true,ols]

A store that is there is resumed, so the second run of the same command only prints.  Means are over the flights there
are; a median counts a trial that failed (no plan, or a flight that diverged) as an infinite error; "near" is the share
of all trials whose RMS error is below 0.1 m in both x and z.
"""

import argparse
import time
from pathlib import Path

import numpy as np

import diransac as dr
from diransac.model.library import TABLE_I
from diransac.study import Study, load
from diransac.study.engine import Processes
from diransac.study.summary import Summary, TrackingErrors, summarise

NEAR = 0.1
"""m"""


# Studies -------------------------------------------------------------------------------------------------------------
def variants(source: str, settings: dict[str, dict[str, object]], levels: list[float], **changes: object) -> Study:
    """A built-in study in which methods are I-DIRANSAC with some other settings each, at some levels."""
    table = load(source, {path.replace("__", "."): value for path, value in changes.items()}).to_dict()
    table["methods"] = {
        label: {"method": "i-diransac", "preset": "table-iv", "settings": more} for label, more in settings.items()
    }
    return load(table).subset(levels=levels)


WEIGHTS = {
    "inliers alone": {"acceptance_weights": [0.0, 1.0]},
    "error alone": {"acceptance_weights": [1.0, 0.0]},
    "hybrid": {},
}
CAPS = {f"{n} iterations": {"max_iterations": n, "stop_inlier_fraction": "none"} for n in (250, 500, 1000, 2000, 4000)}
RANSACS = ("diransac", "diransac-without-refit", "i-diransac")
SIGNALS = {"noise__outliers": "signals"}


def every(key: str, value: object) -> dict[str, object]:
    """A change of one key of every RANSAC method."""
    return {f"methods.{method}.{key}": value for method in RANSACS}


UNIT_WEIGHTS = {"control.Q": 1.0, "control.R": 1.0}
SLOW_VELOCITY = dict.fromkeys(("x", "z", "theta"), 1.0) | dict.fromkeys(("x_dot", "z_dot", "theta_dot"), 0.3)
QUICK_SINE = {"missions.sine.periods": 1.0, "missions.sine.duration": 5.0}
CHOICES: dict[str, dict[str, object]] = {
    "as they are": {},
    "Q = R = 1": UNIT_WEIGHTS,
    "Q = R = Qf = 1": UNIT_WEIGHTS | {"control.Qf": 1.0},
    "Q = 1 and 0.3 of velocities, R = 1": {"control.Q": SLOW_VELOCITY, "control.R": 1.0},
    "inputs not clipped": {"control.clip": False},
    "star at 1.2 m/s": {"data.speed": 1.2},
    "star at 2 m/s": {"data.speed": 2.0},
    "star with moment at a fifth of the cost": {"data.input_weights": {"moment": 0.2}},
    "star with moment at five times the cost": {"data.input_weights": {"moment": 5.0}},
    "total least squares of samples": every("estimator", "tls"),
    "initial state robust": every("settings.initial_state", "robust"),
}
"""Choices that the paper leaves open, one at a time, and what they change."""
OF_OUTLIERS: dict[str, dict[str, object]] = {
    "each signal by itself": {"noise.outliers": "signals"},
    "first row corrupted": {"noise.first_row": "corrupted"},
    "each signal by itself, first row corrupted": {"noise.outliers": "signals", "noise.first_row": "corrupted"},
}
OF_IMBALANCE: dict[str, dict[str, object]] = {
    "eq. (20) as printed": {"plant.convention": "printed"},
    "phase as printed": {"plant.phase": "instantaneous"},
    "phase of each flight random": {"plant.rotor_phase": "random"},
    "sine of one period in 5 s": QUICK_SINE,
    "sine of one period in 5 s, Q = 1 and 0.3 of velocities, R = 1, not clipped": QUICK_SINE
    | {"control.Q": SLOW_VELOCITY, "control.R": 1.0, "control.clip": False},
}


def choices(source: str, path: str, level: float, more: dict[str, dict[str, object]]) -> Study:
    """A built-in study at one level, as it is and with one choice changed at a time."""
    table = load(source, {path: level}).to_dict()
    levels = {_word(name): changes for name, changes in (CHOICES | more).items()}
    table["methods"] = {label: one for label, one in table["methods"].items() if label in ("ols", *RANSACS)}
    table["axis"] = {"name": "choice", "levels": levels}
    return load(table)


def _word(name: str) -> str:
    """A level's name has no commas."""
    return name.replace(",", ";")


def studies() -> dict[str, Study]:
    """Every study by the name of its store."""
    return {
        "fig2": load("fig2"),
        "fig2-signals": load("fig2", {"noise.outliers": "signals"}),
        **{
            f"fig2-{share}{name}": load("fig2", {"noise.outlier_probability": share, "noise.outliers": reading})
            for share in (0.3, 0.5)
            for reading, name in (("rows", ""), ("signals", "-signals"))
        },
        "fig3": load("fig3"),
        "fig3-printed": load("fig3", {"plant.convention": "printed"}),
        "fig4": load("fig4"),
        "fig4-printed": load("fig4", {"plant.convention": "printed"}),
        "fig5": load("fig5"),
        "fig5-signals": load("fig5", {"noise.outliers": "signals"}),
        "gaussian": load("gaussian"),
        "gaussian-exact": load("gaussian", {"noise.angular_acceleration_std": 0.0}),
        "acceptance-outliers": variants("fig2", WEIGHTS, [40, 60, 80], **SIGNALS),
        "acceptance-aerodynamic": variants("fig3", WEIGHTS, [1.4e-6]),
        "acceptance-mass": variants("fig4", WEIGHTS, [6e-5]),
        "acceptance-aerodynamic-printed": variants("fig3", WEIGHTS, [1.4e-6], plant__convention="printed"),
        "acceptance-mass-printed": variants("fig4", WEIGHTS, [1e-4], plant__convention="printed"),
        "iterations": variants("fig2", CAPS, [40, 80], **SIGNALS),
        "choices-fig2": choices("fig2", "noise.outlier_magnitude", 80.0, OF_OUTLIERS),
        "choices-fig3": choices("fig3", "plant.aerodynamic_imbalance", 1.4e-6, OF_IMBALANCE),
        "choices-fig4": choices("fig4", "plant.mass_imbalance", 1e-4, OF_IMBALANCE),
    }


FIGURES = ("fig2", "fig3", "fig4", "fig5")
"""What the time is counted of."""


# Tables --------------------------------------------------------------------------------------------------------------
def show(title: str, header: list[str], rows: list[list[str]]) -> None:
    """Print a table as Markdown."""
    print(f"\n### {title}\n\n| {' | '.join(header)} |\n|{'---|' * len(header)}")
    for row in rows:
        print(f"| {' | '.join(row)} |")


def text(x: float) -> str:
    """Three digits; what is below a hundredth of a millimetre is 0."""
    return "-" if np.isnan(x) else "fails" if np.isinf(x) else f"{x:.3g}" if abs(x) >= 1e-5 or not x else "< 1e-5"


def near(flights: TrackingErrors, i: int, k: int) -> str:
    """Share of the trials that stay near the reference."""
    ran = flights.ran[i, k]
    close = (flights.errors["x"][i, k] < NEAR) & (flights.errors["z"][i, k] < NEAR)
    return f"{100.0 * close[ran].mean():.0f} %"


def by_level(summary: Summary, shape: str) -> None:
    """A row a level and method: means, spread and medians of x and z, what failed, what stayed near."""
    flights = summary.flights[shape]
    rows = []
    for i, level in enumerate(summary.levels):
        for k, method in enumerate(summary.methods):
            if not flights.ran[i, k].any():
                continue
            cells = [level, method]
            for state in ("x", "z"):
                mean, spread, median = (f(state)[i, k] for f in (flights.mean, flights.deviation, flights.median))
                cells += [text(mean), text(spread), text(median)]
            share = flights.failure_share[i, k]
            rows.append([*cells, text(flights.mean("theta")[i, k]), f"{100 * share:.0f} %", near(flights, i, k)])
    head = [summary.axis, "method", "x, m", "±", "median", "z, m", "±", "median", "theta, rad", "failed", "near"]
    show(f"{summary.name}, {shape}", head, rows)


def gaps(summary: Summary, shape: str) -> None:
    """How much larger the other methods' error is than I-DIRANSAC's: the largest over levels, of means and medians."""
    flights, ours = summary.flights[shape], summary.methods.index("i-diransac")
    rows = []
    for k, method in enumerate(summary.methods):
        if method in ("i-diransac", "true"):
            continue
        cells = [method]
        for state in ("x", "z"):
            for of in (flights.mean, flights.median):
                values = of(state)
                with np.errstate(invalid="ignore"):
                    gap = values[:, k] - values[:, ours]
                there = np.flatnonzero(np.isfinite(gap))
                best = there[np.argmax(gap[there])] if len(there) else None
                cells.append("-" if best is None else f"{text(gap[best])} at {summary.levels[best]}")
        rows.append(cells)
    head = ["method", "x, means", "x, medians", "z, means", "z, medians"]
    show(f"{summary.name}, {shape}: error less I-DIRANSAC's, m, largest over levels", head, rows)


def flatness(summary: Summary, shape: str) -> None:
    """Least and largest error of each method over the levels above 0."""
    flights, spoilt = summary.flights[shape], summary.positions > 0.0
    rows = []
    for k, method in enumerate(summary.methods):
        cells = [method]
        for state in ("x", "z", "theta"):
            for of in (flights.mean, flights.median):
                values = of(state)[spoilt, k]
                cells.append(f"{text(np.nanmin(values))} to {text(np.nanmax(values))}")
        rows.append(cells)
    head = ["method", "x, means", "medians", "z, means", "medians", "theta, means", "medians"]
    show(f"{summary.name}, {shape}: least and largest over levels above 0", head, rows)


def by_choice(summary: Summary, shape: str) -> None:
    """A row per choice: mean error of each method in the coordinate of its figure, and trials that stay near."""
    flights, state = summary.flights[shape], "z" if shape == "square" else "x"
    mean = flights.mean(state)
    cells = [[f"{text(x)} ({near(flights, i, k)})" for k, x in enumerate(row)] for i, row in enumerate(mean)]
    rows = [[choice, *some] for choice, some in zip(summary.levels, cells, strict=True)]
    show(f"{summary.name}, {shape}: mean of {state}, m (near)", ["choice", *summary.methods], rows)


def parameters(store: Path) -> None:
    """Medians of what was identified, at each level."""
    import polars as pl

    names = [f"parameter_{name}" for name in TABLE_I]
    frame = dr.study.read(store).filter(pl.col("method") != "true")
    found = frame.group_by("level", "method", maintain_order=True).agg(pl.col(names).median())
    rows = [[level, method, *(text(x or 0.0) for x in values)] for level, method, *values in found.iter_rows()]
    show(f"{store.stem}: median parameters", ["level", "method", *TABLE_I], rows)


# Claims without a study ----------------------------------------------------------------------------------------------
def show_gamma() -> None:
    """What blades that differ by so much in C_T and D give by eq. (12)."""
    whole = 0.06 * 0.127**4
    rows = [
        [f"{100 * d:g} %", f"{whole * ((1 + d) ** 5 - 1):.3g}", f"{whole * (1 - (1 - d) ** 5):.3g}"]
        for d in (0.0125, 0.015, 0.02, 0.0223, 0.025)
    ]
    show("gamma, m^4, of blades that differ in C_T and in D", ["by", "the other is larger", "is smaller"], rows)


def show_wrong_start() -> None:
    """How an error in the first velocity, of 1 in each in turn, lasts while a star's inputs are simulated."""
    model = dr.models.planar_rotorcraft()
    star = dr.star(dr.Plant(model, TABLE_I))
    rows = []
    for drag in (TABLE_I["drag"], 0.0):
        parameters = np.array([[TABLE_I["mass"], TABLE_I["inertia"], drag]])
        for name in ("x_dot", "z_dot", "theta_dot"):
            k = model.state.index(name)
            begin = np.zeros((2, len(model.state)))
            begin[1, k] = 1.0
            apart = np.abs(np.diff(_rollouts(model, parameters, begin, star.inputs), axis=0)[0])
            rows.append([f"{drag:g}", name, *(text(apart[int(100 * t), k]) for t in (0, 5, 10, 15, 20, 25))])
    head = ["drag, s/m", "1 off at first", *(f"after {t} s" for t in (0, 5, 10, 15, 20, 25))]
    show("A wrong start", head, rows)


def _rollouts(model: dr.Model, parameters: np.ndarray, begin: np.ndarray, inputs: np.ndarray) -> np.ndarray:
    """States (n_starts, n_rows, n_x) by RK4 at 100 Hz, inputs held."""
    states, x = [begin], begin.T
    count = begin.shape[0]
    rate = model.dynamics.map(count)
    p = np.repeat(parameters.T, count, axis=1)

    def f(x: np.ndarray, u: np.ndarray) -> np.ndarray:
        return np.array(rate(x, np.repeat(u[:, None], count, axis=1), p)[0])

    for u in inputs[:-1]:
        k1 = f(x, u)
        k2 = f(x + 0.005 * k1, u)
        k3 = f(x + 0.005 * k2, u)
        x = x + 0.01 / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + f(x + 0.01 * k3, u))
        states.append(x.T)
    return np.stack(states, axis=1)


def show_excitation() -> None:
    """What a gentler star leaves of least squares, eq. (20) as printed, at the largest imbalances."""
    true = dr.Plant(dr.models.planar_rotorcraft(), TABLE_I)
    rows = []
    for effort in (1.0, 10.0, 100.0, 1000.0):
        star = dr.star(true, input_weights={"moment": effort, "thrust": 1.0})
        for words, imbalances in {"gamma 1.8e-6": (1.8e-6, 0.0), "delta_m 1.4e-4": (0.0, 1.4e-4)}.items():
            plant = dr.models.extended_rotorcraft(*imbalances, convention="printed")
            log = dr.fly(plant, star, dr.tvlqr(true, star))
            cells = [text(result_of(log, plant, method)[1]) for method in ("ols", "i-diransac")]
            found, _ = result_of(log, plant, "ols")
            lively = float(np.sqrt(np.mean(log["theta_ddot"] ** 2)))
            rows.append([f"{effort:g}", words, text(lively), text(found.parameters["inertia"]), *cells])
    head = ["weight of u_2", "imbalance", "RMS theta_ddot", "inertia by ols", "sine x, ols", "sine x, i-diransac"]
    show("Gentle and lively stars, printed convention", head, rows)


def show_conventions() -> None:
    """One flight in each reading of eqs. (14) and (20), at the paper's largest imbalances."""
    rows = []
    for words, imbalances in {"gamma 1.8e-6": (1.8e-6, 0.0), "delta_m 1.4e-4": (0.0, 1.4e-4)}.items():
        for convention in ("printed", "physical"):
            for phase in ("integrated", "instantaneous"):
                plant = dr.models.extended_rotorcraft(*imbalances, convention=convention, phase=phase)
                star = dr.star(plant)
                log = dr.fly(plant, star, dr.tvlqr(plant, star))
                for method in ("ols", "i-diransac", "lo-diransac"):
                    found, x = result_of(log, plant, method)
                    mass, inertia = found.parameters["mass"], found.parameters["inertia"]
                    rows.append([words, convention, phase, method, text(mass), text(inertia), text(x)])
    show("Readings", ["imbalance", "convention", "phase", "method", "mass", "inertia", "sine x, m"], rows)


def result_of(log: dr.Log, plant: dr.Plant, method: str) -> tuple[dr.Result, float]:
    """What a method finds, and the error in x of a sine that is planned and steered with it, m; infinite: no plan."""
    settings = None if method == "lo-diransac" else dr.Settings.table_iv()
    found = dr.identify(plant.model, log, method=method, seed=1, settings=settings)
    try:
        sine = dr.sine(found)
    except dr.PlanningError:
        return found, np.inf
    return found, dr.tracking_error(sine, dr.fly(plant, sine, dr.tvlqr(found, sine)))["x"]


def show_time(found: dict[str, Summary], wall: dict[str, float]) -> None:
    """Seconds of one process by study and stage, and by method."""
    rows, by_method = [], {}
    for name in FIGURES:
        if name in found:
            one = found[name]
            total = one.seconds.sum(axis=0)
            rows.append([name, *(f"{x:.0f}" for x in total), f"{total.sum():.0f}", f"{wall.get(name, np.nan):.0f}"])
            for method, seconds in zip(one.methods, one.seconds, strict=True):
                by_method[method] = by_method.get(method, 0.0) + seconds
    stages = list(next(iter(found.values())).stages)
    show("Seconds by study", ["study", *stages, "all, one process", "this run, wall"], rows)
    rows = [[m, *(f"{x:.0f}" for x in seconds), f"{seconds.sum():.0f}"] for m, seconds in by_method.items()]
    show("Seconds by method, Figs. 2 to 5", ["method", *stages, "all"], rows)


def main() -> None:
    """Run what stores lack, then print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trials", type=int, default=50)
    parser.add_argument("--stores", type=Path, default=Path("out/paper"))
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", help="studies, separated by commas")
    parser.add_argument("--methods", help="methods of the figures, separated by commas")
    given = parser.parse_args()
    given.stores.mkdir(parents=True, exist_ok=True)
    chosen = studies() if given.only is None else {name: studies()[name] for name in given.only.split(",")}
    wall = {}
    with Processes(given.jobs) as workers:  # which keep what they have imported and compiled
        for name, study in chosen.items():
            methods = None if given.methods is None or "i-diransac" not in study.methods else given.methods.split(",")
            begin, kept = time.perf_counter(), given.stores / f"{name}.db"
            dr.run_study(
                study, store=kept, executor=workers, tasks=2 * given.jobs, trials=given.trials, methods=methods
            )
            wall[name] = time.perf_counter() - begin
            print(f"{name}: {wall[name]:.0f} s", flush=True)
    found = {name: summarise(given.stores / f"{name}.db") for name in chosen}
    for name, summary in found.items():
        print(f"\n## {name}")
        for shape in summary.flights:
            if name.startswith("choices"):
                by_choice(summary, shape)
                continue
            by_level(summary, shape)
            if "i-diransac" in summary.methods:
                gaps(summary, shape)
                flatness(summary, shape)
        parameters(given.stores / f"{name}.db")
    if not given.only:
        print("\n## Without studies")
        show_gamma()
        show_wrong_start()
        show_excitation()
        show_conventions()
    if found.keys() & set(FIGURES):
        print("\n## Time")
        show_time(found, wall)


if __name__ == "__main__":
    main()
