"""From a raw folder to records in SI units: test description, readers per format, scaling, drafting."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ema_pipeline.ingest.campaign import Campaign, read_campaign
from ema_pipeline.ingest.description import (
    ChannelDescription,
    RecordDescription,
    TestDescription,
    read_description,
)
from ema_pipeline.lazy import lazy_names

if TYPE_CHECKING:
    from ema_pipeline.ingest.draft import draft_description, write_drafts
    from ema_pipeline.ingest.load import load_channels, load_record, load_records
    from ema_pipeline.ingest.readers import read_raw
else:
    __getattr__ = lazy_names(
        __name__,
        {
            "draft_description": "draft",
            "write_drafts": "draft",
            "load_channels": "load",
            "load_record": "load",
            "load_records": "load",
            "read_raw": "readers",
        },
    )

__all__ = [
    "Campaign",
    "ChannelDescription",
    "RecordDescription",
    "TestDescription",
    "draft_description",
    "load_channels",
    "load_record",
    "load_records",
    "read_campaign",
    "read_description",
    "read_raw",
    "write_drafts",
]
