"""Simulated hammer tests of a rig with known truth, written as raw folders."""

from ema_pipeline.simulate.campaign import SimulatedCampaign, simulate_campaign
from ema_pipeline.simulate.settings import RecordFormat, SimulationSettings

__all__ = ["RecordFormat", "SimulatedCampaign", "SimulationSettings", "simulate_campaign"]
