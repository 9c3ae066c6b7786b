"""The estimator of a model: in C where the compiled step knows it, else in Python."""

from __future__ import annotations

from cangauge.estimation.estimator import Estimator
from cangauge.estimation.settings import EstimatorSettings
from cangauge.model.model_file import Model


def make_estimator(model: Model, settings: EstimatorSettings | None = None) -> Estimator:
    """Return the estimator of a model.

    Parameters
    ----------
    model : Model
    settings : EstimatorSettings, optional
    """
    return Estimator(model, settings)
