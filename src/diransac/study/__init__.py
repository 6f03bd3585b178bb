"""Studies: grids of Monte-Carlo trials from a TOML file, run on any executor, kept in a store that can be resumed.

In comes a study file, or a fleet of logs; out comes a store, one SQLite file, and its summary.  Begin with `run.py`,
and `trials.py`, the work of a worker.

| file | contents |
|---|---|
| `run.py`, `engine.py` | `run_study`; batches on processes of this machine, an executor or a cluster |
| `specification.py`, `axis.py`, `plants.py`, `method_choice.py`, `tables.py` | a study as pydantic models |
| `library.py`, `builtin/`, `template.toml` | sources of studies; those of the paper's figures |
| `machines.py` | plants with effects that their models leave out |
| `trials.py`, `data.py` | a trial; its data |
| `assessment.py` | pseudo-true parameters and errors relative to them |
| `fleet.py`, `fleet_store.py` | `identify_each`: one result per log; its rows |
| `fleet_findings.py` | vehicles that differ, change or drift |
| `database.py`, `store.py`, `reading.py`, `summary.py` | one SQLite file, its rows, and their summary |
"""

from diransac.study.data import TrialData, trial_data
from diransac.study.engine import connected
from diransac.study.fleet import FleetRows, FleetStatus, fleet_status, identify_each, read_fleet
from diransac.study.fleet_findings import Change, Drift, FleetSummary, ParameterInFleet, VehicleOutlier, summarise_fleet
from diransac.study.library import builtin_names, load, template
from diransac.study.method_choice import MethodChoice
from diransac.study.reading import Status, TrialCounts, about, export, paths, read, status
from diransac.study.run import run_study
from diransac.study.specification import FlightChoice, Study
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
