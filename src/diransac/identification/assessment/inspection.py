"""Inspection of a log before identification: its signals, their faults, and the identifiability of a model."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from diransac.arrays import FloatArray
from diransac.data import preprocessing
from diransac.data.checks import rows_per_sample
from diransac.data.dataset import Dataset, as_logs, usable_sensors
from diransac.data.log import Log
from diransac.data.segment import other_drive, spelling_notes
from diransac.errors import IdentificationError, LogError, SettingsError
from diransac.identification.evaluation.scoring import choose_scoring
from diransac.identification.regression.estimators import OrdinaryLeastSquares
from diransac.identification.regression.uncertainty import jackknife_covariance
from diransac.identification.settings import Settings
from diransac.identification.structure.columns import contradictions, reversed_signs
from diransac.identification.structure.identifiability import equations_in_words, in_words, of_log
from diransac.identification.structure.known_parameters import KnownParameters
from diransac.identification.structure.refusal import check_motion
from diransac.identification.structure.structural import structural
from diransac.model import Model
from diransac.text_table import aligned, percent


@dataclass(frozen=True)
class SignalFacts:
    """One signal of a log.

    Parameters
    ----------
    unit : str
        Unit; None where the log does not give it.
    minimum, maximum, standard_deviation : float
        Statistics of the finite samples, in that unit; NaN where there is none.
    rate : float
        Samples per second, Hz: that of the log, or that of a slow signal, which has NaN between its samples.
    n_missing : int
        Number of rows without a sample.
    n_spikes : int
        Number of samples that a Hampel filter would replace.
    frozen : float
        Longest stretch of one value, s; 0 if it is shorter than 10 samples.
    """

    unit: str | None
    minimum: float
    maximum: float
    standard_deviation: float
    rate: float
    n_missing: int
    n_spikes: int
    frozen: float


@dataclass(frozen=True)
class Excitation:
    """Ordinary least-squares estimate of a parameter from whole logs, outliers included, and its relative error.

    Parameters
    ----------
    unit : str
        Unit of the parameter.
    estimate : float
        Estimate in that unit; NaN where the parameter is not identifiable.
    relative_error : float
        Standard error over estimate, by a jackknife; infinite where the parameter is not identifiable.
    """

    unit: str
    estimate: float
    relative_error: float

    @property
    def verdict(self) -> str:
        """Degree of excitation: "well" (relative error below 10 %), "weakly" (below 50 %) or "not"."""
        return "well" if self.relative_error < 0.1 else "weakly" if self.relative_error < 0.5 else "not"


@dataclass(frozen=True)
class Fitness:
    """Suitability of a log for the identification of a model.

    Parameters
    ----------
    model : str
        Name of the model.
    missing : tuple of str
        Signals and inputs that the equations need and the log lacks.
    derivable : tuple of str
        Missing signals that differentiation supplies.
    excitation : mapping of str to Excitation
        Excitation of each parameter; empty where it cannot be computed.
    reason : str, optional
        Reason why it cannot be computed, or why parameters are not identifiable.
    caveat : str, optional
        Reason why the estimates are doubtful.
    bases : mapping of str to str
        Velocity or acceleration -> the coordinate from which it could be derived, of those that the log lacks.
    """

    model: str
    missing: tuple[str, ...]
    derivable: tuple[str, ...]
    excitation: Mapping[str, Excitation]
    reason: str = ""
    caveat: str = ""
    bases: Mapping[str, str] = dataclasses.field(default_factory=dict)


@dataclass(frozen=True)
class Inspection:
    """Statistics of a log, returned by `inspect`; printed as a table.

    Of several logs, those of the first one, with the fitness of all together.

    Parameters
    ----------
    source : str
        Name of the log in messages.
    n_rows : int
        Number of rows.
    start, dt : float
        First time and sampling time, s.
    signals : mapping of str to SignalFacts
        Statistics of each signal.
    notes : tuple of str
        Findings on reading, a sentence each; of the first log also those of the model.
    fitness : Fitness, optional
        Suitability for a model; None where no model was given.
    events : mapping of str to float
        Part of the rows in which each event of the mapping holds.
    others : tuple of Inspection
        Of the further logs.
    """

    source: str
    n_rows: int
    start: float
    dt: float
    signals: Mapping[str, SignalFacts]
    notes: tuple[str, ...]
    fitness: Fitness | None = None
    events: Mapping[str, float] = dataclasses.field(default_factory=dict)
    others: tuple[Inspection, ...] = ()

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
        return facts | {"others": [x.to_dict() for x in self.others]}

    def __str__(self) -> str:
        logs = "\n\n".join("\n".join(x._signal_lines()) for x in (self, *self.others))
        return "\n".join([logs, *self._fitness_lines()])

    def _signal_lines(self) -> list[str]:
        end = self.start + self.duration
        head = f"{self.source}: {self.n_rows} rows at {1.0 / self.dt:.6g} Hz, {self.start:.6g} to {end:.6g} s"
        rows = [["signal", "unit", "minimum", "maximum", "std", "Hz", "NaN", "spikes", "frozen s"]]
        rows += [[name, *_cells(facts)] for name, facts in self.signals.items()]
        held = [f"  event {n}: holds in {percent(x)} of the rows" for n, x in self.events.items()]
        return [head, *aligned(rows), *held, *(f"  {note}" for note in self.notes)]

    def _fitness_lines(self) -> list[str]:
        found = self.fitness
        if found is None:
            return []
        lines = ["", f"for {found.model}:"]
        rest = [found.bases.get(name, name) for name in found.missing if name not in found.derivable]
        rest = list(dict.fromkeys(rest))
        lines += [f"  missing: {', '.join(rest)}; name columns with --map, or see diransac map"] if rest else []
        lines += [f"  derived with --differentiate: {', '.join(found.derivable)}"] if found.derivable else []
        lines += [f"  {found.reason}"] if found.reason else []
        if found.excitation:
            rows = [("parameter", "least squares", "unit", "error", "determined")]
            for name, x in found.excitation.items():
                rows.append((name, f"{x.estimate:.4g}", x.unit, f"{100 * x.relative_error:.2g} %", x.verdict))
            lines += aligned(rows)
        return lines + ([f"  {found.caveat}"] if found.caveat else [])


def inspect(
    logs: Log | Iterable[Log],
    model: Model | None = None,
    *,
    fixed: Mapping[str, float | None] | Iterable[str] | None = None,
) -> Inspection:
    """Statistics of logs, and the identifiability of a model's parameters from all of them together.

    Parameters
    ----------
    logs : Log or iterable of Log
    model : Model, optional
        Velocities and accelerations that the model needs and the logs lack are derived, where they can be.
    fixed : mapping of str to float, or iterable of str, optional
        Parameters of the model that are known, as in `identify`.

    Returns
    -------
    Inspection

    Raises
    ------
    SettingsError
        There is no log; the model has no such parameter, or one is fixed without a model.
    """
    if model is None and fixed:
        raise SettingsError("parameters are fixed without a model; give the model, too")
    several, model = as_logs(logs), None if model is None else KnownParameters.of(model, fixed, None).free()
    first, *others = contents = [_contents(log, model) for log in several]
    fitness = None if model is None else _fitness(several, model, contents)
    notes = (*first.notes, *(() if model is None else model.notes))
    return dataclasses.replace(first, notes=notes, fitness=fitness, others=tuple(others))


def _contents(log: Log, model: Model | None) -> Inspection:
    """Statistics of one log."""
    log = log if model is None else preprocessing.in_degrees(log, model)
    continuous = preprocessing.unwrap(log) if model is None else preprocessing.continuous(log, model)
    events = {name: float(np.mean(log[name] == 1.0)) for name in _events(log)}
    signals = {name: _signal_facts(log, name, continuous[name]) for name in log.names if name not in events}
    like = () if model is None else spelling_notes(model, log, (*model.signals, *model.inputs))
    notes = (*log.notes, *like)
    return Inspection(log.source, len(log), float(log.time[0]), log.dt, signals, notes, events=events)


def _events(log: Log) -> list[str]:
    """Signals of the log that are events of its mapping."""
    named = [name for step in log.history if step.get("step") == "map" for name in step.get("events", ())]
    return [name for name in named if name in log]


# ---------------------------------------------------------------------- signals


def _signal_facts(log: Log, name: str, continuous: FloatArray) -> SignalFacts:
    """Statistics of a signal; its spikes are those of its continuous form, without wraps and changes of sign."""
    values = log[name]
    finite = values[np.isfinite(values)]
    low, high, spread = (finite.min(), finite.max(), _standard_deviation(finite)) if len(finite) else (np.nan,) * 3
    apart = rows_per_sample(np.isfinite(values))
    run = _longest_run(values if apart == 1 else finite)
    frozen = run * apart * log.dt if run >= 10 else 0.0
    with np.errstate(over="ignore"):  # a bound that overflows is infinite, and nothing is beyond it
        n_spikes = int(preprocessing.hampel(continuous if apart == 1 else continuous[np.isfinite(values)])[0].sum())
    n_missing, rate = int(np.isnan(values).sum()), 1.0 / (apart * log.dt)
    return SignalFacts(log.units.get(name), float(low), float(high), float(spread), rate, n_missing, n_spikes, frozen)


def _standard_deviation(values: FloatArray) -> float:
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
    return (facts.unit or "?", *(f"{x:.5g}" for x in numbers), f"{facts.rate:.4g}", *counts)


# ---------------------------------------------------------------------- a model


def _fitness(logs: Sequence[Log], model: Model, contents: Sequence[Inspection]) -> Fitness:
    missing = tuple(name for name in model.required_signals if any(name not in log for log in logs))
    derived = [_derived(log, model) for log in logs] if missing else logs
    derivable = tuple(name for name in missing if all(name in log for log in derived))
    excitation, reason, caveats = dict[str, Excitation](), "", list[str]()
    if derivable != missing:
        later = "lo-diransac estimates them; excitation is known only after identification"
        reason = other_drive(model, logs[0]) if set(missing) & set(model.inputs) else later
    elif model.nonlinear_parameters:
        names = ", ".join(model.nonlinear_parameters)
        reason = f"not affine in {names}: excitation is known only after identification"
    else:
        try:
            excitation, reason = _excitation(model, derived)
        except (LogError, IdentificationError) as error:
            reason = str(error)
    if excitation and not reason:
        caveats = [f"{x.claim}; {x.action}" for x in contradictions(model, logs) or reversed_signs(model, logs)]
        spiked = [n for n in model.required_signals if any(n in x.signals and x.signals[n].n_spikes for x in contents)]
        if spiked:
            bias = f"spikes in {', '.join(spiked)} bias these estimates and errors"
            caveats.append(f"{bias}: pass --despike, or use those of identify")
    # Rates that a log lacks, with the coordinate that it lacks, too.
    chains = [x for x in model.chains if x[0] in model.coordinates and any(x[0] not in log for log in logs)]
    bases = {name: chain[0] for chain in chains for name in chain[1:]}
    return Fitness(model.name, missing, derivable, excitation, reason, "; ".join(caveats), bases)


def _derived(log: Log, model: Model) -> Log:
    """The log with signals derived by differentiation; the log itself where none can be."""
    try:
        return preprocessing.differentiate(log, model)
    except LogError:
        return log


def _excitation(model: Model, logs: Sequence[Log]) -> tuple[dict[str, Excitation], str]:
    """Excitation of each parameter; where some are not identifiable, of those alone, with the reason.

    Raises LogError, IdentificationError: nothing can be identified from the log, or it cannot be scored.
    """
    model = model.with_sensors(usable_sensors(model, logs, regression=True)[0])
    dataset = Dataset.of(model, logs)
    check_motion(dataset)
    own = dict(zip(dataset.layout.names, dataset.layout.bounds, strict=True))
    ambiguous = structural(model, ranges=dataset.ranges)
    words = equations_in_words(ambiguous)
    if not ambiguous:
        bound = OrdinaryLeastSquares().bind(dataset)
        rows = np.arange(bound.n_rows)
        selected = bound.select([rows])
        ambiguous = () if selected.well_defined()[0] else of_log(list(own), bound.null_space())
        words = in_words(ambiguous, len(logs))
    if ambiguous:
        names = [name for x in ambiguous for name in x.names]
        return {n: Excitation((own.get(n) or model.parameters[n]).unit, np.nan, np.inf) for n in names}, words
    estimates = selected.fit()[0]
    errors = np.sqrt(np.diag(jackknife_covariance(bound, rows)))
    relative = np.divide(errors, np.abs(estimates), out=np.full(len(errors), np.inf), where=estimates != 0.0)
    choose_scoring(dataset, Settings())
    rated = zip(own.items(), estimates.tolist(), relative.tolist(), strict=True)
    return {name: Excitation(parameter.unit, x, error) for (name, parameter), x, error in rated}, ""
