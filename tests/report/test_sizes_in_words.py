"""Sizes of effects in words, in sentences as in tables."""

from __future__ import annotations

from ema_pipeline.diagnose.sentences import size_text
from ema_pipeline.diagnose.types import EffectSize
from ema_pipeline.report.diagnosis import size_words


def test_sentences_and_tables_write_a_size_alike() -> None:
    sizes = {
        "spring@m1.stiffness": EffectSize(-1.543e4, 1.3e3, "N/m"),
        "out_of_tolerance@k.relative_change": EffectSize(0.02145, 0.0018, "1"),
    }
    assert size_text(sizes) == "stiffness −15.4 ± 1.3 kN/m, relative change 0.0215 ± 0.0018"
    own = {name.rpartition(".")[2]: size for name, size in sizes.items()}
    assert size_words(own, ", ") == size_text(sizes)


def test_a_size_that_the_data_do_not_determine_is_not_given() -> None:
    sizes = {
        "mesh_backlash@m.preload": EffectSize(2.7e-7, 6e-9, "m"),
        "mesh_backlash@m.gap": EffectSize(1e-4, 3.2, "m"),
    }
    assert size_text(sizes) == "preload 270.0 ± 6.0 nm, gap not determined by these data"
    assert "gap not determined by these data" in size_words(sizes)
    sizes["mesh_backlash@m.gap"] = EffectSize(1e-4, 1.2e-4, "m", learned=False)
    assert size_text(sizes) == "preload 270.0 ± 6.0 nm, gap not determined by these data"
    assert "force 0.0 ± 1.4 N" in size_words({"dry_friction@m.force": EffectSize(0.0, 1.4, "N")})
