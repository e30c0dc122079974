"""Diagnosis: which physics is the model missing, how sure is that, and what should be measured next."""

from typing import TYPE_CHECKING

from ema_pipeline.lazy import lazy_names

if TYPE_CHECKING:
    from ema_pipeline.diagnose.diagnosis import diagnose
    from ema_pipeline.diagnose.ladder import add_effect, climb, make_ladder, remove_effect
    from ema_pipeline.diagnose.settings import DiagnoseSettings
    from ema_pipeline.diagnose.types import Candidate, Diagnosis, EffectSize, Ladder, Localisation, Rung
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "diagnose": "diagnosis",
            "add_effect": "ladder",
            "climb": "ladder",
            "make_ladder": "ladder",
            "remove_effect": "ladder",
            "DiagnoseSettings": "settings",
            "Candidate": "types",
            "Diagnosis": "types",
            "EffectSize": "types",
            "Ladder": "types",
            "Localisation": "types",
            "Rung": "types",
        },
    )

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
