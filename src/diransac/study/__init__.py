"""Studies: grids of Monte-Carlo trials from a TOML file, run on any executor, kept in a store that can be resumed.

| file | contents |
|---|---|
| `run.py` | `run_study`; workers on this machine, on an executor or on a cluster |
| `specification.py`, `axis.py`, `plants.py`, `tables.py` | the specification of a study, as pydantic models |
| `library.py`, `builtin/`, `template.toml` | sources of studies; those of the paper's figures |
| `data.py`, `assessment.py` | the data of a trial; pseudo-true parameters and errors relative to them |
| `trials.py` | the work of a worker |
| `store.py`, `reading.py`, `summary.py` | one SQLite file, its rows, and their summary for tables and figures |
"""

from diransac.study.data import TrialData, trial_data
from diransac.study.library import builtin_names, load, template
from diransac.study.reading import Status, TrialCounts, about, export, paths, read, status
from diransac.study.run import connected, run_study
from diransac.study.specification import FlightChoice, MethodChoice, Study
from diransac.study.summary import ParameterErrors, Summary, TrackingErrors, summarise

__all__ = [
    "FlightChoice",
    "MethodChoice",
    "ParameterErrors",
    "Status",
    "Study",
    "Summary",
    "TrackingErrors",
    "TrialCounts",
    "TrialData",
    "about",
    "builtin_names",
    "connected",
    "export",
    "load",
    "paths",
    "read",
    "run_study",
    "status",
    "summarise",
    "template",
    "trial_data",
]
