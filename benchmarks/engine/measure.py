"""What is measured of an agent beside its returns, where it acts: Eq. (1), and how well theta can be read off it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from deconfounded.deconf.equations import imitation_objective
from deconfounded.envs.streams import Array
from deconfounded.experts.policy import Expert
from deconfounded.experts.rollout import Trials


def objective(expert: Expert, trials: Trials, theta: Array) -> Array:
    """Eq. (1) [B, E]: how likely the expert that sees theta [B, E, L] finds the imitator's own actions, by episode."""
    b, e, t = trials.mask.shape
    obs, action = (x.reshape(b * e * t, -1) for x in (trials.obs[:, :, :-1], trials.action))
    log_expert = expert.log_prob(obs, action, np.repeat(theta.reshape(b * e, -1), t, 0)).reshape(b, e, t)
    return imitation_objective(log_expert, trials.mask)


def probe(features: Array, theta: Array) -> tuple[float, Callable[[Array], Array]]:
    """Held-out R^2 of a linear probe for encoded theta [N, F'] in features [N, F], and the probe: [M, F] -> [M, F'].

    It is fitted to the first half. 1: theta can be read off; 0 or less: no better than its mean. The probe is ridge
    regression, and its penalty is chosen on the first half, by leave-one-out: with one for all, features as many as
    trials would only be memorised. It does not extrapolate: where a feature hardly varies in the first half, the second
    may be far outside.
    """
    # Here, since most commands that import this module probe nothing:
    from sklearn.linear_model import RidgeCV
    from sklearn.metrics import r2_score
    from sklearn.pipeline import make_pipeline
    from sklearn.preprocessing import StandardScaler

    half = len(features) // 2
    shown = features[:half].astype(float)
    reader = make_pipeline(StandardScaler(), RidgeCV(np.logspace(0, 4, 9))).fit(shown, theta[:half])
    low, high = shown.min(0), shown.max(0)

    def read(given: Array) -> Array:
        return reader.predict(given.clip(low, high)).reshape(len(given), theta.shape[1])

    return float(r2_score(theta[half:], read(features[half:]), multioutput="variance_weighted")), read
