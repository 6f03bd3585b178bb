"""Identification: dataset -> method -> estimate -> evaluation, and the results that users see.

`identify` takes a model and logs and returns a `Result`.  It binds them (`Dataset`), lets a `Method` fit an `Estimate`
with its `Diagnosis`, and evaluates that.  Rooms, from below: `regression`, `structure`, `evaluation`, `methods`,
`assessment`.  Begin with `identify`.
"""
