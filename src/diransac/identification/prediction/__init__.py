"""Open-loop prediction of logs, by which `identify` and `validate` score and judge alike.

| file | contents |
|---|---|
| `horizons.py` | the horizons that are scored, and the one that is judged |
| `starts.py` | initial states of windows, from the samples before them |
| `open_loop.py` | scores of predictions beside trivial ones |
"""
