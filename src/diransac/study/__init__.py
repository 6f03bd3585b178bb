"""Studies: grids of Monte-Carlo trials from a TOML file, run on any executor, kept in a store that can be resumed.

| file | contents |
|---|---|
| `run.py` | `run_study` |
| `engine.py` | batches, resumed and repeated, on processes of this machine, an executor or a cluster |
| `specification.py`, `axis.py`, `plants.py`, `tables.py` | the specification of a study, as pydantic models |
| `library.py`, `builtin/`, `template.toml` | sources of studies; those of the paper's figures |
| `data.py`, `assessment.py` | the data of a trial; pseudo-true parameters and errors relative to them |
| `trials.py` | the work of a worker |
| `fleet.py`, `fleet_findings.py` | `identify_each`: one result per log; vehicles that differ, change or drift |
| `database.py`, `store.py`, `reading.py`, `summary.py` | one SQLite file, its rows, and their summary |
"""

from diransac.study.data import TrialData, trial_data
from diransac.study.engine import connected
from diransac.study.fleet import FleetRows, FleetStatus, fleet_status, identify_each, read_fleet
from diransac.study.fleet_findings import Change, Drift, FleetSummary, ParameterInFleet, VehicleOutlier, summarise_fleet
from diransac.study.library import builtin_names, load, template
from diransac.study.reading import Status, TrialCounts, about, export, paths, read, status
from diransac.study.run import run_study
from diransac.study.specification import FlightChoice, MethodChoice, Study
from diransac.study.summary import ParameterErrors, Summary, TrackingErrors, summarise

__all__ = [
    "Change",
    "Drift",
    "FleetRows",
    "FleetStatus",
    "FleetSummary",
    "FlightChoice",
    "MethodChoice",
    "ParameterErrors",
    "ParameterInFleet",
    "Status",
    "Study",
    "Summary",
    "TrackingErrors",
    "TrialCounts",
    "TrialData",
    "VehicleOutlier",
    "about",
    "builtin_names",
    "connected",
    "export",
    "fleet_status",
    "identify_each",
    "load",
    "paths",
    "read",
    "read_fleet",
    "run_study",
    "status",
    "summarise",
    "summarise_fleet",
    "template",
    "trial_data",
]
