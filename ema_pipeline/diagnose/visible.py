"""How probable it is that nothing is missing of a size that the data would show.

An effect far below its detection limit is as probable as before the test: its share says nothing of what the data tell.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from scipy.stats import norm

from ema_pipeline.diagnose.naming import Named, named
from ema_pipeline.diagnose.ranked import Ranking
from ema_pipeline.diagnose.types import DetectionLimit, EffectSize


def nothing_visible(
    ranking: Ranking, probabilities: Mapping[str, float], limits: Sequence[DetectionLimit]
) -> float:
    """Probability that no effect is missing whose size is beyond its detection limit.

    Parameters
    ----------
    ranking : Ranking
        On top of the model that nothing was added to.
    probabilities : dict of str to float
        Of its hypotheses, by the names that are said.
    limits : sequence of DetectionLimit
        Of that model. An effect without one, a support of several sizes, counts whatever its size is.
    """
    least = {(x.label, x.parameter): x for x in limits}
    seen = 0.0
    for one in ranking.ranked:
        name = named(one.hypothesis, one.fit)
        seen += probabilities.get(name.label, 0.0) * _visible(name, least)
    return max(1.0 - seen, 0.0)


def _visible(name: Named, least: Mapping[tuple[str, str], DetectionLimit]) -> float:
    """Probability that an effect, if it is what is missing, is beyond its limit."""
    shares = [
        _beyond(size, least[name.label, parameter])
        for parameter, size in name.sizes.items()
        if (name.label, parameter) in least
    ]
    return max(shares, default=1.0)


def _beyond(size: EffectSize, limit: DetectionLimit) -> float:
    """Share of a size, as the data leave it, that lies beyond its limit on either side, or within it."""
    if not limit.seen:
        return 0.0
    std = max(size.std, 1e-300)  # nothing where a size is held at an end of its range
    above, below = norm.sf((limit.size - size.value) / std), norm.cdf((-limit.size - size.value) / std)
    return float(1 - above if limit.largest else above + below)
