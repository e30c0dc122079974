"""Tally of a calibration study: what was named, missed and wrongly claimed, and whether stated uncertainty is true."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from scipy.stats import norm

Line = dict[str, Any]

OUTCOMES = ("right", "group", "unknown", "missed above", "missed below", "wrong", "false alarm", "failed")
CLEARLY = 2.0
"""An effect so many times its stated limit must be found."""
TWO_SIDED_90 = 1.645
"""Half width of a 90 % interval in standard deviations."""

_MASSES = ("mass", "sensor_mass", "planet_mass_mistune")
_OTHER_NAMES = {"local_damper": "damper", "shaft_torsion": "spring"}


def read(file: Path) -> list[Line]:
    """Cases of a results file, the last line of each counts; a line cut short by a break is left out."""
    found: dict[tuple[object, ...], Line] = {}
    for text in file.read_text(encoding="utf-8").splitlines() if file.is_file() else ():
        try:
            line = json.loads(text)
        except json.JSONDecodeError:
            continue
        found[key(line)] = line
    return list(found.values())


def key(line: Line) -> tuple[object, ...]:
    """What makes a case the same case."""
    return line["kind"], line["level"], line["number"], line["without"]


def same(a: str, b: str, one_way: bool = False) -> bool:
    """True where two labels name one and the same change.

    A mass goes with its body in every direction, whatever it is called. Where bodies move `one_way` only, a place may
    be named with or without its direction.
    """
    return a == b or _canonical(a, one_way) == _canonical(b, one_way)


def _canonical(label: str, one_way: bool) -> tuple[str, frozenset[str]]:
    family, _, place = label.partition("@")
    if family in _MASSES:
        family = "mass"
    if family == "shaft_torsion" and "." not in place:
        place += ".u"
    family = _OTHER_NAMES.get(family, family)
    short = family == "mass" or one_way
    return family, frozenset(end.partition(".")[0] if short else end for end in place.split("-"))


def is_truth(line: Line, label: str, truth: Line) -> bool:
    """True where a label names a hidden effect, be it as the parameter that is off by the same physics."""
    one_way = line["kind"] == "gearbox" or (line["kind"] == "own" and "frame" not in line["rig"])
    named_parameter = bool(truth.get("also")) and label.rpartition("@")[2] == truth["also"]
    return named_parameter or same(label, truth["label"], one_way)


def _names(line: Line, claimed: str) -> set[str]:
    """A claimed effect with those that are stated to be as likely."""
    return {claimed}.union(*(set(g) for g in line["groups"] if claimed in g))


def _found(line: Line, truth: Line) -> str:
    """``"right"``, ``"group"`` or ``""`` for one hidden effect."""
    if any(is_truth(line, c, truth) for c in line["claimed"]):
        return "right"
    in_group = any(is_truth(line, x, truth) for g in line["groups"] for x in g)
    return "group" if in_group else ""


def _strange(line: Line) -> list[str]:
    """Claims that neither name a hidden effect nor stand in a group with one."""
    return [
        c
        for c in line["claimed"]
        if not any(is_truth(line, name, t) for name in _names(line, c) for t in line["truth"])
    ]


def over_limit(line: Line) -> float | None:
    """Least of the hidden effects' sizes over their stated limits; None where one has no limit stated."""
    return min(_over_limits(line) or (), default=None)


def _over_limits(line: Line) -> list[float] | None:
    """The hidden effects' sizes over their stated limits; None where one has no limit stated."""
    ratios = []
    for t in line["truth"]:
        own = [
            x
            for x in line.get("limits", ())
            if is_truth(line, x["label"], t) and x["parameter"] == t["parameter"]
        ]
        if not own:
            return None
        limit, size = own[0]["size"], abs(t["size"])  # none: not to be seen, whatever its size
        if own[0].get("largest"):  # teeth part at a small preload
            ratios.append((limit or 0.0) / size)
        else:
            ratios.append(size / limit if limit else 0.0)
    return ratios


