"""Studies: grids of Monte-Carlo trials, described by a TOML file, run anywhere, kept in a store that can be resumed.

| file | what it holds |
|---|---|
| `run.py` | `run_study`, the one entry: hand out trials, keep what comes back |
| `specification.py`, `axis.py`, `plants.py`, `flights.py`, `arguments.py`, `tables.py` | what a study is, checked |
| `library.py`, `builtin/`, `template.toml` | where studies come from; those of the paper's figures |
| `trials.py`, `seeds.py` | what a worker does; the seeds of a trial |
| `workers.py`, `cluster.py` | where it does it |
| `store.py` | one SQLite file |
| `reading.py` | what is in it, for tables and pictures |
"""

from diransac.study.cluster import connected
from diransac.study.library import builtin_names, load, template
from diransac.study.reading import Cell, Status, about, export, paths, read, status
from diransac.study.run import run_study
from diransac.study.specification import Method, Study

__all__ = [
    "Cell",
    "Method",
    "Status",
    "Study",
    "about",
    "builtin_names",
    "connected",
    "export",
    "load",
    "paths",
    "read",
    "run_study",
    "status",
    "template",
]
