"""Identification: recorded logs → model.

`rows` picks the rows of a log, `least_squares` sums and solves the curve of knots with its prior,
`published` the published equation, `starts` estimates unknown starts, `effect_search` selects
effects; `fit` is the face.
"""
