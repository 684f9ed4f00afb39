"""A battery, an epidemic and a vehicle: parameters that drift beside states that nobody measures.

Each is simulated with state noise, and followed by the extended and the unscented filter. Printed are the root mean
square error of the parameters and states in the second half of the record, and the share of 95 % bands that cover.
Run: python examples/hidden_states.py [FOLDER], which takes battery.png, epidemic.png and vehicle.png.
"""

import sys
from pathlib import Path

import numpy as np

from driftfit import JointKalman, StateSpace, track

RECORDS = 10


def battery(rng):
    """A cell is cycled for eight hours: its ohmic resistance drifts, and so does its capacity, from 2 Ah."""
    T = 3000
    R0 = 0.06 + np.cumsum(1e-4 * rng.normal(size=T))
    capacity = 2.0 + np.cumsum(2e-3 * rng.normal(size=T))
    i = np.repeat(rng.uniform(-3.0, 3.0, T // 20), 20)
    charge, v1, rows = 0.6, 0.0, []
    for t in range(T):
        i[t] = -abs(i[t]) if charge < 0.1 else abs(i[t]) if charge > 0.9 else i[t]
        charge -= 10 * i[t] / 3600 / capacity[t]
        v1 += 10 * (0.02 * i[t] - v1) / 60 + 1e-4 * rng.normal()
        rows.append([capacity[t], R0[t], charge, 3.2 + 0.5 * charge + 0.4 * charge**3 - R0[t] * i[t] - v1])
    *truth, v = np.array(rows).T
    model = StateSpace(
        """
        charge = charge[-1] - 10 * dt * i / 3600 / theta.capacity
        v1 = v1[-1] + 10 * dt * (theta.R1 * i - v1[-1]) / 60
        v = 3.2 + 0.5 * charge + 0.4 * charge ** 3 - theta.R0 * i - v1
        """,
        start={"charge": 0.5, "capacity": 2.3, "R1": 0.03, "R0": 0.06},
    )
    q = {"capacity": 4e-6, "R0": 1e-8, "v1": 1e-8}
    p0 = {"charge": 0.04, "capacity": 0.25, "R1": 1e-4, "R0": 1e-3, "v1": 1e-4}
    return (
        model,
        q,
        1e-4,
        p0,
        v + 0.01 * rng.normal(size=T),
        i,
        dict(zip(("capacity", "R0", "charge"), truth, strict=True)),
    )


def epidemic(rng):
    """Contacts fall in a lockdown and come back; what is seen is the logarithm of the reported cases of a day."""
    T = 200
    contact = np.interp(np.arange(T), [50, 70, 110, 150], [0.35, 0.12, 0.12, 0.25])
    s, i, rows = 1.0, 1e-4, []
    for t in range(T):
        fresh = contact[t] * s * i * np.exp(0.03 * rng.normal())
        s, i = s - fresh, i + fresh - 0.15 * i
        rows.append([contact[t], i, np.log(1e6 * contact[t] * s * i)])
    *truth, y = np.array(rows).T
    model = StateSpace(
        """
        s = s[-1] - theta.contact * s[-1] * exp(li[-1])
        li = li[-1] + theta.contact * s[-1] - 0.15 - 0.5 * (theta.contact * s[-1] - 0.15) ** 2
        cases = log(1e6 * theta.contact * s) + li
        """,
        start={"contact": 0.3, "s": 1.0, "li": -9.0},
    )
    truth[1] = np.log(truth[1])
    q, p0 = {"contact": 1e-4, "li": 4e-4}, {"contact": 0.01, "li": 1.0}
    return model, q, 0.01, p0, y + 0.1 * rng.normal(size=T), None, dict(zip(("contact", "li"), truth, strict=True))


def vehicle(rng):
    """A lorry is loaded on the way, in tons; drag in kN per (m/s)^2; measured is the speed, once a second."""
    T = 2000
    mass = np.where(np.arange(T) < 1000, 12.0, 18.0)
    force = np.repeat(rng.uniform(0.0, 12.0, T // 10), 10)
    slope = np.repeat(0.03 * rng.normal(size=T // 50), 50)
    v, rows = 15.0, []
    for t in range(T):
        force[t] = max(force[t], 8.0) if v < 5.0 else force[t]
        v += (force[t] - 0.005 * v * abs(v)) / mass[t] - 9.81 * slope[t] + 0.01 * rng.normal()
        rows.append([mass[t], 0.005, v])
    truth = np.array(rows).T
    model = StateSpace(
        """
        v = v[-1] + dt * ((force - theta.drag * v[-1] * abs(v[-1])) / theta.mass - 9.81 * slope)
        speed = v
        """,
        start={"mass": 15.0, "drag": 0.004, "v": 15.0}, inputs=["force", "slope"],
    )  # fmt: skip
    q, p0 = {"mass": 0.02, "v": 1e-4}, {"mass": 25.0, "drag": 1e-5, "v": 1.0}
    u = np.c_[force, slope]
    return (
        model,
        q,
        0.04,
        p0,
        truth[2] + 0.2 * rng.normal(size=T),
        u,
        dict(zip(("mass", "drag", "v"), truth, strict=True)),
    )


def draw(plant, folder):
    """A picture of a plant: parameters and states with bands, dashed the truth."""
    import matplotlib.pyplot as plt

    model, q, r, p0, y, u, truth = plant(np.random.default_rng(0))
    run = track(model, JointKalman(q=q, r=r, p0=p0), y, u)
    figure, axes = plt.subplots(len(truth), sharex=True, figsize=(8, 2 * len(truth)), layout="constrained")
    for ax, (name, path) in zip(axes, truth.items(), strict=True):
        k = run.names.index(name)
        low, high = (run.theta[:, k] + sign * 1.96 * run.std[:, k] for sign in (-1.0, 1.0))
        ax.fill_between(np.arange(len(y)), low, high, color="tab:blue", alpha=0.25, label="95 % band")
        ax.plot(run.theta[:, k], color="tab:blue", label="estimate")
        ax.plot(path, "k--", lw=1, label="truth")
        late = slice(len(y) // 20, None)  # the band of the prior is far wider
        edges = min(low[late].min(), path.min()), max(high[late].max(), path.max())
        room = 0.05 * (edges[1] - edges[0])
        ax.set(ylabel=name, xlim=(0, len(y)), ylim=(edges[0] - room, edges[1] + room))
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside upper center", ncols=3)
    axes[-1].set_xlabel("sample")
    figure.savefig(Path(folder) / f"{plant.__name__}.png", dpi=80)
    plt.close(figure)


if __name__ == "__main__":
    for plant in (battery, epidemic, vehicle) if len(sys.argv) > 1 else ():
        draw(plant, sys.argv[1])
    print(f"{'':22}{'start':>10}{'extended':>12}{'unscented':>12}{'in band: extended':>20}{'unscented':>12}")
    for plant in (battery, epidemic, vehicle):
        found = {}
        for seed in range(RECORDS):
            model, q, r, p0, y, u, truth = plant(np.random.default_rng(seed))
            late = slice(len(y) // 2, None)
            for method in ("extended", "unscented"):
                run = track(model, JointKalman(q=q, r=r, p0=p0, method=method), y, u)
                for name, path in truth.items():
                    k = run.names.index(name)
                    miss = run.theta[late, k] - path[late]
                    inside = np.mean(np.abs(miss) < 1.96 * run.std[late, k])
                    first = model.begins[k] - path[late]
                    found.setdefault((name, method), []).append([np.mean(miss**2), inside, np.mean(first**2)])
        for name in truth:
            one, other = (np.mean(found[name, method], axis=0) for method in ("extended", "unscented"))
            errors = "".join(
                f"{np.sqrt(value):{width}.2g}" for value, width in ((one[2], 10), (one[0], 12), (other[0], 12))
            )
            print(f"{plant.__name__:12}{name:10}{errors}{one[1]:20.2f}{other[1]:12.2f}")
