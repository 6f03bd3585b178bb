"""What each effect that the model leaves out does, and how finely rotors are to be integrated: docs/tables/flying.md.

Section IV of Dimmig et al. 2023 mentions this analysis and does not show it: "blade flapping ... negligible", the
gravitational mass imbalance "small in comparison to the rotational".  Each effect acts alone on the extended plant,
which flies a square and a sine under TVLQR with the true parameters.

    python benchmarks/sensitivity.py [PICTURE]
"""

import sys
from pathlib import Path

import casadi as ca
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

import diransac as dr
from diransac.model.library import BLADE_FLAPPING, TABLE_I, extended_rotorcraft

MODEL = dr.models.planar_rotorcraft()
TRUE = dr.Plant(MODEL, TABLE_I)
EFFECTS = {
    "aerodynamic imbalance": ({"aerodynamic_imbalance": 1.8e-6}, "gamma = 1.8e-6 m^4"),
    "rotational mass imbalance": ({"mass_imbalance": 1.4e-4, "mass_effects": ("rotational",)}, "dm = 1.4e-4 kg"),
    "gravitational mass imbalance": ({"mass_imbalance": 1.4e-4, "mass_effects": ("gravitational",)}, "dm = 1.4e-4 kg"),
    "blade flapping": ({"blade_flapping": BLADE_FLAPPING}, f"K = {BLADE_FLAPPING} rad"),
}
"""Each effect at the upper end of Table II."""

CONVENTIONS = ("physical", "printed")
ACCELERATIONS = tuple(MODEL.accelerations)
FLIGHTS = {"square": dr.square(TRUE), "sine": dr.sine(TRUE)}
COLOURS = {"physical": "#0072B2", "printed": "#E69F00"}


def unexplained(log: dr.Log) -> dict[str, float]:
    """RMS over a flight of the accelerations that the model doesn't know, at 100 Hz, each one's unit."""
    x, u = (np.array([log[name] for name in names]) for names in (MODEL.state, MODEL.inputs))
    p = np.tile(np.array(list(TABLE_I.values()))[:, None], (1, len(log)))
    known = np.array(MODEL.dynamics.map(len(log))(ca.DM(x), ca.DM(u), ca.DM(p))[1])
    return {name: float(np.sqrt(np.mean((log[name] - a) ** 2))) for name, a in zip(ACCELERATIONS, known, strict=True)}


def measured(options: dict[str, object], convention: str) -> tuple[dict[str, float], dict[str, dict[str, float]]]:
    """Unexplained accelerations on the square, and tracking errors of both flights."""
    plant = extended_rotorcraft(convention=convention, **options)
    logs = {name: dr.fly(plant, flight, dr.tvlqr(TRUE, flight)) for name, flight in FLIGHTS.items()}
    errors = {name: dr.tracking_error(FLIGHTS[name], log) for name, log in logs.items()}
    return unexplained(logs["square"]), errors


def print_convergence() -> None:
    """How the state at the end of a square depends on the integration steps in a turn of the rotors at hover."""
    plant, flight = extended_rotorcraft(1.4e-6, 1e-4), FLIGHTS["square"]
    controller = dr.tvlqr(TRUE, flight)
    turns = 0.01 * np.sqrt(TABLE_I["mass"] * 9.81 / 2 / (0.06 * 1.225 * 0.127**4))

    def end(steps_a_turn: float) -> np.ndarray:
        log = dr.fly(plant, flight, controller, substeps=round(steps_a_turn * turns))
        return np.array([log[name][-1] for name in MODEL.coordinates])

    exact, chosen = end(128), plant.substeps(0.01) / turns
    print("\n| steps in a turn at hover | largest error of x, z, theta after 12 s | order |")
    print("|---|---|---|")
    before = None
    for steps in (2, 4, 8, chosen, 16, 32):
        error = np.abs(end(steps) - exact).max()
        order = f"{np.log2(before / error):.1f}" if before and steps != chosen else ""
        print(f"| {steps:.3g}{' (the default)' if steps == chosen else ''} | {error:.2g} | {order} |")
        before = error if steps != chosen else before


def picture(rows: dict[tuple[str, str], tuple], path: Path) -> None:
    """Bars of the unexplained accelerations, and of the tracking errors in position."""
    figure = Figure(figsize=(9.0, 5.6), layout="constrained")
    FigureCanvasAgg(figure)
    panels = figure.subplots(2, 3)
    titles = [f"{name}, {MODEL.units[name]}" for name in ACCELERATIONS]
    titles += [f"tracking of the sine: {name}, {MODEL.units[name]}" for name in MODEL.coordinates]
    for k, (axes, title) in enumerate(zip(panels.flat, titles, strict=True)):
        for offset, convention in zip((0.19, -0.19), CONVENTIONS, strict=True):
            found = [rows[effect, convention] for effect in EFFECTS]
            values = [list((a if k < 3 else errors["sine"]).values())[k % 3] for a, errors in found]
            places = np.arange(len(EFFECTS)) + offset
            axes.barh(places, np.maximum(values, 1e-9), 0.36, color=COLOURS[convention], label=convention)
        axes.set_xscale("log")
        axes.set_xlim(1e-6, None)
        axes.set_title(title, fontsize=9)
        axes.set_yticks(range(len(EFFECTS)), EFFECTS if k % 3 == 0 else [""] * len(EFFECTS), fontsize=8)
        axes.tick_params(axis="x", labelsize=8)
        axes.invert_yaxis()
        axes.spines[["top", "right"]].set_visible(False)
    panels[0, 0].legend(title="convention", fontsize=8, title_fontsize=8, frameon=False)
    figure.savefig(path, dpi=110, metadata={"Software": None})


def main(path: Path | None) -> None:
    """Print the table, and draw it if a path is given."""
    rows = {(effect, c): measured(options, c) for effect, (options, _) in EFFECTS.items() for c in CONVENTIONS}
    print("| effect | convention | " + " | ".join(f"{n}, {MODEL.units[n]}" for n in ACCELERATIONS), end="")
    print(" | square x, m | z, m | theta, rad | sine x, m | z, m | theta, rad |")
    print("|" + "---|" * (2 + 3 + 6))
    for (effect, convention), (accelerations, errors) in rows.items():
        tracking = [errors[flight][name] for flight in FLIGHTS for name in MODEL.coordinates]
        cells = " | ".join(f"{x:.2g}" if x >= 1e-9 else "0" for x in (*accelerations.values(), *tracking))
        print(f"| {effect} ({EFFECTS[effect][1]}) | {convention} | {cells} |")
    print_convergence()
    if path:
        picture(rows, path)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else None)
