"""Tables of a diagnosis study, as Markdown: what was found, missed, wrongly claimed, and how sure it was said to be."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

Line = dict[str, Any]
SURE = ((0.0, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1.01))


def read(file: Path) -> list[Line]:
    """Cases of a study; the last line of each number counts."""
    lines = [json.loads(text) for text in file.read_text().splitlines()]
    return sorted({line["number"]: line for line in lines}.values(), key=lambda line: int(line["number"]))


def labels(line: Line) -> list[str]:
    """True effects as ``id@place``."""
    return [t.partition(":")[0] for t in line["truth"]]


def sizes(line: Line) -> dict[str, float]:
    """True sizes of the first effect."""
    pairs = (part.partition("=") for part in line["truth"][0].partition(":")[2].split(","))
    return {name: float(value) for name, _, value in pairs}


def outcome(line: Line) -> str:
    """One word for a case with one effect: right, group, wrong, unknown, missed."""
    truth, claimed = labels(line)[0], line["claimed"]
    if any(truth in group for group in line["groups"]):
        return "group"
    if truth in claimed:
        return "right" if claimed == [truth] else "right and more"
    if line["verdict"] == "unknown_effect":
        return "unknown"
    if not claimed:
        return "missed"
    return "wrong"


def stated_limit(line: Line, twin: Line | None) -> float | None:
    """True size over the least that the tool says the twin's data would show; None where it says nothing.

    Where the twin was not run, by what it says of the test itself.
    """
    truth = labels(line)[0]
    for name, value in sizes(line).items():
        limit = (twin or line).get("limits", {}).get(f"{truth}.{name}")
        if limit is not None:
            return float(value / limit)
    return None


def report(file: Path) -> str:
    """All tables."""
    every = read(file)
    lines = [line for line in every if "failed" not in line]
    single = [line for line in lines if line["kind"] == "single"]
    nothing = [line for line in lines if line["kind"] == "nothing"]
    removed = [line for line in lines if line["kind"] == "removed"]
    pairs = [line for line in lines if line["kind"] == "pair"]
    twins = {line["seed"]: line for line in nothing}
    versions = Counter(line["version"] for line in lines)
    out = [
        f"{len(every)} cases, {len(every) - len(lines)} of which ended with an error. Versions: "
        + ", ".join(f"{v} ({n})" for v, n in versions.items())
        + "."
    ]
    out += ["", *_effects(single, twins)]
    out += ["", *_confusion([*single, *nothing])]
    out += ["", *_nothing(nothing), *_sizes(single), *_calibration([*single, *nothing])]
    out += [*_removed(removed), *_pairs(pairs)]
    return "\n".join(out)


def share(part: Sequence[object] | int, whole: Sequence[object] | int) -> str:
    """``n of m``."""
    n, m = (x if isinstance(x, int) else len(x) for x in (part, whole))
    return f"{n} of {m}" + (f" ({100 * n / m:.0f} %)" if m >= 10 else "")


def _effects(single: list[Line], twins: dict[int, Line]) -> list[str]:
    out = [
        "| effect | cases | above the stated limit | of these found (in a group) | wrong claims | missed, unknown | "
        "smallest found |",
        "|---|---|---|---|---|---|---|",
    ]
    total: Counter[str] = Counter()
    for family in sorted({labels(line)[0].partition("@")[0] for line in single}):
        own = [line for line in single if labels(line)[0].startswith(f"{family}@")]
        ratios = [stated_limit(line, twins.get(line["seed"])) for line in own]
        above = [line for line, r in zip(own, ratios, strict=True) if r is None or r > 1]
        told = Counter(outcome(line) for line in above)
        found = told["right"] + told["group"] + told["right and more"]
        smallest = min(
            (next(iter(sizes(line).values())) for line in own if outcome(line) in ("right", "group")),
            default=np.nan,
        )
        wrong = sum(line["verdict"] == "effect" and bool(_wrong(line)) for line in own)
        out.append(
            f"| `{family}` | {len(own)} | {len(above)} | {found} ({told['group']}) | {wrong} | "
            f"{told['missed']}, {told['unknown']} | {smallest:.3g} |"
        )
        total.update(told)
        total["above"] += len(above)
        total["all wrong"] += wrong
    found = total["right"] + total["group"] + total["right and more"]
    out.append(
        f"| all | {len(single)} | {total['above']} | {share(found, total['above'])} | "
        f"{share(total['all wrong'], len(single))} | {total['missed']}, {total['unknown']} | |"
    )
    return out


def _confusion(lines: list[Line]) -> list[str]:
    def first(line: Line) -> str:
        if line["verdict"] in ("adequate", "not_enough_data", "unknown_effect"):
            return str(line["verdict"])
        return str(line["claimed"][0].partition("@")[0]) if line["claimed"] else "ambiguous"

    def true(line: Line) -> str:
        return labels(line)[0].partition("@")[0] if line["truth"] else "nothing"

    rows, columns = sorted({true(x) for x in lines}), sorted({first(x) for x in lines})
    counts = Counter((true(x), first(x)) for x in lines)
    out = ["| true \\ said | " + " | ".join(columns) + " |", "|---" * (len(columns) + 1) + "|"]
    for row in rows:
        out.append(f"| {row} | " + " | ".join(str(counts[row, c] or "") for c in columns) + " |")
    return out


def _nothing(nothing: list[Line]) -> list[str]:
    wrong = [x for x in nothing if x["claimed"]]
    unknown = [x for x in nothing if x["verdict"] == "unknown_effect"]
    return [
        f"* Nothing missing: an effect claimed in {share(wrong, nothing)}, `unknown_effect` in "
        f"{share(unknown, nothing)}."
    ]


def _sizes(single: list[Line]) -> list[str]:
    within, total = [0, 0], 0
    for line in single:
        found = next((c for c in line["candidates"] if c["label"] == labels(line)[0]), None)
        if found is None or labels(line)[0] not in line["claimed"]:
            continue
        name, true = next(iter(sizes(line).items()))
        value, std = found["sizes"][name]
        total += 1
        within[0] += abs(value - true) <= 3 * std
        within[1] += abs(value - true) <= 0.15 * abs(true)
    return [
        f"* Sizes of effects that were found: within 3 σ in {share(within[0], total)}, within 15 % in "
        f"{share(within[1], total)}."
    ]


def _calibration(lines: list[Line]) -> list[str]:
    out = ["* Most probable candidate, by its stated probability:"]
    for low, high in SURE:
        own = [x for x in lines if x["candidates"] and low <= x["candidates"][0]["probability"] < high]
        if own:
            hits = sum(_first_right(x) for x in own)
            said = float(np.mean([x["candidates"][0]["probability"] for x in own]))
            out.append(
                f"  {low:.2f}–{min(high, 1.0):.2f}: said {said:.2f} on average, right in {share(hits, own)};"
            )
    return out


def _first_right(line: Line) -> bool:
    first = line["candidates"][0]["label"]
    names = _meant(line, first) if line["verdict"] == "effect" else {first}
    return bool(line["truth"]) and labels(line)[0] in names


def _removed(removed: list[Line]) -> list[str]:
    honest = [x for x in removed if x["verdict"] in ("unknown_effect", "ambiguous")]
    confident = [x for x in removed if x["verdict"] == "effect"]
    located = [x for x in removed if x["places"]]
    named = [x for x in located if _body_named(x)]
    return [
        f"* Effect not in the library: `unknown_effect` or `ambiguous` in {share(honest, removed)}, another effect "
        f"claimed in {share(confident, removed)}; body named by the first place in {share(named, located)}."
    ]


def _body_named(line: Line) -> bool:
    place = labels(line)[0].partition("@")[2]
    bodies = {p.partition(".")[0] for p in str(line["places"][0][0]).split("-")}
    return place == "all" or any(
        b in place.split("-") or b.rstrip("0123456789") in place.split("-") for b in bodies
    )


def _wrong(line: Line) -> list[str]:
    """Claims that name no true effect, nor stand in a stated group with one."""
    return [c for c in line["claimed"] if not _meant(line, c) & set(labels(line))]


def _meant(line: Line, label: str) -> set[str]:
    """A claimed effect with those that are named beside it: other names of one change, or rivals."""
    return {label}.union(*(g for g in line["groups"] if label in g))


def _pairs(pairs: list[Line]) -> list[str]:
    both = [x for x in pairs if all(any(t in _meant(x, c) for c in x["claimed"]) for t in labels(x))]
    none_wrong = [x for x in pairs if not _wrong(x)]
    return [
        f"* Two effects at once: both found in {share(both, pairs)}, none wrong added in {share(none_wrong, pairs)}."
    ]
