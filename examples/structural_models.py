"""Structural time series by laws: the Nile with its published numbers, and carbon dioxide beside statsmodels."""

import warnings

import numpy as np
import statsmodels.api as sm

from driftfit import Kalman, Law, Regression, track, tune

LEVEL = Regression(intercept=True)

nile = sm.datasets.nile.load_pandas().data.volume.to_numpy()
tuned = tune(LEVEL, Kalman(q=0, laws={"intercept": Law.walk()}), nile)
(_, walk), r = tuned.tracker.laws[0], tuned.tracker.r
print("Nile, 1871 to 1970            driftfit   published")
print(f"variance of the noise         {r:8.0f}       15099")
print(f"variance of the level         {walk.q:8.1f}      1469.1")

co2 = sm.datasets.co2.load_pandas().data.co2.resample("MS").mean().interpolate().to_numpy()[:240]
laws = (Law.trend(level=None), Law.season(12, harmonics=3, q=None))
tuned = tune(LEVEL, Kalman(q=0, laws={"intercept": laws}), co2, intervals=False)
trend, season = (law for _, law in tuned.tracker.laws)
other = sm.tsa.UnobservedComponents(
    co2, "lltrend", freq_seasonal=[{"period": 12, "harmonics": 3}], use_exact_diffuse=True
)
with warnings.catch_warnings(action="ignore"):  # its search says that it did not converge
    fit = other.fit(disp=0, maxiter=500)
    fit = other.fit(fit.params, disp=0, maxiter=500)
print()
print("Carbon dioxide, 240 months    driftfit  statsmodels")
mine = (tuned.tracker.r, trend.level, trend.q, season.q)
for name, own, theirs in zip(("noise", "level", "slope", "season"), mine, fit.params, strict=True):
    print(f"variance of the {name:10}{own:12.2e}{theirs:13.2e}")
print(f"log-likelihood            {tuned.loglik - 4 * np.log(2 * np.pi):12.3f}{fit.llf:13.3f}")
smoothed, there = track(LEVEL, tuned.tracker, co2).smooth(), fit.smoother_results.smoothed_state
apart = np.abs(smoothed.theta[:, 0] - np.array([1, 0, 1, 0, 1, 0, 1, 0]) @ there).max()
print(f"smoothed paths are {apart:.3f} ppm apart at most")