def outcome(line: Line) -> str:
    """One of `OUTCOMES`; for a case with nothing hidden ``"right"``, ``"unknown"`` or ``"false alarm"``."""
    if line.get("failed"):
        return "failed"
    named = line["verdict"] in ("effect", "ambiguous")
    if not line["truth"]:
        if named:
            return "false alarm"
        return "unknown" if line["verdict"] == "unknown_effect" else "right"
    found = [_found(line, t) for t in line["truth"]] if named else [""]
    if named and (_strange(line) or not any(found)):
        return "wrong"
    if all(found):
        return "right" if set(found) == {"right"} else "group"
    if line["verdict"] == "unknown_effect":
        return "unknown"
    if line["without"]:
        return "missed above" if _seen_by_all(line) else "missed below"
    ratio = over_limit(line)
    return "missed below" if ratio is not None and ratio < CLEARLY else "missed above"


def _seen_by_all(line: Line) -> bool:
    """True where the whole library finds what is hidden: a library without it can only see what is there to be seen."""
    whole = line.get("whole")
    return whole is None or outcome(line | whole | {"without": False, "failed": None}) in ("right", "group")


def sizes(lines: Iterable[Line]) -> list[float]:
    """(Stated size - true size)/stated σ of every effect that was named rightly."""
    z = []
    for line in lines:
        if line.get("failed") or outcome(line) not in ("right", "group"):
            continue
        for t in line["truth"]:
            one = next((c for c in line["candidates"] if is_truth(line, c["label"], t)), None)
            value, std = (one or {"sizes": {}})["sizes"].get(t["parameter"], (None, None))
            if value is not None and std:
                z.append((value - t["size"]) / std)
    return z


def parameters(lines: Iterable[Line]) -> list[float]:
    """The same of the model's own parameters where nothing is hidden: the fit is that of the model without effects."""
    z = []
    for line in lines:
        if line.get("failed") or line["truth"]:
            continue
        for name, (value, std) in line["fit"].items():
            if name in line["values"] and value is not None and std:
                z.append((value - line["values"][name]) / std)
    return z


def coverage(z: Sequence[float]) -> float:
    """Share of 90 % intervals that hold the truth."""
    return float(np.mean(np.abs(z) <= TWO_SIDED_90)) if len(z) else math.nan


def ranks(z: Sequence[float], bins: int = 10) -> list[int]:
    """How often the truth lies in each tenth of the stated distribution: even where uncertainty is true."""
    return [int(n) for n in np.histogram(norm.cdf(-np.asarray(z)), bins, (0, 1))[0]]


def statements(lines: Iterable[Line], of_effects: bool | None = None) -> list[tuple[float, bool]]:
    """The most probable statement of each case, "nothing" among them: its probability, and whether it is true.

    Parameters
    ----------
    lines : iterable of dict
    of_effects : bool, optional
        True for statements that name an effect, False for those that nothing is missing; all where left out.
    """
    told = []
    for line in lines:
        if line.get("failed"):
            continue
        nothing = line["nothing"] or 0.0
        best = max(line["candidates"], key=lambda c: c["probability"] or 0.0, default=None)
        if best is None or nothing >= (best["probability"] or 0.0):
            if of_effects is not True:
                told.append((nothing, not line["truth"]))
            continue
        if of_effects is False:
            continue
        group = _names(line, best["label"])
        p = sum(c["probability"] or 0.0 for c in line["candidates"] if c["label"] in group)
        true = any(is_truth(line, name, t) for name in group for t in line["truth"])
        told.append((min(p, 1.0), true))
    return told


def visible(lines: Iterable[Line]) -> list[tuple[float, bool]]:
    """Probability of every verdict ``"adequate"``, and whether all that is hidden is smaller than its stated limit."""
    return [
        (line["visible"], not line["truth"] or max(_over_limits(line) or (np.inf,)) < 1)
        for line in lines
        if not line.get("failed") and line["verdict"] == "adequate" and line.get("visible") is not None
    ]


