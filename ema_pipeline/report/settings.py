"""Settings of the report."""

from __future__ import annotations

from pydantic import Field

from ema_pipeline.settings import Settings


class ReportSettings(Settings):
    """What is written beside the tables and the report."""

    plots: bool = Field(False, description="also draw every figure for print, as PNG and SVG, into plots/")
