"""Open-loop prediction of logs, by which `identify` and `validate` score and judge alike.

| file | contents |
|---|---|
| `horizons.py` | scores of the horizons that suit the logs, and the one that is judged |
| `open_loop.py` | windows of a log, errors of their predictions beside trivial ones, simulations |
| `starts.py` | initial states of windows, from the samples before them |
| `inverse.py` | forces that the motion needs, beside those of the inputs |
"""
