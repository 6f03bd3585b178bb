"""The commands ``simulate``, which writes a noisy log, and ``fly``, which tests an identified model."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import typer

from diransac.cli import screen
from diransac.cli.arguments import load_model, model_file
from diransac.cli.commands import grouped
from diransac.cli.flight_options import (
    FlightPicture,
    FlightSeed,
    LogOutput,
    NoiseOptions,
    OptionalLogOutput,
    PlantOptions,
    TrajectoryArgument,
    TrajectoryOption,
    same_equations,
)
from diransac.cli.options import JsonFlag, ModelName, ResultFile
from diransac.cli.outputs import staged
from diransac.data.log import Log
from diransac.errors import DiransacError, PlanningError, SettingsError
from diransac.flight.closed_loop import fly, tracking_error
from diransac.flight.corruption import CorruptedLog, corrupt
from diransac.flight.noise import Noise
from diransac.flight.planning import sine, square, star
from diransac.flight.trajectory import Trajectory
from diransac.flight.tvlqr import Controller, tvlqr
from diransac.identification.result import Result
from diransac.model import Model
from diransac.model.plant import ModelWithParameters, Plant
from diransac.text_table import aligned

app = typer.Typer(add_completion=False)


@app.command("simulate")
@grouped
def _simulate(
    shape: TrajectoryArgument,
    plant: PlantOptions,
    noise_options: NoiseOptions,
    output: LogOutput,
    model: ModelName = "planar-rotorcraft",
    plot: FlightPicture = None,
    seed: FlightSeed = 0,
    as_json: JsonFlag = False,
) -> None:
    """Plan and fly a trajectory, and write its log with noise and faults."""
    noise = noise_options.noise()
    with staged([output, plot], [model_file(model)]) as (written, picture):
        known = load_model(model)
        simulated = simulate_flight(shape, known, plant.of(known), noise, seed)
        simulated.log.write(written)
        if plot:
            simulated.flight.draw(picture)
        screen.show(simulated, as_json)


@app.command("fly")
@grouped
def _fly(
    model: ResultFile,
    shape: TrajectoryOption,
    plant: PlantOptions,
    output: OptionalLogOutput = None,
    plot: FlightPicture = None,
    seed: FlightSeed = 0,
    as_json: JsonFlag = False,
) -> None:
    """Plan and control with an identified model, fly the true plant, and show the tracking error."""
    with staged([output, plot], [model]) as (written, picture):
        result = Result.load(model)
        test = fly_identified(shape, result, plant.of(result.model), seed)
        if output:
            test.flight.log.write(written)
        if plot:
            test.flight.draw(picture)
        screen.show(test, as_json)


# ---------------------------------------------------------------------- flights


@dataclass(frozen=True)
class TrackedFlight:
    """Closed-loop flight: reference, controller, log without noise, RMS errors by state."""

    trajectory: Trajectory
    controller: Controller
    log: Log
    errors: Mapping[str, float]

    @property
    def at_limit(self) -> dict[str, float]:
        """Fraction of the samples at a limit, by input."""
        controller = self.controller
        edges = zip(controller.input_names, controller.u_min, controller.u_max, strict=True)
        return {name: float(np.mean((self.log[name] <= low) | (self.log[name] >= high))) for name, low, high in edges}

    def draw(self, path: Path) -> None:
        """Write a figure of the flight."""
        from diransac.plots import plot_flight

        plot_flight(self.trajectory, self.log, path)

    def to_dict(self) -> dict[str, Any]:
        """Tracking errors and fractions at limits."""
        return {"tracking_error": self.errors, "at_limit": self.at_limit}


def _flown(shape: str, known: ModelWithParameters, plant: Plant, seed: int) -> TrackedFlight:
    """Flight of a plant along a plan and under a controller of the known model.

    Raises PlanningError: there is no plan or no controller, or the flight diverges.
    Raises SettingsError: the plant has other states or inputs than the known model.
    """
    trajectory = {"star": star, "square": square, "sine": sine}[shape](known)
    controller = tvlqr(known, trajectory)
    log = fly(plant, trajectory, controller, seed=seed)
    errors = tracking_error(trajectory, log)
    if not np.isfinite(list(errors.values())).all():
        raise PlanningError(
            f"{shape}: {'; '.join(log.notes)}; planning and control with these parameters fail on this plant"
        )
    return TrackedFlight(trajectory, controller, log, errors)


# simulate -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SimulatedFlight:
    """Flight and its noisy log."""

    shape: str
    plant: Plant
    flight: TrackedFlight
    log: CorruptedLog
    seed: int

    def to_dict(self) -> dict[str, Any]:
        """Flight, tracking errors, noise and faults."""
        return {
            "trajectory": self.shape,
            "plant": self.plant.simulated.name,
            "parameters": self.plant.parameters,
            "seed": self.seed,
            "rows": len(self.log),
            "rate": 1.0 / self.log.dt,
            "units": self.log.units,
            **self.flight.to_dict(),
            "faults": {name: int(mask.sum()) for name, mask in self.log.fault_mask.items()},
            "noise": self.log.history[-1]["noise"],
        }

    def __str__(self) -> str:
        errors, limits = self.flight.errors, self.flight.at_limit
        rows = [["signal", "unit", "tracking error", "faults", "at a limit"]]
        for name in self.log.names:
            error = f"{errors[name]:.4g}" if name in errors else ""
            faults = str(self.log.fault_mask[name].sum()) if name in self.log.fault_mask else ""
            rows.append([name, self.log.units[name], error, faults, _percent(limits[name]) if name in limits else ""])
        return "\n".join([f"{self.shape} of {_size(self.plant, self.log)}, seed {self.seed}", *aligned(rows)])


def simulate_flight(shape: str, model: Model, plant: Plant, noise: Noise, seed: int) -> SimulatedFlight:
    """Flight with the true model, and its noisy log.

    Raises as `_flown`; SettingsError: the plant is not of that model; LogError: the noise does not fit the log.
    """
    if not same_equations(model, plant.model):
        raise SettingsError(
            f'the plant "{plant.simulated.name}" has the equations of {plant.model.name}, not those of the model '
            f'"{model.name}"; leave the model or the plant out'
        )
    flight = _flown(shape, plant, plant, seed)
    log = corrupt(flight.log, noise, seed, signals=model.signals)
    return SimulatedFlight(shape, plant, flight, log, seed)


# fly ----------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class FlightTest:
    """Flights of the true plant with the identified model and with the true parameters, or the latter's error."""

    shape: str
    result: Result
    plant: Plant
    flight: TrackedFlight
    ideal: TrackedFlight | DiransacError
    seed: int

    def to_dict(self) -> dict[str, Any]:
        """Both flights and their parameters."""
        ideal = self.ideal.to_dict() if isinstance(self.ideal, TrackedFlight) else {"refused": str(self.ideal)}
        return {
            "trajectory": self.shape,
            "model": self.result.model.name,
            "method": self.result.method,
            "plant": self.plant.simulated.name,
            "seed": self.seed,
            "rows": len(self.flight.log),
            "rate": 1.0 / self.flight.log.dt,
            "units": self.flight.log.units,
            "parameters": self.result.parameters,
            **self.flight.to_dict(),
            "true": {"parameters": self.plant.parameters, **ideal},
        }

    def __str__(self) -> str:
        lines = [
            f"{self.shape} planned and controlled with {self.result.model.name} ({self.result.method}); "
            f"flight of {_size(self.plant, self.flight.log)}, seed {self.seed}",
            *aligned(self._parameters()),
            "",
            *aligned(self._signals()),
        ]
        if not same_equations(self.result.model, self.plant.model):
            lines.append(f"! the model has other equations than the plant's {self.plant.model.name}")
        if isinstance(self.ideal, DiransacError):
            lines.append(f"! the flight with the true parameters failed: {self.ideal}")
        return "\n".join(lines)

    def _parameters(self) -> list[list[str]]:
        found, true = self.result.parameters, self.plant.parameters
        units = self.result.units | {name: about.unit for name, about in self.plant.model.parameters.items()}
        rows = [["parameter", "unit", "identified", "true"]]
        return rows + [
            [name, units[name], *(f"{x[name]:.5g}" if name in x else "-" for x in (found, true))] for name in units
        ]

    def _signals(self) -> list[list[str]]:
        """Tracking error of each state, and share of the samples of each input at a limit."""
        units, controller = self.flight.log.units, self.flight.controller
        ideal = self.ideal if isinstance(self.ideal, TrackedFlight) else None
        rows = [["signal", "unit", "limits", "tracking error, or at a limit", "with the true parameters"]]
        for name, error in self.flight.errors.items():
            rows.append([name, units[name], "", f"{error:.4g}", f"{ideal.errors[name]:.4g}" if ideal else "-"])
        edges = zip(controller.u_min, controller.u_max, strict=True)
        for (name, share), (low, high) in zip(self.flight.at_limit.items(), edges, strict=True):
            limits = f"{low:g} .. {high:g}" if np.isfinite([low, high]).any() else "none"
            rows.append([name, units[name], limits, _percent(share), _percent(ideal.at_limit[name]) if ideal else "-"])
        return rows


def fly_identified(shape: str, result: Result, plant: Plant, seed: int) -> FlightTest:
    """Flights of the plant with the identified model and with the true parameters.

    Raises as `_flown`, for the identified model alone.
    """
    flight = _flown(shape, result, plant, seed)
    ideal: TrackedFlight | DiransacError
    try:
        ideal = _flown(shape, plant, plant, seed)
    except DiransacError as error:
        ideal = error
    return FlightTest(shape, result, plant, flight, ideal, seed)


def _size(plant: Plant, log: Log) -> str:
    """Plant, number of rows and rate."""
    return f"{plant.simulated.name}: {len(log)} rows at {1.0 / log.dt:.4g} Hz"


def _percent(share: float) -> str:
    return f"{100.0 * share:.1f} %"
