"""Texts of the command line alone: methods side by side, models, and the cache of machine code."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from diransac.model import Model, Parameter
from diransac.model.library import BUILTIN
from diransac.simulation.compiler.code_cache import CodeCache
from diransac.text_table import aligned

if TYPE_CHECKING:
    from diransac.data.readers.topics import TopicTable
    from diransac.data.suggested_mapping import Coverage


@dataclass(frozen=True)
class ModelList:
    """Every built-in model, a line each."""

    def to_dict(self) -> dict[str, Any]:
        """Names, units, bounds and equations of each model, by name."""
        return {name: Equations(make()).to_dict() for name, make in BUILTIN.items()}

    def __str__(self) -> str:
        rows = [["model", "coordinates", "inputs", "parameters"]]
        for name, make in BUILTIN.items():
            model = make()
            states = (*model.coordinates, *model.first_order)
            rows.append([name, *(", ".join(group) for group in (states, model.inputs, model.parameters))])
        return "\n".join(aligned(rows))


@dataclass(frozen=True)
class Equations:
    """Signals, parameters with their bounds, and equations of a model.

    Parameters
    ----------
    model : Model
    """

    model: Model

    def to_dict(self) -> dict[str, Any]:
        """Names, units, bounds (null: none) and equations."""
        model = self.model
        parameters = {name: vars(parameter).copy() for name, parameter in model.parameters.items()}
        return {
            "name": model.name,
            "signals": {name: model.units[name] for name in model.signals},
            "inputs": model.inputs,
            "parameters": parameters,
            "required": list(model.required_signals),
            "nonlinear": list(model.nonlinear_parameters),
            "equations": list(model.equations_text()),
        }

    def __str__(self) -> str:
        model = self.model
        signals = [["signal", "unit", ""]]
        signals += [
            [name, model.units[name], "sensor" if name in model.sensors else "predicted"] for name in model.signals
        ]
        signals += [[name, unit, "input"] for name, unit in model.inputs.items()]
        rows = [["parameter", "unit", "bounds"]]
        rows += [[name, parameter.unit, _bounds(parameter)] for name, parameter in model.parameters.items()]
        return "\n".join([model.name, *aligned(signals), "", *aligned(rows), "", *model.equations_text()])


@dataclass(frozen=True)
class CacheState:
    """Folder, number and size of the entries of a cache of machine code.

    Parameters
    ----------
    cache : CodeCache or None
        None where it is switched off.
    """

    cache: CodeCache | None

    def to_dict(self) -> dict[str, Any]:
        """Folder (null: none), reason for not using it (empty: it is used), entries, bytes, and their limit."""
        if self.cache is None:
            return {"folder": None, "unused": "DIRANSAC_CACHE is off", "entries": 0, "bytes": 0, "limit": 0}
        sizes = self.cache.sizes()
        return {
            "folder": str(self.cache.folder),
            "unused": self.cache.objection(),
            "entries": len(sizes),
            "bytes": sum(sizes.values()),
            "limit": self.cache.size_limit,
        }

    def __str__(self) -> str:
        state = self.to_dict()
        if self.cache is None:
            return f"no machine code is kept: {state['unused']}"
        unused = f"\nnot used: {state['unused']}" if state["unused"] else ""
        size, limit = (state[name] / 2**20 for name in ("bytes", "limit"))
        return f"{state['folder']}\n{state['entries']} entries, {size:.1f} of at most {limit:.0f} MiB{unused}"


def _bounds(parameter: Parameter) -> str:
    low = "0 <" if parameter.positive else f"{parameter.lower:g} <=" if parameter.lower > -float("inf") else ""
    high = f"<= {parameter.upper:g}" if parameter.upper < float("inf") else ""
    return " ".join(part for part in (low, "value" if low or high else "any", high) if part)


@dataclass(frozen=True)
class Recorded:
    """Topics of a recording, and which of them a model's signals may come from."""

    topics: TopicTable
    coverage: Coverage | None = None

    @classmethod
    def of(cls, topics: TopicTable, model: Model | None) -> Recorded:
        """Topics, and the coverage of a model."""
        if model is None:
            return cls(topics)
        from diransac.data.suggested_mapping import suggest_mapping

        return cls(topics, suggest_mapping(topics.fields, topics.elements, model, topics.source))

    def to_dict(self) -> dict[str, Any]:
        """Both."""
        return self.topics.to_dict() | {"fitness": None if self.coverage is None else self.coverage.to_dict()}

    def __str__(self) -> str:
        return str(self.topics) + ("" if self.coverage is None else f"\n\n{self.coverage}")
