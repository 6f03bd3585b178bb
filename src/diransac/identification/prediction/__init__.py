"""Open-loop prediction of logs: `starts` of windows, their scores in `open_loop`, which horizons are scored and judged.

`identify` and `validate` score and judge by the same functions.
"""
