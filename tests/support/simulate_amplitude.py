"""Hammer tests of two bodies with nonlinear elements at three force levels, by direct integration, for the tests."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.dof import Dof
from ema_pipeline.frf.estimate import estimate_frfs
from ema_pipeline.frf.settings import FrfSettings
from ema_pipeline.ingest.records import Hit, HitSamples, ResponseChannel
from ema_pipeline.levels import LevelSettings, study_levels
from ema_pipeline.levels.linear import structure
from ema_pipeline.mechanics.assembly import Assembly, Damper, Mass, Nonlinear, Spring
from ema_pipeline.mechanics.laws import PartingSpring
from ema_pipeline.mechanics.nonlinear import nonlinear_response
from ema_pipeline.mechanics.sampling import anti_alias, straightened
from ema_pipeline.mechanics.time_response import time_response
from ema_pipeline.modal.identify import identify
from ema_pipeline.modal.settings import ModalSettings
from ema_pipeline.observations.amplitude import AmplitudeObservations
from ema_pipeline.observations.hit_data import prepare_hits
from ema_pipeline.observations.modes import ModeObservations
from ema_pipeline.rigs.base import ParametricRig
from ema_pipeline.rigs.types import Parameter

RATE = 2048.0
SAMPLES = 3072
TRIGGER = 80
LEVELS = (30.0, 100.0, 300.0)
COORDINATES = ("hub.x", "hub.y", "rim.x", "rim.y")
STRUCK = ("hub.x", "rim.y", "hub.y")
TRUE = {"mass": 1.005, "bearing": 3.9e5, "link": 2.1e5, "modal_damping_ratio": 0.012}
SUBSTEPS = 4


def build(configuration: str, values: Mapping[str, float]) -> Assembly:
    """Two bodies in the plane, hub on a bearing and rim on the hub."""
    elements: list[Mass | Spring | Damper] = []
    for axis, factor, link in (("x", 1.0, "hub-rim mesh"), ("y", 1.3, "hub-rim link")):
        hub, rim = f"hub.{axis}", f"rim.{axis}"
        elements += [
            Mass(f"hub mass {axis}", {hub: 1.0}, values["mass"], "hub"),
            Mass(f"rim mass {axis}", {rim: 1.0}, 0.5, "rim"),
            Spring(f"hub bearing {axis}", {hub: 1.0}, factor * values["bearing"]),
            Spring(f"rim bearing {axis}", {rim: 1.0}, 1e4),
            Spring(link, {hub: 1.0, rim: -1.0}, values["link"]),
        ]
    return Assembly(COORDINATES, tuple(elements), {}, values["modal_damping_ratio"])


RIG = ParametricRig(
    "two bodies",
    ("test",),
    {
        "mass": Parameter("mass", 1.0, "kg", 0.01),
        "bearing": Parameter("bearing", 4e5, "N/m", 0.1),
        "link": Parameter("link", 2e5, "N/m", 0.1),
        "modal_damping_ratio": Parameter("modal_damping_ratio", 0.01, "1", 0.3),
    },
    build,
)


def pulse(peak: float, width_s: float = 2e-3) -> NDArray[np.float64]:
    """Force of a blow, N."""
    t = (np.arange(SAMPLES) - TRIGGER) / RATE
    return np.where(np.abs(t) < width_s / 2, peak * np.cos(np.pi * t / width_s) ** 2, 0.0)


def read_by_analyser(
    assembly: Assembly, rate: float, force: NDArray[np.float64], row: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Accelerations of all coordinates, (4, n_samples), under a band-limited force along a row.

    What the nonlinear elements add to the linear response is read behind an anti-alias filter: a blow between teeth is
    shorter than a sample.
    """
    system, fine_rate, every = assembly.system(), rate * SUBSTEPS, np.eye(len(COORDINATES))
    straight = straightened(force[None], SUBSTEPS)
    linear = time_response(system, fine_rate, straight, every, row).acceleration
    added = nonlinear_response(assembly, fine_rate, straight, every, row).acceleration - linear
    padded = np.pad(added, ((0, 0), (0, added.shape[1])))
    gain = anti_alias(np.fft.rfftfreq(padded.shape[1], 1 / fine_rate), rate)
    read = np.fft.irfft(np.fft.rfft(padded) * gain, padded.shape[1])[:, : added.shape[1]]
    direct = np.linalg.solve(system.mass, row.T)
    return (linear + read)[:, ::SUBSTEPS] + direct * (force - straight[0, ::SUBSTEPS])


def true_assembly(*elements: Nonlinear) -> Assembly:
    """The true rig with elements on top; a parting spring takes the place of its namesake."""
    base = RIG.assembly("test", TRUE)
    for e in elements:
        base = base.edit([e.name], lambda _, e=e: e) if isinstance(e, PartingSpring) else base.add(e)
    return base


def simulated_hits(
    elements: Sequence[Nonlinear] = (), seed: int = 0, hits: int = 2, noise: float = 2e-3, drift: float = 0.0
) -> list[HitSamples]:
    """Records of hits at all levels on `STRUCK`, with accelerometers on all coordinates."""
    random = np.random.default_rng(seed)
    assembly, found = true_assembly(*elements), []
    channels = tuple(ResponseChannel(f"a{c}", Dof.parse(c), "acceleration") for c in COORDINATES)
    for struck in STRUCK:
        row = np.array([[1.0 if c == struck else 0.0 for c in COORDINATES]])
        for level in LEVELS:
            for k in range(hits):
                force = pulse(level * np.exp(0.05 * random.standard_normal()))
                rate = RATE * (1 + drift * random.standard_normal())
                clean = read_by_analyser(assembly, rate, force, row)
                response = clean + noise * random.standard_normal(clean.shape)
                file = f"{struck}_{level:g}_{k}.csv"
                peak = int(np.argmax(force))
                hit = Hit(file, 1, Dof.parse(struck), 0, SAMPLES, peak, float(force[peak]))
                found.append(HitSamples(hit, RATE, force, response, channels))
    return found


def observed(hits: list[HitSamples]) -> AmplitudeObservations:
    """The hits through identification and the study of the levels."""
    frfs = estimate_frfs(hits)
    modal = identify(frfs, ModalSettings())
    study = study_levels(
        lambda: hits, frfs, modal, LevelSettings(), FrfSettings(), ModalSettings(), lambda share, text: None
    )
    assert study.hit_modes is not None
    data = prepare_hits("test", study.hit_modes, structure(modal, study), [k.force_n for k in study.levels])
    assert data is not None
    return AmplitudeObservations(ModeObservations(RIG, [data.reference]), [data])
