"""Samples → estimate: Coulomb counting, inverse, fusion."""
