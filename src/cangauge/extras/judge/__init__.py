"""A second opinion on a battery gauge: is the SoC that it publishes right, since when not, and why.

gauge      what the gauge published: counts, limits, stands and jumps
chain      logs of several days as stretches of blocks
faults     what may be wrong, and the evidence of each
weak       a weak cell, from the cell voltages
judgement  all of it as one judgement
result     its three lines and its JSON
page       the page with both SoCs
command    `cangauge judge`
"""
