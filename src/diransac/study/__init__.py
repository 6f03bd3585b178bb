"""Studies: grids of Monte-Carlo trials, described by a TOML file, run anywhere, kept in a store that can be resumed.

| file | what it holds |
|---|---|
| `run.py` | `run_study`, the one entry: hand out trials, keep what comes back |
| `specification.py`, `axis.py`, `flights.py`, `arguments.py`, `tables.py` | what a study is, checked |
| `plants.py`, `vehicles.py` | what may fly: the paper's rotorcraft, other machines, users' own |
| `library.py`, `builtin/`, `template.toml` | where studies come from; those of the paper's figures |
| `recording.py`, `judging.py`, `seeds.py` | the data of a trial; what estimates are judged against; seeds |
| `trials.py` | what a worker does |
| `workers.py`, `cluster.py` | where it does it |
| `store.py`, `facts.py` | one SQLite file |
| `reading.py`, `summary.py` | what is in it, and what it says, for tables and pictures |
"""

from diransac.study.cluster import connected
from diransac.study.library import builtin_names, load, template
from diransac.study.reading import Cell, Status, about, export, paths, read, status
from diransac.study.recording import Recording, record
from diransac.study.run import run_study
from diransac.study.specification import Method, Study
from diransac.study.summary import Estimates, Flights, Summary, summarise

__all__ = [
    "Cell",
    "Estimates",
    "Flights",
    "Method",
    "Recording",
    "Status",
    "Study",
    "Summary",
    "about",
    "builtin_names",
    "connected",
    "export",
    "load",
    "paths",
    "read",
    "record",
    "run_study",
    "status",
    "summarise",
    "template",
]
