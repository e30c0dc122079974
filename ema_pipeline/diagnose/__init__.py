"""Diagnosis: which physics is the model missing, how sure is that, and what should be measured next."""

from typing import TYPE_CHECKING

from ema_pipeline.lazy import lazy_names

if TYPE_CHECKING:
    from ema_pipeline.diagnose.diagnosis import diagnose
    from ema_pipeline.diagnose.ladder import make_ladder
    from ema_pipeline.diagnose.settings import DiagnoseSettings
    from ema_pipeline.diagnose.types import Candidate, Diagnosis, EffectSize, Ladder, Localisation, Rung
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "diagnose": "diagnosis",
            "make_ladder": "ladder",
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
    "diagnose",
    "make_ladder",
]
