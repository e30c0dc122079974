"""Measured modes that are none of a rig's model: it ends below them.

Every structure has modes of its bodies above those of a model of a few of them.
"""

from __future__ import annotations

import dataclasses

import numpy as np

from ema_pipeline.correlate.pairing import RIGID_HZ
from ema_pipeline.observations.mode_data import ModeData
from ema_pipeline.rigs.base import model_modes
from ema_pipeline.rigs.types import Rig

REACH = 1.3
"""Factor within which a natural frequency of the model and the measured one lie: about that of the pairing."""


def within_reach(data: ModeData, rig: Rig) -> ModeData:
    """The modes without those above the reach of the rig's model, and the band that ends below these.

    An effect that is missing may have lifted the model's highest modes there: then too few were measured where they
    are in the model, and all stay.
    """
    model_hz = np.array([mode.frequency_hz for mode in model_modes(rig, data.configuration)])
    highest = float(model_hz.max(initial=0.0))
    hz = np.exp(data.log_frequency)
    beyond = hz > REACH * highest
    if highest < RIGID_HZ or not beyond.any():
        return data
    top = highest / REACH
    if np.count_nonzero((hz > top) & ~beyond) < np.count_nonzero(model_hz > top):
        return data
    band = data.band_hz[0], min(data.band_hz[1], float(hz[beyond].min()))
    kept = data.only(~beyond)
    return dataclasses.replace(kept, complete=data.complete, band_hz=band, whole=None, kept=None)
