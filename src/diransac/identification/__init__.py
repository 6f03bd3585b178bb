"""Identification: dataset -> method -> estimate -> evaluation, and the results that users see.

In come a model and logs; out comes a `Result`.  Begin with `identify.py`, which binds them (`Dataset`), lets a `Method`
fit an `Estimate` with its `Diagnosis`, and evaluates that.

| file | contents |
|---|---|
| `identify.py` | `identify` |
| `method.py`, `settings.py` | the protocol of a method; `Settings` |
| `estimate.py`, `diagnosis.py`, `finding.py` | what a method returns: parameters; noise and forces; sentences |
| `result.py`, `result_text.py`, `result_files.py` | `Result`; as text; as files |
| `serialization.py` | JSON of dataclasses by their annotations |
| `core/` | the estimator: windows, unknowns, equations, the one loop |
| `regression/` | parameters from rows of equations |
| `structure/` | what a model and a log determine; terms that a model may lack |
| `evaluation/` | an estimate against its logs; findings |
| `methods/` | the methods |
| `prediction/` | open-loop prediction of logs, of `identify` and `validate` alike |
| `assessment/` | inspection of logs, validation of models |
| `tracking/` | parameters of a machine while it runs |
"""
