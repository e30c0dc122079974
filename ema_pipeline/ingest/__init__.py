"""From a raw folder to records in SI units: test description, readers per format, scaling, drafting."""

from __future__ import annotations

from ema_pipeline.ingest.campaign import Campaign, read_campaign
from ema_pipeline.ingest.description import (
    ChannelDescription,
    RecordDescription,
    TestDescription,
    read_description,
)
from ema_pipeline.ingest.draft import draft_description, write_drafts
from ema_pipeline.ingest.load import load_channels, load_record, load_records
from ema_pipeline.ingest.readers import read_raw

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
