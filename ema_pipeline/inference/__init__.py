"""One posterior: unknowns with Gaussian priors, maximum a posteriori, Laplace evidence, learned scatter.

Knows no rig, no mode and no effect. A problem hands over its unknowns and its residuals with their derivatives;
everything else that a user sees is read from the `Posterior`.
"""

from ema_pipeline.inference.bounded import Bounded, beyond, reach
from ema_pipeline.inference.factor import lower_factor, solve_lower
from ema_pipeline.inference.marginal import averaged_over_others
from ema_pipeline.inference.maximise import anneal, descend
from ema_pipeline.inference.posterior import ERROR_LIMIT, LEAST_LIMIT, Posterior, error_limit
from ema_pipeline.inference.problem import Apart, Problem, Residuals, same_matching
from ema_pipeline.inference.scatter import Scatter, learn, widened
from ema_pipeline.inference.scatter_cost import CostOverScatters
from ema_pipeline.inference.unknowns import Unknowns, joined

__all__ = [
    "ERROR_LIMIT",
    "LEAST_LIMIT",
    "Apart",
    "Bounded",
    "CostOverScatters",
    "Posterior",
    "Problem",
    "Residuals",
    "Scatter",
    "Unknowns",
    "anneal",
    "averaged_over_others",
    "beyond",
    "descend",
    "error_limit",
    "joined",
    "learn",
    "lower_factor",
    "reach",
    "same_matching",
    "solve_lower",
    "widened",
]
