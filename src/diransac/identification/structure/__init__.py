"""Structure: what a model and a log can determine, and what is wrong with either.

In: a model, a dataset or its rows of motions.  Out: sentences, candidate terms, refusals.  Begin with
`identifiability.py`.

| file | contents |
|---|---|
| `structural.py`, `identifiability.py` | ambiguous parameters: of equations, of logs |
| `free_units.py`, `equivalents.py` | parameters that are known up to a factor; others with the same transfer function |
| `known_parameters.py` | fixed parameters and priors |
| `prospects.py` | what least squares of all rows tells before a search |
| `refusal.py`, `columns.py` | causes of refusals; units and signs of columns |
| `column_corrections.py` | corrections of columns, tested by held-out rows of the equations |
| `candidate_terms.py`, `lacking_terms.py` | terms that a model may lack; those that are found, in words |
"""
