"""Diagnosis: which physics is the model missing, how sure is that, and what should be measured next."""

from ema_pipeline.diagnose.diagnose import diagnose
from ema_pipeline.diagnose.ladder import add_effect, climb, make_ladder, remove_effect
from ema_pipeline.diagnose.settings import DiagnoseSettings
from ema_pipeline.diagnose.types import Candidate, Diagnosis, EffectSize, Ladder, Localisation, Rung

__all__ = [
    "Candidate",
    "DiagnoseSettings",
    "Diagnosis",
    "EffectSize",
    "Ladder",
    "Localisation",
    "Rung",
    "add_effect",
    "climb",
    "diagnose",
    "make_ladder",
    "remove_effect",
]
