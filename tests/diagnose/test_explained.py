"""What speaks against a model, and the sentences that say so."""

from dataclasses import replace

import pytest

from ema_pipeline.diagnose import sentences
from ema_pipeline.diagnose.explained import Explanation, OutlyingDamping, OutlyingPart

NOTHING_AGAINST = Explanation(
    telling=(0.9, 60),
    fails=False,
    by_modes=0.0,
    by_scatter=0.0,
    unpaired=False,
    stands_still=False,
    damping=None,
    parts=(),
)
DAMPING, PART = OutlyingDamping(0.8, 0.5), OutlyingPart("m2 (mass)", 0.23, 0.01)


@pytest.mark.parametrize(
    "against",
    [
        replace(NOTHING_AGAINST, fails=True),
        replace(NOTHING_AGAINST, unpaired=True),
        replace(NOTHING_AGAINST, stands_still=True),
        replace(NOTHING_AGAINST, damping=DAMPING),
    ],
)
def test_one_thing_that_speaks_against_a_model_is_enough(against: Explanation) -> None:
    assert NOTHING_AGAINST.explained
    assert not against.explained


def test_parts_that_stand_out_speak_against_a_model_only_where_it_fails_without_them() -> None:
    assert replace(NOTHING_AGAINST, parts=(PART,)).explained


def test_every_reason_is_told_once_and_nothing_without_one() -> None:
    assert sentences.reasons(NOTHING_AGAINST, 0.9) == ""
    told = sentences.reasons(Explanation((1.6, 60), True, 2.1, 1.6, False, True, DAMPING, (PART,)), 1.2)
    for part in (
        "Modes move with the force",
        "modes alone is 2.10",
        "error is 1.60",
        "80 %",
        "m2 (mass) +23 %",
    ):
        assert told.count(part) == 1


def test_the_error_of_the_modes_alone_is_told_only_where_that_of_all_hides_it() -> None:
    found = replace(NOTHING_AGAINST, fails=True, by_modes=1.8)
    assert "modes alone" in sentences.reasons(found, 1.2)
    assert "modes alone" not in sentences.reasons(found, 1.9)
