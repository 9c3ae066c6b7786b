"""The estimator's bench on a small simulated pack, and on the recorded ones where they are."""

from __future__ import annotations
