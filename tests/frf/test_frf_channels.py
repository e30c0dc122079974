"""What a test says of its sensors' calibration reaches whoever asks for it by DOF."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from frf_hits import clean_hits
from ingest_example import DESCRIPTION, make_test

from ema_pipeline import codec
from ema_pipeline.dof import Dof
from ema_pipeline.frf import (
    ChannelQuality,
    FrfSet,
    FrfSettings,
    channel_uncertainty,
    estimate_frfs,
    hammer_uncertainty,
)
from ema_pipeline.frf.channels import InTurn, StruckPoint, merged, moved_sensors
from ema_pipeline.ingest.description import read_description
from ema_pipeline.ingest.hit_checks import hits_of_test
from ema_pipeline.ingest.load import load_records
from ema_pipeline.ingest.records import HitSamples, ResponseChannel, cut_hit
from ema_pipeline.store import Store

DEFAULT = ChannelQuality("", 0.02, 0.03)
TIP = Dof("tip", "z")


def frfs_of_folder(folder: Path) -> FrfSet:
    records = list(load_records(read_description(folder)))
    hits = [cut_hit(records[0], h) for h in hits_of_test(records)]
    return estimate_frfs(hits, FrfSettings())


def with_channel(hit: HitSamples, **stated: float | str) -> HitSamples:
    """The hit, its second channel changed."""
    return replace(hit, channels=(hit.channels[0], replace(hit.channels[1], **stated)))


def test_what_a_test_states_is_found_by_dof(tmp_path: Path) -> None:
    text = DESCRIPTION.replace('unit = "N"', 'unit = "N"\ncalibration_std = 0.05\ntransverse = 0.1')
    text = text.replace('dof = "tip.z"', 'dof = "tip.z"\ncalibration_std = 0.01\ntransverse = 0.0', 1)
    frfs = frfs_of_folder(make_test(tmp_path, text))
    assert channel_uncertainty(frfs, TIP) == ChannelQuality("tip", 0.01, 0.0)
    assert channel_uncertainty(frfs, Dof("tip", "z", -1)) == ChannelQuality("tip", 0.01, 0.0)
    assert hammer_uncertainty(frfs) == ChannelQuality("hammer", 0.05, 0.1)


def test_what_is_not_stated_is_never_exact(tmp_path: Path) -> None:
    frfs = frfs_of_folder(make_test(tmp_path))
    assert channel_uncertainty(frfs, TIP) == replace(DEFAULT, name="tip")
    assert hammer_uncertainty(frfs) == replace(DEFAULT, name="hammer")
    assert channel_uncertainty(frfs, Dof("elsewhere", "z")) == DEFAULT
    assert channel_uncertainty(None, TIP) == DEFAULT
    assert hammer_uncertainty(None) == DEFAULT
    older = replace(frfs, channels=(), hammer=None)
    assert channel_uncertainty(older, TIP) == DEFAULT
    assert hammer_uncertainty(older) == DEFAULT


def test_a_roving_sensor_keeps_its_name_and_two_sensors_at_one_dof_are_never_better_than_either() -> None:
    one, two, three = clean_hits(3, 512)
    roving = replace(
        two,
        channels=(
            ResponseChannel("a0", Dof("p2", "z"), "acceleration", calibration_std=0.01),
            ResponseChannel("b", Dof("p1", "z"), "acceleration", calibration_std=0.05, transverse=0.01),
        ),
    )
    frfs = estimate_frfs([with_channel(one, calibration_std=0.03), roving, three], FrfSettings())
    assert moved_sensors(frfs) == {"a0"}
    shared = replace(frfs, channels=tuple(ChannelQuality(n) for n in ("a0", "a1 + a0", "a2")))
    assert moved_sensors(shared) == {"a0"}
    assert channel_uncertainty(shared, Dof("p1", "z")) == InTurn("a1 + a0")
    at = {d.point: channel_uncertainty(frfs, d) for d in frfs.outputs}
    assert at["p0.z"].name == at["p2.z"].name == "a0"
    assert at["p2.z"] == InTurn("a0", 0.01, 0.03)
    assert merged(at["p2.z"], at["p1.z"]) == InTurn("a0 + a1 + b", 0.05, 0.03)
    assert at["p1.z"] == ChannelQuality("a1 + b", 0.05, 0.03)


def test_a_dof_that_was_only_struck_has_the_hammers_gain() -> None:
    hits = [replace(h, force_name="hammer", force_calibration_std=0.07) for h in clean_hits(2, 512)]
    moved = replace(hits[1], hit=replace(hits[1].hit, impact=Dof("p9", "z")))
    frfs = estimate_frfs([hits[0], moved], FrfSettings())
    assert channel_uncertainty(frfs, Dof("p9", "z")) == StruckPoint("hammer", 0.07, 0.03)
    assert channel_uncertainty(frfs, Dof("p0", "z")).name == "a0"


def test_two_blows_8_degrees_off_are_read_as_far_off_as_is_stated() -> None:
    off = np.deg2rad(8) * np.random.default_rng(1).standard_normal((2, 2, 20000))  # directions, blows, DOFs
    assert StruckPoint.off_direction == pytest.approx(np.std(off.mean(axis=1)), rel=0.03)
    acting = np.cos(np.linalg.norm(off, axis=0)).mean(axis=0)
    assert InTurn.aim == pytest.approx(np.std(np.log(acting)), rel=0.05)


@pytest.mark.parametrize("known", [True, False])
def test_the_store_keeps_it(tmp_path: Path, known: bool) -> None:
    frfs = estimate_frfs(clean_hits(2, 512), FrfSettings())
    if not known:
        frfs = replace(frfs, channels=(), hammer=None)
    store = Store(tmp_path)
    with store.changing() as file:
        codec.write(file, "frfs", frfs)
    with store.reading() as file:
        again: FrfSet = codec.read(file, "frfs", FrfSet)
    assert again.channels == frfs.channels
    assert again.hammer == frfs.hammer
