"""A second opinion on a battery gauge: is the SoC that it publishes right, since when not, and why.

gauge      what the gauge published: counts, limits, stands and jumps
chain      logs of several days as stretches of blocks
faults     what may be wrong, as columns of a linear model; its table is faults.toml
linearised the linear model of all logs, at given coefficients
explain    which sets of faults explain the logs, each with its probability
weak       a weak cell, from the cell voltages
judgement  all of it as one judgement
result     what a judgement holds, and its JSON
text       its three lines
page       the page with both SoCs
command    `cangauge judge`
live       `[judge]` of the service
suite      `cangauge judge --suite`: drives with faults, played to a gauge
"""
