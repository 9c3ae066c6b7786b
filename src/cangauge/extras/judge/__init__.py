"""A second opinion on a battery gauge: is the SoC that it publishes right, since when not, and why.

chain      logs of several days as one linear Gaussian model
causes     what may be wrong, and the evidence of each
weak       a weak cell, from the cell voltages
judgement  all answers as one judgement
result     its sentences and its JSON
page       the page with both SoCs
command    `cangauge judge`
"""
