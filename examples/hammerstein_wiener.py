"""A valve, a tank and a sensor that all age: on-line separation of the three blocks of a drifting system."""

from pathlib import Path

import numpy as np

from driftfit import HammersteinWiener, Kalman, OutputError, Polynomial, track
from driftfit.systems import Ramp, SineOffset
from driftfit.systems.hammerstein_wiener import simulate

FIGURE = Path(__file__).parent.parent / "docs" / "figures" / "hammerstein_wiener_blocks.png"


def main(plot: bool = False) -> None:
    model = HammersteinWiener(na=1, nb=2, input=Polynomial(2), output=Polynomial(2))
    rng = np.random.default_rng(1)
    T = 3000
    s = simulate(
        model, a=[SineOffset(-0.6, 0.15, 0.004)], b=[0.5, -0.2], c=[Ramp(0.2, 1e-4)], d=[Ramp(0.2, -1e-4)],
        T=T, rng=rng, u=rng.uniform(-1.0, 1.0, T), snr_db=40.0,
    )  # fmt: skip
    aware = HammersteinWiener(1, 2, input=Polynomial(2), output=Polynomial(2), output_noise=s.sigma)
    stage = Kalman(q=1e-5, r=1.0, p0=1e2)
    run = track(aware, stage, s.y, s.u)
    gls, late = run.blocks("gls"), np.arange(T) > 200  # after sample 200 the second filter goes on from the first
    then = OutputError(q=1e-5, r=s.sigma**2, theta0=gls.xi[200], p0=gls.xi_cov[200])
    filtered = track(aware, then, s.y, s.u, weights=late, drift=late)
    paths = {
        '"average"': run.blocks("average").xi,
        '"svd-joint"': run.blocks().xi,
        '"gls"': gls.xi,
        "output error": filtered.theta,
    }
    print("root mean square error of A1, b1, b2, c2, d2 after the first 500 samples")
    for name, xi in paths.items():
        error = np.sqrt(np.mean((xi - s.xi)[500:] ** 2, axis=0))
        print(f"{name:14s}", *(f"{e:7.3f}" for e in error))
    if plot:
        run.plot_blocks("gls").savefig(FIGURE, dpi=80)


if __name__ == "__main__":
    main()
