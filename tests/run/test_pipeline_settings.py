"""Which stages a pipeline may name."""

from __future__ import annotations

import pytest

from ema_pipeline.errors import EmaError
from ema_pipeline.run.settings import load_pipeline


def test_a_pipeline_runs_the_stages_that_it_names() -> None:
    assert load_pipeline("default", ['stages=["ingest", "hits"]']).stages == ("ingest", "hits")


@pytest.mark.parametrize(
    ("stages", "said"),
    [
        ("[]", r"stages = \[\]: name one or more of ingest, hits, frf"),
        ('["modl"]', "unknown stage 'modl' .did you mean 'modal'"),
    ],
)
def test_no_stage_and_one_that_does_not_exist_are_refused(stages: str, said: str) -> None:
    with pytest.raises(EmaError, match=said):
        load_pipeline("default", [f"stages={stages}"])


def test_the_rig_of_a_test_is_no_setting() -> None:
    with pytest.raises(EmaError, match=r"--set rig=planetary: name the rig of a test with --rig"):
        load_pipeline("default", ["rig=planetary"])
