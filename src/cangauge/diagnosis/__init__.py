"""Diagnosis of the gap between a model and a log: where, which effect, how far it shrinks.

What follows what, and where::

    diagnose       logs, model file, references → Diagnosis: all of the below
      settle       → Settled: everything that is the same for all verdicts
        columns      a log → LogTerms: its residual, and how that moves with every amplitude
        frame        the candidates: which are structure, which a log's own, where their columns are
        evidence     LogTerms → Gram (products, by time scale) → Evidence (all but effects
                     integrated out)
        references   references → ErrorModel: error by time scale, how much logs differ, how far
                     healthy logs stray; with levels, thinned, covered
        learned      references → the model as they know it, and its structure; with structure
      verdict      → Verdict: an effect, none or unknown
        compared     Evidence → Compared: each effect looked at in six ways; with scores, remainder
        belief       Compared → Belief: the six weighed, as probabilities
      held_out     errors with and without the cause, on rows that its fit did not see
      extend       → Extension: the model with the cause; with at_cause, at_moment, bounded
      where, maps, moments, before_after, soc_error, limits: what the page shows

Words: a *candidate* is one effect at one shape (a time constant, say), its *amplitudes* are what
the voltage follows linearly. *Structure* is what healthy days share beyond the voltage model, *own*
what each of them has of its own. A log's *baseline* is the voltage model's coefficients; *as given*
is the model of the file. References *stray* by what they bring up though they are healthy.
"""
