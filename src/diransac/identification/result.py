"""What an identification found, and how: printed as a table, saved as JSON."""

from __future__ import annotations

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from diransac.arrays import BoolArray, FloatArray
from diransac.atomic import write_text
from diransac.errors import DiransacError, ResultError, SettingsError
from diransac.identification.diagnosis import Diagnosis
from diransac.identification.settings import Settings
from diransac.model import Model
from diransac.text_table import aligned, telling_digits

__all__ = ["LogSummary", "Result"]


_FORMAT = 3
_FEW_INLIERS = 0.5
_PLAIN = {
    "method": str,
    "estimator": str,
    "seed": int,
    "n_fitted": int,
    "iterations": int,
    "n_hypotheses": int,
    "stop_reason": str,
    "rejected": dict,
}


@dataclass(frozen=True)
class LogSummary:
    """Which log it was: how messages name it, SHA-256, first time (s), sampling time (s), rows."""

    source: str
    fingerprint: str
    start: float
    dt: float
    n_rows: int


@dataclass(frozen=True, eq=False)
class Result:
    """Parameters of a model with everything that is needed to judge and repeat them.

    Parameters
    ----------
    model : the model, equations included
    parameters : name -> estimate, in the parameter's unit
    covariance : (n_p, n_p)   lo-diransac's own, else by a jackknife over stretches of time; infinite where the log
        cannot tell
    degrees_of_freedom : of that covariance, for intervals
    inliers : (N,)   over the rows of the log that was given
    n_fitted : observations that the parameters were fitted to: a sample, or a set of inliers
    inlier_fraction : of the rows that count
    fit_error : eq. (2) of the returned parameters (its square sibling for DIRANSAC); NaN where nothing could be
        simulated, infinite where the simulation diverged
    method, estimator, seed, settings : how it was made
    iterations : k, samples drawn; n_hypotheses : hypotheses looked at, refits included
    stop_reason : why the search ended; rejected : hypotheses that went no further, by reason
    violations : names of the parameters outside their bounds (never with a RANSAC method)
    log : which log it was; preparation : what was done to it, in order; notes : what was found on the way
    bandwidth_sensitivity : name -> relative change at half and at twice the differentiating filter's bandwidth
    diagnosis : lo-diransac's: noise, faults, and what the model leaves out

    Two results are equal if all of this is.
    """

    model: Model
    parameters: Mapping[str, float]
    covariance: FloatArray
    degrees_of_freedom: int
    n_fitted: int
    inliers: BoolArray
    inlier_fraction: float
    fit_error: float
    method: str
    estimator: str
    seed: int
    settings: Settings
    iterations: int
    n_hypotheses: int
    stop_reason: str
    rejected: Mapping[str, int]
    violations: tuple[str, ...]
    log: LogSummary
    preparation: tuple[Mapping[str, Any], ...] = ()
    notes: tuple[str, ...] = ()
    bandwidth_sensitivity: Mapping[str, tuple[float, float]] | None = None
    diagnosis: Diagnosis | None = None

    def __post_init__(self) -> None:
        for name in ("covariance", "inliers"):
            array = np.array(getattr(self, name))
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def standard_errors(self) -> dict[str, float]:
        """Standard error of each parameter in its unit; see `uncertainty.jackknife_covariance` for what it covers."""
        return dict(zip(self.parameters, np.sqrt(np.diag(self.covariance)).tolist(), strict=True))

    def intervals(self, level: float = 0.95) -> dict[str, tuple[float, float]]:
        """``(low, high)`` of each parameter, by Student's t.

        Raises SettingsError: the level is not between 0 and 1.
        """
        if not 0.0 < level < 1.0:
            raise SettingsError(f"level is {level}; give a number between 0 and 1, such as 0.95")
        from scipy.special import stdtrit

        width = float(stdtrit(self.degrees_of_freedom, 0.5 + level / 2.0))
        errors = self.standard_errors
        return {n: (x - width * errors[n], x + width * errors[n]) for n, x in self.parameters.items()}

    @property
    def units(self) -> dict[str, str]:
        """Unit of each parameter."""
        return {n: x.unit for n, x in self.model.parameters.items()}

    @property
    def inlier_times(self) -> FloatArray:
        """Log time of every inlier, s."""
        return np.asarray(self.log.start + self.log.dt * np.flatnonzero(self.inliers))

    def to_dict(self) -> dict[str, Any]:
        """Everything, ready for JSON; `from_dict` reads it back."""
        return {
            "format": _FORMAT,
            "method": self.method,
            "estimator": self.estimator,
            "seed": self.seed,
            "parameters": dict(self.parameters),
            "units": self.units,
            "standard_errors": {n: _encode(x) for n, x in self.standard_errors.items()},
            "intervals_95": {n: [_encode(x) for x in pair] for n, pair in self.intervals().items()},
            "covariance": [[_encode(x) for x in row] for row in self.covariance],
            "degrees_of_freedom": self.degrees_of_freedom,
            "n_fitted": self.n_fitted,
            "inlier_fraction": _encode(self.inlier_fraction),
            "fit_error": _encode(self.fit_error),
            "iterations": self.iterations,
            "n_hypotheses": self.n_hypotheses,
            "stop_reason": self.stop_reason,
            "rejected": dict(self.rejected),
            "violations": list(self.violations),
            "notes": list(self.notes),
            "bandwidth_sensitivity": _encode_pairs(self.bandwidth_sensitivity),
            "diagnosis": None if self.diagnosis is None else self.diagnosis.to_dict(),
            "preparation": [dict(step) for step in self.preparation],
            "log": vars(self.log).copy(),
            "settings": self.settings.to_dict(),
            "inliers": base64.b64encode(np.packbits(self.inliers).tobytes()).decode(),
            "model": self.model.to_dict(),
        }

    @classmethod
    def from_dict(cls, data: object) -> Result:
        """The result that `to_dict` wrote.

        Raises ResultError: the data are of another format, or damaged.
        """
        if not isinstance(data, Mapping) or data.get("format") != _FORMAT:
            raise ResultError(f"this is no diransac result of format {_FORMAT}; identify again")
        try:
            return cls._from_checked(data)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise ResultError(f"the result is damaged: {type(error).__name__} at {error}; identify again") from error

    @classmethod
    def _from_checked(cls, data: Mapping[str, Any]) -> Result:
        model = Model.from_dict(data["model"])
        log = LogSummary(**data["log"])
        packed = np.frombuffer(base64.b64decode(data["inliers"], validate=True), dtype=np.uint8)
        if len(packed) != (log.n_rows + 7) // 8:
            raise ValueError(f"inliers of {log.n_rows} rows")
        values = model.parameter_vector(data["parameters"])
        pairs, diagnosis = data["bandwidth_sensitivity"], data["diagnosis"]
        return cls(
            model=model,
            parameters=dict(zip(model.parameters, values.tolist(), strict=True)),
            covariance=np.array([[_decode(x) for x in row] for row in data["covariance"]]).reshape(
                model.n_p, model.n_p
            ),
            degrees_of_freedom=int(data["degrees_of_freedom"]),
            inliers=np.unpackbits(packed, count=log.n_rows).astype(bool),
            inlier_fraction=_decode(data["inlier_fraction"]),
            fit_error=_decode(data["fit_error"]),
            settings=Settings.from_dict(data["settings"]),
            violations=tuple(data["violations"]),
            notes=tuple(data["notes"]),
            preparation=tuple(data["preparation"]),
            bandwidth_sensitivity=None
            if pairs is None
            else {n: (_decode(a), _decode(b)) for n, (a, b) in pairs.items()},
            diagnosis=None if diagnosis is None else Diagnosis.from_dict(diagnosis, log.n_rows),
            log=log,
            **{key: _of_kind(kind, data[key], key) for key, kind in _PLAIN.items()},
        )

    def save(self, path: str | Path) -> None:
        """Write JSON, whole or not at all.

        Raises ResultError: it cannot be written there.
        """
        try:
            write_text(path, self._text())
        except OSError as error:
            raise ResultError(f"{path}: cannot be written: {error.strerror}") from error

    @classmethod
    def load(cls, path: str | Path) -> Result:
        """The result that `save` wrote.

        Raises ResultError: there is no such file, or it holds no result; it names the file.
        """
        try:
            return cls.from_dict(json.loads(Path(path).read_text(encoding="utf-8")))
        except OSError as error:
            raise ResultError(f"{path}: cannot be read: {error.strerror}") from error
        except (json.JSONDecodeError, UnicodeDecodeError, RecursionError) as error:
            raise ResultError(f"{path}: is no JSON: {error}") from error
        except DiransacError as error:
            raise ResultError(f"{path}: {error}") from error

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Result) and self._text() == other._text()

    def __hash__(self) -> int:
        return hash(self._text())

    def _text(self) -> str:
        return json.dumps(self.to_dict(), indent=1, allow_nan=False) + "\n"

    def __str__(self) -> str:
        return "\n".join([self._headline(), *self._table(), self._summary(), *self._diagnosed(), *self._warnings()])

    def _headline(self) -> str:
        seconds = self.log.dt * (self.log.n_rows - 1)
        rate = 1.0 / self.log.dt
        return f"{self.model.name} by {self.method} from {self.log.source} ({seconds:.4g} s at {rate:.4g} Hz)"

    def _table(self) -> list[str]:
        rows = [("parameter", "estimate", "95 % interval", "unit")]
        for name, (low, high) in self.intervals().items():
            digits = telling_digits(low, high)
            interval = f"{low:.{digits}g} .. {high:.{digits}g}" if np.isfinite(high - low) else "unknown"
            estimate = "?" if self._is_undetermined(name) else f"{self.parameters[name]:.6g}"
            rows.append((name, estimate, interval, self.units[name]))
        return aligned(rows)

    def _is_undetermined(self, name: str) -> bool:
        return self.diagnosis is not None and name in self.diagnosis.unidentifiable

    def _summary(self) -> str:
        whole = "" if self.diagnosis is None else "in one simulation of the whole log: "
        parts = [f"{whole}fit error {self.fit_error:.4g}", f"inliers {100.0 * self.inlier_fraction:.1f} %"]
        parts.append(f"fitted to {self.n_fitted} rows")
        if self.iterations:
            rejected = ", ".join(f"{n} {reason}" for reason, n in self.rejected.items())
            parts.append(f"{self.iterations} sample{'s' if self.iterations > 1 else ''}, {self.stop_reason}")
            parts.append(f"{self.n_hypotheses} hypotheses" + (f" ({rejected})" if rejected else ""))
        return "; ".join(parts)

    def _diagnosed(self) -> list[str]:
        """What is wrong with the log and with the model, where it is known."""
        if self.diagnosis is None:
            return []
        return ["", *aligned(self.diagnosis.lines(self.model.units)), ""]

    def _warnings(self) -> list[str]:
        lines = [f"! {n} = {self.parameters[n]:.6g} is outside its bounds" for n in self.violations]
        lines += self._warnings_of_search() if self.diagnosis is None else self._warnings_of_diagnosis(self.diagnosis)
        for name, (half, double) in (self.bandwidth_sensitivity or {}).items():
            lines.append(
                f"  {name}: {100 * half:+.2g} % at half the filter's bandwidth, {100 * double:+.2g} % at twice"
            )
        return lines + [f"  {note}" for note in self.notes]

    def _warnings_of_search(self) -> list[str]:
        lines = []
        if self.inlier_fraction < _FEW_INLIERS:
            lines.append("! the simulation agrees with less than half of the log: do not rely on these parameters")
        wanted = self.settings.stop_inlier_fraction
        if self.iterations and wanted is not None and self.inlier_fraction < wanted:
            lines.append(f"! the search ended short of the {100 * wanted:.3g} % inliers that it was to reach")
        if not np.isfinite(self.covariance).all():
            lines.append(f"! intervals are unknown: {self.n_fitted} fitted rows are too few to tell")
        return lines

    def _warnings_of_diagnosis(self, found: Diagnosis) -> list[str]:
        lines = [f"! the log cannot tell {name}: record a motion that depends on it" for name in found.unidentifiable]
        if found.input_delay_significant:
            lines.append(f"! inputs act {1e3 * found.input_delay:.3g} ms later than the log says")
        return lines


def _encode(x: float) -> float | str:
    """JSON has no infinity and no NaN."""
    return float(x) if np.isfinite(x) else str(float(x))


def _decode(x: float | str) -> float:
    return float(x)


def _of_kind(kind: type, value: Any, key: str) -> Any:
    if not isinstance(value, kind):
        raise TypeError(f"{key} {value!r}")
    return value


def _encode_pairs(pairs: Mapping[str, tuple[float, float]] | None) -> dict[str, list[float | str]] | None:
    return None if pairs is None else {n: [_encode(x) for x in pair] for n, pair in pairs.items()}
