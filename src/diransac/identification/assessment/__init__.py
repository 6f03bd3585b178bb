"""Assessment: what a user asks beside identification, of a log before it, and of a model after it.

`inspection` of a log; `validation` and `cross_validation` on held-out logs, by open-loop prediction (package
`prediction`); `open_loop`, the simulation of a model as a log.  Everything below may be used here, and nothing below
uses it.  Begin with `validation`.
"""
