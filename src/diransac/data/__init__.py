"""Logs of machines: reading, preparation, and the dataset that a method is given.

In come files and arrays; out come a `Log`, or logs that are bound to a model, a `Dataset`.  Begin with `log.py`, then
`dataset.py`.

| file | contents |
|---|---|
| `readers/` | `read_log`; a file per format |
| `preprocessing/` | steps from a log to a log |
| `log.py`, `files.py` | `Log`; its columns and metadata as a file |
| `clock.py`, `checks.py` | the uniform grid of a log; requirements of its columns |
| `units.py`, `filters.py` | factors between units; the low-pass filter, a field of a log |
| `mapping.py`, `mapping_file.py` | fields of topics as signals of a model; the file of a mapping |
| `suggested_mapping.py` | a first guess of a mapping |
| `dataset.py`, `segment.py` | `Dataset`, logs bound to a model; `Segment`, one of them as arrays |
| `input_timing.py` | inputs after delays and lags |
"""
