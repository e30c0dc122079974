"""Measured modes of one configuration together with the family of models that they are held against."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ema_pipeline.correlate.evidence import Evidence, gather
from ema_pipeline.correlate.measured import MeasuredModes
from ema_pipeline.fit.matrices import MatrixFamily
from ema_pipeline.fit.settings import FitSettings


@dataclass(frozen=True)
class Dataset(Evidence):
    """One configuration: its evidence, and its matrices over the parameter space."""

    family: MatrixFamily


def dataset(measured: MeasuredModes, family: MatrixFamily, settings: FitSettings) -> Dataset:
    """Prepare one configuration; damping ratios are left out where the settings say so."""
    if not settings.damping:
        unknown = np.full(measured.frequency_hz.shape, np.nan)
        measured = replace(measured, damping_ratio=unknown, damping_std=unknown)
    evidence = gather(measured, family.system, settings)
    return Dataset(**vars(evidence), family=family)
