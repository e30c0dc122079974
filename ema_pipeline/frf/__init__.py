"""Hits to frequency response functions with coherence, variance and verdicts."""

from typing import TYPE_CHECKING

from ema_pipeline.lazy import lazy_names

if TYPE_CHECKING:
    from ema_pipeline.frf.channels import ChannelQuality, channel_uncertainty, hammer_uncertainty
    from ema_pipeline.frf.estimate import estimate_frfs
    from ema_pipeline.frf.settings import FrfSettings
    from ema_pipeline.frf.types import FrfSet
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "ChannelQuality": "channels",
            "channel_uncertainty": "channels",
            "hammer_uncertainty": "channels",
            "estimate_frfs": "estimate",
            "FrfSettings": "settings",
            "FrfSet": "types",
        },
    )

__all__ = [
    "ChannelQuality",
    "FrfSet",
    "FrfSettings",
    "channel_uncertainty",
    "estimate_frfs",
    "hammer_uncertainty",
]