def calibration_error(told: Sequence[tuple[float, bool]], bins: int = 10) -> float:
    """Expected calibration error: mean difference of stated probability and frequency, over bins of probability."""
    if not told:
        return math.nan
    p, true = np.array([t[0] for t in told]), np.array([t[1] for t in told], dtype=float)
    which = np.minimum((p * bins).astype(int), bins - 1)
    parts = [np.sum(which == b) * abs(np.mean(p[which == b]) - np.mean(true[which == b])) for b in set(which)]
    return float(np.sum(parts) / len(p))


def table(lines: Sequence[Line]) -> str:
    """All tables as Markdown."""
    out = [
        "| cases | | " + " | ".join(OUTCOMES) + " | error, healthy | time, s |",
        "|---" * (len(OUTCOMES) + 4) + "|",
    ]
    groups: dict[str, list[Line]] = {}
    for line in lines:
        hidden = (
            "out of library" if line["without"] else ("healthy", "one effect", "two effects")[line["hidden"]]
        )
        groups.setdefault(f"{line['kind']}, {line['level']}: {hidden}", []).append(line)
    for name, own in sorted(groups.items()):
        out.append(_row(name, own))
    out.append(_row("all", lines))
    inside = [line for line in lines if not line["without"]]
    z, own_z, told = sizes(inside), parameters(inside), statements(inside)
    named, silent = statements(inside, True), statements(inside, False)
    adequate = visible(inside)
    clear = [x for x in inside if x["truth"] and not x.get("failed") and (over_limit(x) or 0) >= CLEARLY]
    found = sum(outcome(x) in ("right", "group") for x in clear)
    out += [
        "",
        f"- Above twice their stated limit: {found} of {len(clear)} right or in a stated group.",
        f"- No limit stated: {sum(over_limit(x) is None for x in inside if x['truth'])} of "
        f"{sum(bool(x['truth']) for x in inside)} cases with an effect.",
        f"- 90 % intervals of {len(z)} sizes hold {_percent(coverage(z))}; ranks {ranks(z)}.",
        f"- 90 % intervals of {len(own_z)} parameters of the model hold {_percent(coverage(own_z))}; "
        f"ranks {ranks(own_z)}.",
        f"- Expected calibration error of {len(told)} probabilities: {calibration_error(told):.3f}; of the "
        f"{len(named)} that name an effect {calibration_error(named):.3f}, of the {len(silent)} that "
        f"nothing is missing at all {calibration_error(silent):.3f}.",
        f"- Expected calibration error of the {len(adequate)} probabilities of the verdict `adequate`, that nothing is "
        f"missing beyond its limit: {calibration_error(adequate):.3f}; {sum(t for _, t in adequate)} are true.",
        "",
        *_not_right(lines),
    ]
    return "\n".join(out)


def _row(name: str, lines: Sequence[Line]) -> str:
    count = Counter(outcome(line) for line in lines)
    errors = [x["error"] for x in lines if not x["truth"] and x.get("error") is not None]
    error = f"{np.median(errors):.2f}" if errors else ""
    times = [x["seconds"]["run"] for x in lines if x.get("seconds")]
    cells = " | ".join(str(count[o] or "") for o in OUTCOMES)
    return f"| {name} | {len(lines)} | {cells} | {error} | {np.mean(times) if times else math.nan:.0f} |"


def _percent(share: float) -> str:
    return "–" if math.isnan(share) else f"{100 * share:.0f} %"


def _not_right(lines: Sequence[Line]) -> list[str]:
    out = []
    for x in lines:
        told = outcome(x)
        if told in ("right", "group"):
            continue
        hidden = " + ".join(f"{t['label']} {t['size']:.3g}" for t in x["truth"]) or "nothing"
        ratio = None if x.get("failed") else over_limit(x)
        limit = "" if ratio is None else f" ({ratio:.1f} of its limit)"
        said = x.get("failed") or f"{x['verdict']}, claimed {', '.join(x['claimed']) or 'nothing'}"
        without = " out of library" if x["without"] else ""
        out.append(
            f"- {x['kind']} {x['level']} {x['number']}{without}, {x['rig']}: {hidden}{limit} → {told}: {said}"
        )
    return out
