"""A small made-up run for the report's tests: a planetary gear, FRFs and modes with seeded noise."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ema_pipeline.check_result import CheckResult
from ema_pipeline.correlate.types import (
    BandDifference,
    Comparison,
    DofDifference,
    ModeDifference,
    Pair,
    Pairing,
    Unpaired,
)
from ema_pipeline.dof import Dof
from ema_pipeline.fit.types import ErrorSweep, FitResult, ParameterEstimate, StepwiseEstimate
from ema_pipeline.frf.types import FrfSet
from ema_pipeline.ingest.records import Hit
from ema_pipeline.mechanics.system import LinearSystem
from ema_pipeline.modal.types import CircleFit, ModalModel, Mode, StabilisationChart
from ema_pipeline.report.results import ConfigurationResults, RunResults
from ema_pipeline.rigs.types import ModelMode

PLANETS = 4


def planetary(ring: bool, mesh: float = 1e7) -> LinearSystem:
    bodies = ["carrier", "ring", "sun"] if ring else ["carrier", "sun"]
    dofs = [f"{b}.{d}" for b in bodies for d in ("x", "y", "u")]
    dofs += [f"planet{n}.{d}" for n in range(1, PLANETS + 1) for d in ("zeta", "eta", "u")]
    at = {d: i for i, d in enumerate(dofs)}
    mass = {"carrier": 5.4, "ring": 2.35, "sun": 0.4, "planet": 0.66}
    m = np.diag([mass[d.split(".")[0].rstrip("0123456789")] for d in dofs])
    k = np.zeros((len(dofs), len(dofs)))

    def spring(stiffness: float, **terms: float) -> None:
        v = np.zeros(len(dofs))
        for name, factor in terms.items():
            v[at[name.replace("__", ".")]] = factor
        k[:] += stiffness * np.outer(v, v)

    alpha = np.deg2rad(24.6)
    for b in bodies:
        spring(2e6, **{f"{b}__x": 1.0})
        spring(2.2e6, **{f"{b}__y": 1.0})
        spring(1e5, **{f"{b}__u": 1.0})
    for n in range(1, PLANETS + 1):
        psi, p = 2 * np.pi * (n - 1) / PLANETS, f"planet{n}__"
        s, r = psi - alpha, psi + alpha
        spring(
            mesh,
            sun__x=-np.sin(s),
            sun__y=np.cos(s),
            sun__u=1.0,
            **{p + "zeta": -np.sin(alpha), p + "eta": -np.cos(alpha), p + "u": 1.0},
        )
        if ring:
            spring(
                1.5 * mesh,
                ring__x=-np.sin(r),
                ring__y=np.cos(r),
                ring__u=1.0,
                **{p + "zeta": np.sin(alpha), p + "eta": -np.cos(alpha), p + "u": -1.0},
            )
        spring(8e6, carrier__x=np.cos(psi), carrier__y=np.sin(psi), **{p + "zeta": -1.0})
        spring(8e6, carrier__x=-np.sin(psi), carrier__y=np.cos(psi), carrier__u=1.0, **{p + "eta": -1.0})
    sensors = {}
    for n in range(1, PLANETS + 1):
        psi = 2 * np.pi * (n - 1) / PLANETS
        for d, (c, e) in {"x": (np.cos(psi), -np.sin(psi)), "y": (np.sin(psi), np.cos(psi))}.items():
            row = np.zeros(len(dofs))
            row[at[f"planet{n}.zeta"]], row[at[f"planet{n}.eta"]] = c, e
            sensors[f"planet{n}.{d}"] = row
    zero = np.zeros_like(k)
    return LinearSystem(tuple(dofs), m, k, zero, zero, 0.01, sensors)


def model_modes(system: LinearSystem) -> tuple[ModelMode, ...]:
    root = np.sqrt(np.diag(system.mass))
    w2, v = np.linalg.eigh(system.stiffness / np.outer(root, root))
    return tuple(
        ModelMode(
            i, float(np.sqrt(max(w, 0)) / 2 / np.pi), 0.01, "translational" if i % 3 else "rotational", s
        )
        for i, (w, s) in enumerate(zip(w2, (v / root[:, None]).T, strict=True))
    )


def sensor_rows(system: LinearSystem, dofs: tuple[Dof, ...]) -> NDArray[np.float64]:
    unit = {d: np.eye(len(system.dofs))[i] for i, d in enumerate(system.dofs)}
    return np.array([(unit | system.sensors)[d.point] for d in dofs])


def synthesise(
    modes: list[Mode], f: NDArray[np.float64], outputs: list[int], inputs: list[int]
) -> NDArray[np.complex128]:
    w = 2 * np.pi * f
    h = np.zeros((len(outputs), len(inputs), f.size), complex)
    for mode in modes:
        phi = np.nan_to_num(mode.shape)
        a = np.multiply.outer(phi[outputs], phi[inputs]) / (2j * mode.pole.imag)
        h += a[..., None] / (1j * w - mode.pole) + a.conj()[..., None] / (1j * w - mode.pole.conjugate())
    return -(w**2) * h


def circle(modes: list[Mode], mode: Mode, out: int, inp: int, dofs: tuple[Dof, ...], rng) -> CircleFit:
    half = 4 * mode.damping_ratio * mode.frequency_hz
    f = np.linspace(mode.frequency_hz - half, mode.frequency_hz + half, 25)
    h = synthesise(modes, f, [out], [inp])[0, 0] / (2j * np.pi * f)
    h = h + 0.01 * np.abs(h).max() * (rng.normal(size=f.size) + 1j * rng.normal(size=f.size))
    a = np.c_[h.real, h.imag, np.ones(f.size)]
    x, y, c = np.linalg.lstsq(a, np.abs(h) ** 2, rcond=None)[0]
    radius = np.sqrt(c + (x / 2) ** 2 + (y / 2) ** 2)
    pairs = mode.damping_ratio * (1 + 0.05 * rng.normal(size=60))
    centre = complex(x / 2, y / 2)
    sweep = 1 / (1 + 1j * (f / mode.frequency_hz - mode.frequency_hz / f) / (2 * mode.damping_ratio)) - 0.5
    turned = complex(np.sum((h - centre) * sweep.conj()))
    return CircleFit(
        dofs[out],
        dofs[inp],
        f,
        h,
        centre,
        float(radius),
        mode.frequency_hz * (1 + 2e-4 * float(rng.normal())),
        0.03,
        float(pairs.mean()),
        float(pairs.std()),
        pairs,
        float(np.std(np.abs(h - centre) - radius) / radius),
        2 * float(radius) * turned / abs(turned),
        mode.damping_ratio,
    )


def configuration(
    name: str, ring: bool, seed: int = 1, one_hit: bool = False, lines: int = 4097
) -> ConfigurationResults:
    rng = np.random.default_rng(seed)
    system = planetary(ring, 1.05e7)
    truth = model_modes(planetary(ring))
    bodies = ["carrier", "ring", "sun"] if ring else ["carrier", "sun"]
    names = [f"{b}.{d}" for b in bodies for d in "xy"] + [
        f"planet{n}.{d}" for n in range(1, PLANETS + 1) for d in "xy"
    ]
    names.remove("planet3.y")
    dofs = tuple(Dof.parse(n) for n in names)
    rows = sensor_rows(planetary(ring), dofs)
    f = np.linspace(0, 2000.0, lines)
    modes: list[Mode] = []
    for t in truth:
        if not 20 < t.frequency_hz < 1800:
            continue
        shape = (rows @ t.shape) * np.exp(0.03j * rng.normal(size=len(dofs)))
        std = np.full(len(dofs), 0.03 * np.abs(shape).max())
        shape = shape + std * (rng.normal(size=len(dofs)) + 1j * rng.normal(size=len(dofs)))
        w, z = 2 * np.pi * t.frequency_hz, 0.01 * (1 + 0.1 * float(rng.normal()))
        pole = complex(-z * w, w * np.sqrt(1 - z * z))
        modes.append(
            Mode(
                t.frequency_hz,
                3e-4 * t.frequency_hz,
                z,
                0.03 * z,
                pole,
                shape,
                std,
                0.98,
                "plscf",
                0.8,
                ("circle fit differs: close neighbour",) if t.index == 4 else (),
            )
        )
    inputs = [0, 1, 4, 6]
    h = synthesise(modes, f, list(range(len(dofs))), inputs)
    level = 0.003 * np.abs(h).max(axis=2, keepdims=True)
    h = h + level * (rng.normal(size=h.shape) + 1j * rng.normal(size=h.shape))
    h[5, 3] = np.nan
    noise = np.broadcast_to(2 * level**2, h.shape)
    coherence = np.clip(np.abs(h) ** 2 / (np.abs(h) ** 2 + 5 * noise * rng.chisquare(4, h.shape) / 4), 0, 1)
    if one_hit:
        coherence, noise = np.full(h.shape, np.nan), np.full(h.shape, np.nan)
    modes = [
        replace(
            m,
            circles=tuple(
                circle(modes, m, o, i, dofs, rng) for o, i in ((0, 0), (1, 1), (4, 4), (6, 6), (7, 0))
            ),
        )
        for m in modes
    ]
    band = (f > 20) & (f < 1800)
    picks = tuple(dofs[i] for i in inputs)
    frfs = FrfSet(
        f,
        h,
        coherence,
        np.array(noise),
        dofs,
        picks,
        ("acceleration",) * len(dofs),
        np.where(np.isnan(h[..., 0]), 0, 1 if one_hit else 5),
        "H1",
        0.5,
        0.0,
        np.zeros(4),
        (20.0, 1800.0),
        True,
        np.zeros(len(dofs)),
        (
            CheckResult(
                "reciprocity",
                0.11,
                0.05,
                "1",
                False,
                "ISO 7626-5:2019, 8.3",
                "warn",
                "sun.x",
                "sun.x ↔ carrier.x differ by 11 %",
            ),
        ),
    )
    orders = np.arange(6, 61, 2)
    o, p, z, s, sel = [], [], [], [], []
    for order in orders:
        for i, m in enumerate(modes):
            if order > 10 + 2 * i:
                (
                    o.append(order),
                    p.append(m.frequency_hz * (1 + 1e-3 * rng.normal())),
                    z.append(m.damping_ratio),
                )
                s.append(True), sel.append(i if order > 14 + 2 * i else -1)
        for x in rng.uniform(20, 1800, order // 6):
            o.append(order), p.append(x), z.append(0.03), s.append(rng.random() < 0.1), sel.append(-1)
    chart = StabilisationChart(*(np.array(c) for c in (o, p, z, s, sel)))
    modal = ModalModel(
        dofs,
        tuple(modes),
        (20.0, 1800.0),
        True,
        "",
        picks,
        f[band],
        synthesise(modes, f[band], list(range(len(dofs))), inputs),
        dofs,
        picks,
        chart,
        ("ring.y was struck too close to a node to scale mode 3.",) if ring else (),
    )
    return ConfigurationResults(name, hits(rng), frfs, modal, pairing(modal, system), system)


def pairing(modal: ModalModel, system: LinearSystem) -> Pairing:
    model = model_modes(system)
    shapes = np.array([m.shape for m in model]) @ sensor_rows(system, modal.dofs).T
    measured = np.array([m.shape for m in modal.modes])
    cross = np.abs(measured.conj() @ shapes.T) ** 2
    mac = cross / np.outer(np.sum(np.abs(measured) ** 2, 1), np.maximum(np.sum(shapes**2, 1), 1e-12))
    in_band = [m.index for m in model if 20 < m.frequency_hz < 1850]
    pairs = tuple(
        Pair(
            i,
            j,
            m.frequency_hz,
            model[j].frequency_hz,
            float(mac[i, j]),
            model[j].family,
            0 if i in (0, 1) else -1,
        )
        for i, (m, j) in enumerate(zip(modal.modes, in_band, strict=False))
        if i != 3
    )
    lone = (Unpaired(3, modal.modes[3].frequency_hz, "no model mode within 20 % has MAC above 0.5"),)
    used = {p.model for p in pairs}
    rest = tuple(
        Unpaired(m.index, m.frequency_hz, "above band" if m.frequency_hz > 1800 else "no partner")
        for m in model
        if m.index not in used
    )
    return Pairing(model, pairs, lone, rest, mac)


def hits(rng: np.random.Generator) -> tuple[Hit, ...]:
    out = []
    for dof in ("carrier.x", "carrier.y", "sun.x", "-planet1.x"):
        for n in range(6):
            bad = dof == "sun.x" and n == 3
            verdicts = (
                CheckResult(
                    "double hit",
                    0.12 if bad else 0.02,
                    0.1,
                    "1",
                    not bad,
                    "ISO 7626-5:2019, 7.4",
                    "reject_hit",
                    "",
                    "second impact of 12 % after 8.1 ms" if bad else "",
                ),
                CheckResult(
                    "overload",
                    1.0 if n == 5 else 0.6,
                    0.98,
                    "1",
                    n != 5,
                    "",
                    "reject_channel",
                    "planet2_y",
                    "planet2_y at full scale at 0.051 s" if n == 5 else "",
                ),
            )
            out.append(
                Hit(
                    f"{dof.strip('-')}_1.uff",
                    n + 1,
                    Dof.parse(dof),
                    0,
                    1000,
                    50,
                    float(rng.uniform(80, 200)),
                    verdicts,
                )
            )
    return tuple(out)


def fit_result() -> FitResult:
    rng = np.random.default_rng(3)
    table = [
        ("sun_planet_mesh_stiffness", 9.98e6, 3.06e5, "N/m", True, 1e7, np.nan, True, ""),
        (
            "ring_planet_mesh_stiffness",
            4.1e7,
            3.0e7,
            "N/m",
            True,
            1e7,
            np.nan,
            False,
            "the interval is open towards the upper bound",
        ),
        *[
            (f"{b}_mass", v * 1.004, 0.007 * v, "kg", False, v, 0.01 * v, i % 2 == 0, "")
            for i, (b, v) in enumerate((("carrier", 5.4), ("ring", 2.35), ("sun", 0.4), ("planet", 0.66)))
        ],
        *[
            (
                f"{b}_bearing_stiffness",
                v * (1 + s),
                0.04 * v,
                "N/m",
                False,
                v,
                0.1 * v,
                True,
                "3.4 tolerances above nominal" if s > 0.3 else "",
            )
            for b, v, s in (
                ("carrier", 2e6, 0.05),
                ("ring", 1.64e6, 0.34),
                ("sun", 2e6, -0.08),
                ("planet", 8e6, 0.01),
            )
        ],
    ]
    parameters = {}
    for name, value, std, unit, free, nominal, prior, identified, remark in table:
        parameters[name] = ParameterEstimate(
            name,
            value,
            std,
            value - std,
            value + (np.inf if not identified and free else std),
            unit,
            free,
            nominal,
            prior,
            identified,
            (value - nominal) / prior,
            remark,
        )
    a = rng.normal(size=(len(table), len(table))) + 2 * np.eye(len(table))
    cov = a @ a.T
    d = np.sqrt(np.diag(cov))
    x = np.geomspace(1e6, 1e9, 200)
    sweeps = []
    for parameter, conf, least in (
        ("sun_planet_mesh_stiffness", "no_ring", 5.5e6),
        ("ring_planet_mesh_stiffness", "with_ring", 1.7e7),
    ):
        sweeps.append(
            ErrorSweep(
                parameter,
                conf,
                3,
                x,
                0.071 + 2e-4 * np.log10(x / least) ** 2,
                least,
                0.004,
                False,
                "ε changes by 0.4 % over three decades: three modes do not identify it",
            )
        )
        sweeps.append(
            ErrorSweep(
                parameter,
                conf,
                4,
                x,
                0.02 + 0.3 * np.log10(x / least) ** 2,
                least,
                5.0,
                True,
                "a clear minimum",
            )
        )
    return FitResult(
        parameters,
        tuple(parameters),
        cov / np.outer(d, d),
        1.04,
        1.08,
        0.0123,
        96,
        "the step fell below the tolerance after 9 iterations",
        tuple(sweeps),
        StepwiseEstimate(
            {"sun_planet_mesh_stiffness": 9.7e6, "ring_planet_mesh_stiffness": 1.6e7},
            1.285e7,
            "Three modes leave the sun-planet value open.",
        ),
        ("The posterior is well approximated by a normal distribution.",),
    )


def comparison(configurations: tuple[ConfigurationResults, ...]) -> Comparison:
    rng = np.random.default_rng(5)
    modes, dofs, bands = [], [], []
    for c in configurations:
        assert c.pairing is not None
        assert c.modal is not None
        assert c.frfs is not None
        for p in c.pairing.pairs:
            m = c.modal.modes[p.measured]
            fz = (m.frequency_hz - p.model_frequency_hz) / m.frequency_std_hz
            dz = (m.damping_ratio - 0.01) / m.damping_std
            modes.append(
                ModeDifference(
                    c.name,
                    p.measured,
                    p.family,
                    m.frequency_hz,
                    m.frequency_std_hz,
                    p.model_frequency_hz,
                    fz,
                    m.damping_ratio,
                    m.damping_std,
                    0.01,
                    dz,
                    p.mac,
                    abs(float(rng.normal())) + 0.5,
                )
            )
        dofs += [
            DofDifference(c.name, d.point, float(6.1 if d.body == "planet2" else rng.uniform(0.6, 1.6)))
            for d in c.modal.dofs
        ]
        edges = np.geomspace(20, 1800, 9)
        for o in c.frfs.outputs:
            for i in c.frfs.inputs:
                bands += [
                    BandDifference(
                        c.name, o.point, i.point, float(a), float(b), float(np.exp(rng.normal(0.3, 0.7)))
                    )
                    for a, b in itertools.pairwise(edges)
                ]
    return Comparison(2.7, 0.0123, tuple(modes), tuple(dofs), tuple(bands), ())


def planetary_run(lines: int = 4097) -> RunResults:
    configurations = (
        configuration("no_ring", False, 1, lines=lines),
        configuration("with_ring", True, 2, lines=lines),
    )
    return RunResults(
        "Planetary rig, two configurations",
        "planetary",
        configurations,
        fit_result(),
        comparison(configurations),
        {"ema": "0.1.0", "python": "3.11", "raw folder": "campaign <a & b>", "input hash": "3f2a…"},
        {"frf": {"estimator": "H1", "window": "force + exponential"}, "modal": {"max_order": "60"}},
    )


def beam_run(
    points: int = 25, directions: str = "xyz", mode_count: int = 12, one_hit: bool = True
) -> RunResults:
    """A structure without a rig: many points, few references."""
    rng = np.random.default_rng(9)
    dofs = tuple(Dof(f"point{n:02d}", d) for n in range(1, points + 1) for d in directions)
    s = np.array([int(d.body[5:]) / points for d in dofs])
    modes: list[Mode] = []
    for k in range(mode_count):
        f, z = 6.0 + 5.3 * k**1.2, 0.008
        shape = (
            np.where(
                np.array([d.direction == "z" for d in dofs]), np.sin((k + 1) * np.pi * s), 0.1 * np.cos(k * s)
            )
            + 0j
        )
        w = 2 * np.pi * f
        modes.append(
            Mode(f, 0.002 * f, z, 5e-4, complex(-z * w, w), shape, np.full(len(dofs), 0.03), 0.95, "plscf")
        )
    inputs = [2, 0, 1]
    f = np.linspace(0, 128, 1025)
    h = synthesise(modes, f, list(range(len(dofs))), inputs)
    h += 0.002 * np.abs(h).max() * (rng.normal(size=h.shape) + 1j * rng.normal(size=h.shape))
    nan = np.full(h.shape, np.nan)
    picks = tuple(dofs[i] for i in inputs)
    frfs = FrfSet(
        f,
        h,
        nan,
        nan,
        dofs,
        picks,
        ("acceleration",) * len(dofs),
        np.ones(h.shape[:2], int),
        "H1",
        8.0,
        0.3,
        np.zeros(3),
        (4.0, 120.0),
        False,
        np.zeros(len(dofs)),
    )
    modes = [replace(m, circles=(circle(modes, m, 2, 2, dofs, rng),)) for m in modes]
    chart = StabilisationChart(
        np.array([2]), np.array([6.0]), np.array([0.01]), np.array([True]), np.array([0])
    )
    modal = ModalModel(
        dofs,
        tuple(modes),
        (4.0, 120.0),
        False,
        "the hammer is not calibrated",
        picks,
        f[f > 4],
        synthesise(modes, f[f > 4], list(range(len(dofs))), inputs),
        dofs,
        picks,
        chart,
    )
    return RunResults("Aircraft <test>", None, (ConfigurationResults("default", hits(rng), frfs, modal),))
