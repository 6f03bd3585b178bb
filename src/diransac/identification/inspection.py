"""What a log holds, what is odd about it, and what it can tell about a model - before anything is identified."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data import preprocessing
from diransac.data.dataset import Dataset
from diransac.errors import LogError
from diransac.identification.estimators import OrdinaryLeastSquares
from diransac.identification.evaluation import choose_scoring
from diransac.identification.settings import Settings
from diransac.identification.uncertainty import jackknife_covariance
from diransac.text_table import aligned

if TYPE_CHECKING:
    from diransac.data.log import Log
    from diransac.identification.estimators import BoundEstimator
    from diransac.model import Model

__all__ = ["Excitation", "Fitness", "Inspection", "SignalFacts", "inspect"]


_WELL, _WEAKLY = 0.1, 0.5
_FROZEN_SAMPLES = 10


@dataclass(frozen=True)
class SignalFacts:
    """One signal of a log.

    Parameters
    ----------
    unit : its unit, None where the log does not say
    minimum, maximum, standard_deviation : of its finite samples, in that unit; NaN where there is none
    n_missing : samples that are NaN
    n_spikes : samples that a Hampel filter would replace
    frozen : s, the longest stretch without any change, if it has at least 10 samples
    """

    unit: str | None
    minimum: float
    maximum: float
    standard_deviation: float
    n_missing: int
    n_spikes: int
    frozen: float


@dataclass(frozen=True)
class Excitation:
    """How well ordinary least squares determines a parameter from the whole log, outliers included.

    Parameters
    ----------
    unit : its unit
    estimate : in that unit; NaN where the log does not determine it
    relative_error : standard error over estimate, by a jackknife; infinite where the log does not determine it
    """

    unit: str
    estimate: float
    relative_error: float

    @property
    def verdict(self) -> str:
        """Whether the motion shows the parameter: well (error below 10 %), weakly (below 50 %) or not at all."""
        return "well" if self.relative_error < _WELL else "weakly" if self.relative_error < _WEAKLY else "not"


@dataclass(frozen=True)
class Fitness:
    """What a log offers to a model.

    Parameters
    ----------
    model : its name
    missing : signals and inputs that the equations need and the log lacks
    derivable : those of them that differentiation supplies
    excitation : by parameter; empty where it cannot be said
    reason : why it cannot be said
    caveat : what makes it doubtful
    """

    model: str
    missing: tuple[str, ...]
    derivable: tuple[str, ...]
    excitation: Mapping[str, Excitation]
    reason: str = ""
    caveat: str = ""


@dataclass(frozen=True)
class Inspection:
    """What `inspect` found: the log's time, s, its signals by name, and what it offers to a model if one was given."""

    source: str
    n_rows: int
    start: float
    dt: float
    signals: Mapping[str, SignalFacts]
    notes: tuple[str, ...]
    fitness: Fitness | None = None

    @property
    def duration(self) -> float:
        """Seconds from the first row to the last."""
        return self.dt * (self.n_rows - 1)

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON apart from numbers that are not finite."""
        facts = dataclasses.asdict(self) | {"rate": 1.0 / self.dt, "duration": self.duration}
        if self.fitness is not None:
            verdicts = {name: found.verdict for name, found in self.fitness.excitation.items()}
            facts["fitness"]["verdicts"] = verdicts
        return facts

    def __str__(self) -> str:
        end = self.start + self.duration
        head = f"{self.source}: {self.n_rows} rows at {1.0 / self.dt:.6g} Hz, {self.start:.6g} to {end:.6g} s"
        rows = [["signal", "unit", "minimum", "maximum", "std", "NaN", "spikes", "frozen s"]]
        rows += [[name, *_cells(facts)] for name, facts in self.signals.items()]
        return "\n".join([head, *aligned(rows), *(f"  {note}" for note in self.notes), *self._fitness_lines()])

    def _fitness_lines(self) -> list[str]:
        found = self.fitness
        if found is None:
            return []
        lines = ["", f"for {found.model}:"]
        rest = [name for name in found.missing if name not in found.derivable]
        lines += [f"  missing: {', '.join(rest)}; name columns with --map"] if rest else []
        lines += [f"  missing, --differentiate supplies: {', '.join(found.derivable)}"] if found.derivable else []
        lines += [f"  {found.reason}"] if found.reason else []
        if found.excitation:
            rows = [("parameter", "least squares", "unit", "error", "determined")]
            for name, x in found.excitation.items():
                rows.append((name, f"{x.estimate:.4g}", x.unit, f"{100 * x.relative_error:.2g} %", x.verdict))
            lines += aligned(rows)
        return lines + ([f"  {found.caveat}"] if found.caveat else [])


def inspect(log: Log, model: Model | None = None) -> Inspection:
    """What a log holds, and what it can tell about a model.

    Where the log lacks velocities or accelerations that can be derived, the model is judged with them derived.
    """
    signals = {name: _signal_facts(log, name) for name in log.names}
    fitness = None if model is None else _fitness(log, model)
    if model is not None and fitness is not None and fitness.excitation and not fitness.reason:
        fitness = dataclasses.replace(fitness, caveat=_caveat(signals, model))
    return Inspection(log.source, len(log), float(log.time[0]), log.dt, signals, log.notes, fitness)


# ---------------------------------------------------------------------- signals


def _signal_facts(log: Log, name: str) -> SignalFacts:
    values = log[name]
    finite = values[np.isfinite(values)]
    low, high, spread = (finite.min(), finite.max(), _spread(finite)) if len(finite) else (np.nan,) * 3
    run = _longest_run(values)
    frozen = run * log.dt if run >= _FROZEN_SAMPLES else 0.0
    with np.errstate(over="ignore"):  # a bound that overflows is infinite, and nothing is beyond it
        n_spikes = int(preprocessing.hampel(values)[0].sum())
    return SignalFacts(
        log.units.get(name), float(low), float(high), float(spread), int(np.isnan(values).sum()), n_spikes, frozen
    )


def _spread(values: FloatArray) -> float:
    """Standard deviation, of numbers whose squares may overflow too."""
    scale = max(np.abs(values).max(), np.finfo(np.float64).tiny)
    return float(scale * (values / scale).std())


def _longest_run(values: FloatArray) -> int:
    """Samples of the longest stretch of one value."""
    changes = np.flatnonzero(np.diff(values) != 0.0)
    return int(np.diff([-1, *changes, len(values) - 1]).max())


def _cells(facts: SignalFacts) -> tuple[str, ...]:
    numbers = (facts.minimum, facts.maximum, facts.standard_deviation)
    frozen = f"{facts.frozen:.3g}" if facts.frozen else "-"
    counts = (str(facts.n_missing or "-"), str(facts.n_spikes or "-"), frozen)
    return (facts.unit or "?", *(f"{x:.5g}" for x in numbers), *counts)


# ---------------------------------------------------------------------- a model


def _fitness(log: Log, model: Model) -> Fitness:
    missing = tuple(name for name in model.required_signals if name not in log)
    derived = _derived(log, model) if missing else log
    derivable = tuple(name for name in missing if name in derived)
    if derivable != missing:
        return Fitness(model.name, missing, derivable, {})
    if model.nonlinear_parameters:
        names = ", ".join(model.nonlinear_parameters)
        return Fitness(
            model.name, missing, derivable, {}, f"not affine in {names}: only a search can tell what is excited"
        )
    try:
        dataset = Dataset.of(model, derived)
        excitation, reason = _excitation(OrdinaryLeastSquares().bind(dataset), model)
        if not reason:
            choose_scoring(dataset, Settings())  # refuses a log in which nothing moves, as identify does
    except LogError as error:
        return Fitness(model.name, missing, derivable, {}, str(error))
    return Fitness(model.name, missing, derivable, excitation, reason)


def _caveat(signals: Mapping[str, SignalFacts], model: Model) -> str:
    """What spikes in the signals of the equations do to an estimate that believes every row; nothing without them."""
    spiked = [name for name in model.required_signals if name in signals and signals[name].n_spikes]
    if not spiked:
        return ""
    return f"spikes in {', '.join(spiked)} bend these estimates and errors: --despike them, or trust identify alone"


def _derived(log: Log, model: Model) -> Log:
    """The log with what differentiation supplies; the log itself where it supplies nothing."""
    try:
        return preprocessing.differentiate(log, model)
    except LogError:
        return log


def _excitation(bound: BoundEstimator, model: Model) -> tuple[dict[str, Excitation], str]:
    """How well the whole log determines each parameter; where it leaves some open, those alone, and what that means."""
    names, units = list(model.parameters), [parameter.unit for parameter in model.parameters.values()]
    rows = np.arange(bound.n_rows)
    selected = bound.select([rows])
    if not selected.well_defined()[0]:
        loose = bound.unidentifiable() or range(len(names))
        found = {names[i]: Excitation(units[i], np.nan, np.inf) for i in loose}
        return found, f"the motion that would show {', '.join(found)} is missing, or moves with another"
    estimates = selected.fit()[0]
    errors = np.sqrt(np.diag(jackknife_covariance(bound, rows)))
    relative = np.divide(errors, np.abs(estimates), out=np.full(len(names), np.inf), where=estimates != 0.0)
    rated = zip(names, units, estimates, relative, strict=True)
    return {name: Excitation(unit, float(x), float(e)) for name, unit, x, e in rated}, ""
