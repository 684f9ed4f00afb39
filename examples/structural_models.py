"""Structural time series by laws: the Nile with its published numbers, and two more beside statsmodels: carbon dioxide,
and monthly counts with a price and a new law, as of drivers killed before and after seat belts.

Run: python examples/structural_models.py [FOLDER with AirPassengers.csv and Seatbelts.csv of R, as Rdatasets has them]
"""

import sys
import warnings
from pathlib import Path

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

rng, T = np.random.default_rng(7), 192
price = np.cumsum(0.05 * rng.normal(size=T))
belts = np.arange(T) >= 169
month = 2.0 * np.pi * np.arange(T) / 12
level = 7.0 + np.cumsum(0.016 * rng.normal(size=T)) + 0.12 * np.cos(month) + 0.05 * np.sin(2.0 * month)
killed = level - 0.29 * price - 0.24 * belts + 0.06 * rng.normal(size=T)
inputs, model = np.column_stack([price, belts]), Regression(["price", "belts"], intercept=True)
laws = (Law.walk(), Law.season(12, harmonics=6))
tuned = tune(model, Kalman(q=0, laws={"intercept": laws}), killed, inputs, intervals=False)
other = sm.tsa.UnobservedComponents(
    killed, "llevel", freq_seasonal=[{"period": 12, "harmonics": 6}], stochastic_freq_seasonal=[False], exog=inputs,
    mle_regression=False, use_exact_diffuse=True,
)  # fmt: skip
run, fit = track(model, tuned.tracker, killed, inputs), other.fit(disp=0)
there, std = fit.smoother_results.filtered_state[-2:, -1], fit.smoother_results.filtered_state_cov[-2:, -2:, -1]
print()
print("Killed, 192 months            driftfit  statsmodels")
for name, own, theirs in zip(
    ("noise", "level"), (tuned.tracker.r, tuned.tracker.laws[0][1].q), fit.params, strict=True
):
    print(f"variance of the {name:10}{own:12.2e}{theirs:13.2e}")
print(f"log-likelihood            {tuned.loglik - 7 * np.log(2 * np.pi):12.3f}{fit.llf:13.3f}")
for k, name in enumerate(("price", "belts")):
    print(f"effect of {name:16}{run.theta[-1, k]:12.3f}{there[k]:13.3f}")
    print(f"  its std{'':17}{run.std[-1, k]:12.3f}{np.sqrt(std[k, k]):13.3f}")

for folder in map(Path, sys.argv[1:]):
    laws = {"intercept": (Law.trend(level=None), Law.season(12, harmonics=6, q=None))}
    passengers = np.log(np.genfromtxt(folder / "AirPassengers.csv", delimiter=",", skip_header=1)[:, -1])
    tuned = tune(LEVEL, Kalman(q=0, laws=laws), passengers, intervals=False)
    trend, season = (law for _, law in tuned.tracker.laws)
    other = sm.tsa.UnobservedComponents(
        passengers, "lltrend", freq_seasonal=[{"period": 12, "harmonics": 6}], use_exact_diffuse=True
    )
    mine = (tuned.tracker.r, trend.level, trend.q, season.q)
    with warnings.catch_warnings(action="ignore"):
        fit = other.fit(mine, disp=0, maxiter=500)
    print()
    print("Air passengers, 144 months    driftfit  statsmodels")
    for name, own, theirs in zip(("noise", "level", "slope", "season"), mine, fit.params, strict=True):
        print(f"variance of the {name:10}{own:12.3e}{theirs:13.3e}")
    print(f"log-likelihood            {tuned.loglik - 6.5 * np.log(2 * np.pi):12.3f}{fit.llf:13.3f}")
    belts = np.genfromtxt(folder / "Seatbelts.csv", delimiter=",", skip_header=1)
    drivers, inputs = np.log(belts[:, 2]), np.column_stack([np.log(belts[:, 6]), belts[:, 8]])
    laws = {"intercept": (Law.walk(), Law.season(12, harmonics=6, q=None))}
    print()
    print("Drivers, 192 months           driftfit   published")
    alone = tune(LEVEL, Kalman(q=0, laws=laws), drivers, intervals=False).tracker
    tuned = tune(model, Kalman(q=0, laws=laws), drivers, inputs, intervals=False).tracker
    run = track(model, tuned, drivers, inputs)
    published = ((3.41597e-3, 9.35838e-4, 5.01094e-7), (3.78627e-3, 2.67692e-4, 1.16213e-6))
    for what, tracker, printed in zip(("alone", "with price and belts"), (alone, tuned), published, strict=True):
        print(what)
        (_, walk), (_, season) = tracker.laws
        for name, own, theirs in zip(("noise", "level", "season"), (tracker.r, walk.q, season.q), printed, strict=True):
            print(f"variance of the {name:10}{own:12.3e}{theirs:12.3e}")
    for k, (name, effect, std) in enumerate((("price", -0.29140, 0.09832), ("belts", -0.23774, 0.04632))):
        print(f"effect of {name:16}{run.theta[-1, k]:12.4f}{effect:12.4f}")
        print(f"  its std{'':17}{run.std[-1, k]:12.4f}{std:12.4f}")
