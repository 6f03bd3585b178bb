"""Structure: what a model and a log can determine, and what is wrong with either.

In: a model, a dataset or its rows of motions.  Out: ambiguous parameters in words (`structural` of equations,
`identifiability` of logs), parameters that are known beforehand, causes of refusals, mistakes of columns, and terms
that a model may lack: candidates, and sentences about those that are found.  Begin with `identifiability`.
"""
