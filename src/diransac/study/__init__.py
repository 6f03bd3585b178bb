"""Studies: grids of Monte-Carlo trials from a TOML file, run on any executor, kept in a store that can be resumed.

In comes a study file, or a fleet of logs; out comes a store, one SQLite file, and its summary.  Begin with `trials.py`.

| file | contents |
|---|---|
| `engine.py`, `store.py` | rows by batches on processes, an executor or a cluster; the SQLite file that keeps them |
| `specification.py`, `axis.py`, `method_choice.py`, `tables.py` | a study as pydantic models |
| `plants.py` | its plant: machines with effects that their models leave out, and the choice of one |
| `library.py`, `builtin/`, `template.toml` | sources of studies; those of the paper's figures |
| `trials.py`, `data.py` | `run_study`; a trial; its data |
| `assessment.py` | pseudo-true parameters and errors relative to them |
| `fleet.py` | `identify_each`: one result per log |
| `fleet_findings.py` | vehicles that differ, change or drift |
| `reading.py`, `summary.py` | rows of a study and their summary |
"""

from diransac.study.data import TrialData, trial_data
from diransac.study.engine import connected
from diransac.study.fleet import FleetRows, FleetStatus, fleet_status, identify_each, read_fleet
from diransac.study.fleet_findings import Change, Drift, FleetSummary, ParameterInFleet, VehicleOutlier, summarise_fleet
from diransac.study.library import builtin_names, load, template
from diransac.study.method_choice import MethodChoice
from diransac.study.reading import Status, TrialCounts, about, export, paths, read, status
from diransac.study.specification import FlightChoice, Study
from diransac.study.summary import ParameterErrors, Summary, TrackingErrors, summarise
from diransac.study.trials import run_study

__all__ = [
    "Change", "Drift", "FleetRows", "FleetStatus", "FleetSummary", "FlightChoice", "MethodChoice", "ParameterErrors",
    "ParameterInFleet", "Status", "Study", "Summary", "TrackingErrors", "TrialCounts", "TrialData", "VehicleOutlier",
    "about", "builtin_names", "connected", "export", "fleet_status", "identify_each", "load", "paths", "read",
    "read_fleet", "run_study", "status", "summarise", "summarise_fleet", "template", "trial_data",
]  # fmt: skip
