"""From a record in Python to a control loop in C: a tracker exported, compiled, and closed over a simulated plant.

    python examples/controller.py                            needs gcc
    python examples/controller.py docs/figures/controller.png

The plant is y_t = 0.8 y_(t-1) + gain_t u_(t-1) + noise; its gain falls from 1 to 0.25 between samples 300 and 400. The
controller chooses u so that the next prediction is the set-point, with the first gain or with the tracker's estimate.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np

from driftfit import ARX, Kalman, Live
from driftfit.embedded import export_c

# In a loop the input that acts on y_t was applied before it: use nk=0 with that input and y_t in one row.
MODEL, TRACKER = ARX(na=1, nb=1, nk=0), Kalman(q=[0.0, 4e-4], r=0.01, p0=[0.1, 0.1], theta0=[0.8, 1.0])

PROGRAM = r"""
#include <stdio.h>
#include <string.h>
#include "tracker.h"

static double noise(void) {                     /* a sum of twelve uniform numbers, as in small controllers */
    static unsigned long seed = 7;
    double sum = -6.0;
    for (int i = 0; i < 12; i++) {
        seed = (1103515245UL * seed + 12345UL) & 0x7fffffffUL;
        sum += (double)seed / 2147483648.0;
    }
    return 0.1 * sum;
}

int main(int count, char **words) {
    int adaptive = count > 1 && strcmp(words[1], "adaptive") == 0;
    tracker_state state;
    double y = 0.0, u = 0.0;
    tracker_init(&state);
    for (int t = 0; t < 800; t++) {
        double gain = t < 300 ? 1.0 : t < 400 ? 1.0 - 0.0075 * (t - 300) : 0.25;
        double wanted = (t / 50) % 2 ? 1.0 : -1.0;
        y = 0.8 * y + gain * u + noise();                       /* the plant: what the sensor reads now */
        tracker_update(&state, y, &u);                          /* y, and the input that acted on it */
        double a = adaptive ? state.theta[0] : 0.8, b = adaptive ? state.theta[1] : 1.0;
        u = (wanted - a * y) / (b > 0.1 ? b : 0.1);             /* the input from now on */
        printf("%.17g %.17g %.17g %.17g %.17g\n", wanted, y, u, state.theta[1], state.var[1]);
    }
    return 0;
}
"""


def compiled(folder: Path) -> Path:
    """The program, in a folder with the exported tracker."""
    export_c(MODEL, TRACKER, folder)
    (folder / "main.c").write_text(PROGRAM)
    sources = [str(folder / "tracker.c"), str(folder / "main.c")]
    flags = ["-std=c99", "-O2", "-ffp-contract=off", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    subprocess.run(["gcc", *flags, "-o", str(folder / "loop"), *sources, "-lm"], check=True)
    return folder / "loop"


def run(program: Path, kind: str) -> np.ndarray:
    """Columns: set-point, y, u, estimated gain, its variance."""
    done = subprocess.run([str(program), kind], check=True, capture_output=True, text=True)
    return np.loadtxt(done.stdout.splitlines())


def draw(path: str, fixed: np.ndarray, adaptive: np.ndarray) -> None:
    """Output of both loops, and the gain as the tracker follows it."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    t = np.arange(len(fixed))
    figure, (above, below) = plt.subplots(2, 1, figsize=(9, 5.5), sharex=True, layout="constrained")
    above.plot(t, fixed[:, 1], color="tab:orange", lw=1, label="controller with the first gain")
    above.plot(t, adaptive[:, 1], color="tab:blue", lw=1, label="controller that asks the tracker")
    above.plot(t, np.r_[np.nan, fixed[:-1, 0]], color="black", lw=1, ls=":", label="set-point")
    above.set_ylim(-1.9, 1.4)
    above.set_ylabel("y")
    above.legend(loc="lower left", ncols=3, frameon=False)
    gain = np.interp(t, [300, 400], [1.0, 0.25])
    std = np.sqrt(adaptive[:, 4])
    below.fill_between(t, adaptive[:, 3] - 1.96 * std, adaptive[:, 3] + 1.96 * std, color="tab:blue", alpha=0.2)
    below.plot(t, adaptive[:, 3], color="tab:blue", label="estimate on the controller, 95 % band")
    below.plot(t, gain, color="black", ls=":", label="gain of the plant")
    below.set_ylabel("gain")
    below.set_xlabel("sample")
    below.legend(loc="upper right", frameon=False)
    figure.savefig(path, dpi=120)


with tempfile.TemporaryDirectory() as place:
    program = compiled(Path(place))
    fixed, adaptive = run(program, "fixed"), run(program, "adaptive")

live = Live(MODEL, TRACKER)
applied = np.r_[0.0, adaptive[:-1, 2]]
gains = []
for y, u in zip(adaptive[:, 1], applied, strict=True):
    live.update(y, u)
    gains.append(live.theta[1])

print("root mean square distance from the set-point")
print("                                    before the fault   after it")
for name, loop in (("controller with the first gain", fixed), ("controller that asks the tracker", adaptive)):
    away = loop[1:, 1] - loop[:-1, 0]
    print(f"  {name:<34}{np.sqrt(np.mean(away[50:299] ** 2)):>16.3f}{np.sqrt(np.mean(away[400:] ** 2)):>11.3f}")
print(f"gain at the end: {adaptive[-1, 3]:.3f} +- {1.96 * np.sqrt(adaptive[-1, 4]):.3f}, true 0.25")
print(f"estimates of the C program equal to those of Live, bit for bit: {np.array_equal(gains, adaptive[:, 3])}")
if len(sys.argv) > 1 and sys.argv[1].endswith(".png"):
    draw(sys.argv[1], fixed, adaptive)
