"""Alarms on a frozen reference model: a naive twin of the statistics, rates, delays, and what changed."""

import numpy as np
import pytest
from scipy import signal, stats
from scipy.linalg import toeplitz
from support import arx_record, rows_of

from driftfit import ARX, AugmentedFLS, Kalman, Live, Regression, track
from driftfit.judge.alarms.detect import chance_of, onsets
from driftfit.judge.alarms.frozen import frozen_model, noise_model
from driftfit.run.live.likelihood_ratio import ALIKE, FEWEST, FINE, scan
from driftfit.run.live.reference_model import (
    ALPHA,
    BETA,
    CLIP,
    CONSTANT,
    EVEN,
    FINDINGS,
    INSTEAD,
    JOINT,
    KAPPA,
    LENGTH,
    LONGEST,
    NOISE,
    NORMAL,
    NUMBERS,
    ONE,
    RAW,
    SCALE,
    SIZE,
    SPREAD,
    STD,
    WHICH,
    Frozen,
    K,
    V,
    memory_of,
)

HELD = Kalman(q=0.0, r=1.0)
GAIN = Regression(["gain"], intercept=True)


def reference(phi, y, ok=None):
    """Rows of a reference: regressors, y, whether they are usable, variance factor, interval."""
    one = np.ones(len(y))
    return np.column_stack([phi, y, one if ok is None else ok, one, one])


def naive_centred(phi, model):
    """Regressors (.., n) about the means of the reference."""
    return phi - phi[..., [int(model.numbers[CONSTANT])]] * model.mean if len(model.mean) else phi


def naive_scores(rows, model):
    """(phi, x, g, index of the row) of the usable rows, from the definition: every row is predicted from all usable
    ones before, by the covariances of the autoregression."""
    n, numbers = len(model.theta), model.numbers
    response = signal.lfilter([1.0], np.r_[1.0, -model.ar], np.eye(1, 4000)[0])
    autocovariance = np.correlate(response, response, "full")[len(response) - 1 :]
    h, at, found, places, past, before = 1.0, 0, [], [], [], 0.0

    def predicted(at):
        cross = autocovariance[at - np.array(places, int)]
        weights = np.linalg.solve(toeplitz(autocovariance[:400])[np.ix_(places, places)], cross)
        return weights @ np.reshape(past, (-1, n + 1)), autocovariance[0] - weights @ cross

    for t, row in enumerate(rows):
        phi, (y, ok, noise, dt) = row[:n], row[n:]
        if dt == 0.0:
            continue
        at += round(dt) if dt > 1.5 else 1
        if dt > 1.5 and len(model.ar):
            before = predicted(at - 1)[0][n]
        if ok == 0.0:
            before = predicted(at)[0][n] if len(model.ar) else before
            continue
        phi = naive_centred(phi, model)
        own = np.append(phi / model.unit, y - phi @ model.theta) / np.sqrt(noise)
        mean, variance = predicted(at)
        white = (own - mean) / np.sqrt(variance)
        places, past = [*places, at], [*past, own]
        x, scale = white[n] / (numbers[SCALE] * np.sqrt(h)), numbers[SCALE] * np.sqrt(h * variance)
        g, most = np.clip(x, -numbers[CLIP], numbers[CLIP]), max(30.0, 2.0 * abs(before) / scale)
        found.append((white[:n] / np.sqrt(h), np.clip(x, -most, most), g, t))
        before = own[n]
        h = 1.0 - numbers[ALPHA] - numbers[BETA] + (numbers[ALPHA] * g * g / numbers[V] + numbers[BETA]) * h
    return found


def naive_window(part, model):
    """(one, joint, noise) of the scores of a window."""
    numbers, L = model.numbers, len(part)
    phi, g = (np.array([one[k] for one in part]) for k in (0, 2))
    G = phi.T @ phi
    inverse = np.linalg.inv(numbers[V] * G + numbers[K] ** 2 * G @ model.cov @ G)
    S, n = phi.T @ g, phi.shape[1]
    one = max((step @ G @ inverse @ S) ** 2 / (step @ G @ inverse @ G @ step) for _, step, _ in naive_steps(model))
    c = 2.0 / (9.0 * n)
    joint = ((S @ inverse @ S / n) ** (1.0 / 3.0) - (1.0 - c)) / np.sqrt(c)
    shape = L * numbers[V] ** 2 / numbers[KAPPA]
    noise = ((np.mean(g * g) / numbers[V]) ** (1.0 / 3.0) - (1.0 - 1.0 / (9.0 * shape))) * 3.0 * np.sqrt(shape)
    noise = abs(noise) / np.sqrt(1.0 + L / numbers[NORMAL]) if numbers[LONGEST] >= L else np.nan
    return np.sqrt(one), joint, noise


def naive_change(part, model):
    """The findings from WHICH on, of the last rows of a stream: the change of greatest likelihood over all its ages."""
    numbers, n = model.numbers, len(model.theta)
    around, lengths = 0, range(1, min(len(part), 384) + 1)
    for _ in range(2):
        ages, age = [], 1
        for L in lengths:
            near = abs(L - around) <= around // FINE
            if age <= L or near:
                ages.append((L, 1 if near else 1 + L // FINE))
                age = sum(ages[-1])
        gains = np.array([naive_gains(part[len(part) - L :], model) for L, _ in ages])  # (ages, n + 1, 3)
        which = int(np.argmax(gains[..., 0].max(axis=0)))
        around = ages[int(np.argmax(gains[:, which, 0]))][0]
    best, constant = gains[..., 0].max(axis=0), int(numbers[CONSTANT])
    which = constant if best[constant] > best[which] - ALIKE else which
    others = [j for j in range(n + 1) if j != which and best[j] > best[which] - ALIKE]
    gain, size, std = gains[:, which].T
    weight = np.exp(0.5 * (gain - gain.max())) * [step for _, step in ages]
    mean = weight @ size / weight.sum()
    error = np.sqrt(weight @ (std**2 + (size - mean) ** 2) / weight.sum())
    L = ages[int(np.argmax(gain))][0]
    return [which if L >= FEWEST else np.nan, mean, error, L, max(others, key=best.__getitem__, default=np.nan)]


def naive_gains(part, model):
    """(gain, size, std) of a change of each parameter and of the noise, for the rows since it."""
    numbers, n, L = model.numbers, len(model.theta), len(part)
    phi, x = (np.array([one[k] for one in part]) for k in (0, 1))
    G, U = phi.T @ phi, phi.T @ x
    found, inverse = np.zeros((n + 1, 3)), np.linalg.pinv(numbers[RAW] * G + G @ model.cov @ G)
    for j, step, share in naive_steps(model):
        length, score = step @ G @ inverse @ G @ step, step @ G @ inverse @ U
        if score**2 / length > found[j, 0]:
            found[j] = score**2 / length, share * score / length, share / np.sqrt(length)
    free = L - np.linalg.matrix_rank(phi)
    if free > 1:
        r, kurtosis = (x @ x - U @ np.linalg.pinv(G) @ U) / (free * numbers[RAW]), numbers[SPREAD] / numbers[RAW] ** 2
        gain = free * (r - 1.0 - np.log(r)) / max(1.0, 0.5 * kurtosis)
        found[n] = gain, np.sqrt(r), 0.5 * np.sqrt(r * numbers[SPREAD] / free) / numbers[RAW]
    return found


def naive_steps(model):
    """(parameter, step (n,) in units, share of the parameter in it): about the means, and slopes through zero."""
    steps, n = [(j, one, 1.0) for j, one in enumerate(np.eye(len(model.theta)))], len(model.theta)
    for j in np.flatnonzero(model.mean):
        c = int(model.numbers[CONSTANT])
        step = model.unit[j] * np.eye(n)[j] + model.mean[j] * model.unit[c] * np.eye(n)[c]
        steps.append((j, step / np.linalg.norm(step), step[j] / np.linalg.norm(step)))
    return steps


@pytest.mark.parametrize("centred", [False, True])
@pytest.mark.parametrize("ar", [(), (0.6, -0.2)], ids=["white", "autoregression"])
def test_statistics_are_those_of_a_naive_twin(ar, centred):
    rng = np.random.default_rng(4)
    n, T = 3, 230
    numbers = np.zeros(NUMBERS)
    for place, value in {
        SCALE: 1.3, CLIP: 2.5, K: 0.98, V: 0.95, KAPPA: 1.2, ALPHA: 0.1, BETA: 0.8, RAW: 1.1, LONGEST: 60, NORMAL: 480,
        SPREAD: 2.9, CONSTANT: 2, EVEN: 0.5,
    }.items():  # fmt: skip
        numbers[place] = value
    root = 0.01 * rng.normal(size=(n, n))
    mean = np.array([0.0, 50.0, 0.0] if centred else [])
    model = Frozen(
        rng.normal(size=n),
        np.array([1.0, 10.0, 0.1]),
        np.array(ar),
        root @ root.T,
        numbers,
        np.zeros((0, n)),
        mean,
        np.zeros(n),
        np.array([2.0, np.inf, np.inf]),
    )
    rows = np.ones((T, n + 4))
    rows[:, :n] = rng.normal(size=(T, n)) * [1.0, 10.0, 0.1] + [0.0, 5.0, 0.0]
    rows[:, 2] = 0.1 if centred else rows[:, 2]
    rows[:, n] = naive_centred(rows[:, :n], model) @ model.theta + 2.0 * rng.normal(size=T)
    rows[[30, 31, 90], n + 1] = 0.0
    rows[40:60, n + 2] = 4.0
    rows[120, n + 3], rows[150, n + 3] = 0.0, 3.0
    rows[200:, n] += 4.0  # a change, at the end of the record
    findings, use = np.empty((T, FINDINGS)), np.zeros(T, np.int8)
    memory = memory_of(model)
    scan(rows[:100], model, memory, findings[:100], use[:100])
    scan(rows[100:], model, memory, findings[100:], use[100:])  # in two parts, as a stream
    scores, best, told = naive_scores(rows, model), {}, 0
    for count, (*_, t) in enumerate(scores, start=1):
        for level in range(6):
            for blocks in (8, 12):
                L = blocks << level
                if count % (1 << level) == 0 and count >= L:
                    best[L] = naive_window(scores[count - L : count], model)
        if not best:
            assert np.isnan(findings[t, ONE])
            continue
        even = {L: numbers[EVEN] * 2.0 * np.log(384 / L) for L in best}
        deviates = [np.sqrt(np.maximum(np.maximum(found, 0.0) ** 2 - even[L], 0.0)) for L, found in best.items()]
        assert findings[t, [ONE, JOINT, NOISE]] == pytest.approx(np.nanmax(deviates, axis=0))
        assert np.isfinite(findings[t, LENGTH]) == (findings[t, ONE] > 2.0)
        if findings[t, ONE] > 2.0 and t % 5 == 0:
            told += 1
            expected = naive_change(scores[:count], model)
            assert findings[t, [WHICH, SIZE, STD, LENGTH, INSTEAD]] == pytest.approx(expected, nan_ok=True)
    assert told > 3
    assert np.array_equal(findings[30], findings[29], equal_nan=True)
    assert np.array_equal(findings[120], findings[119], equal_nan=True)


def noise_of(kind, T, rng):
    if kind == "t3":
        return rng.standard_t(3, size=T) / np.sqrt(3.0)
    z, e = rng.normal(size=T), np.zeros(T)
    h = 1.0
    for t in range(T):
        if kind == "AR(.6)":
            e[t] = 0.6 * e[t - 1] + 0.8 * z[t]
        else:
            e[t] = np.sqrt(h) * z[t]
            h = 0.05 + 0.1 * e[t] ** 2 + 0.85 * h if kind == "GARCH" else 1.0
    return e


@pytest.mark.filterwarnings("ignore:.*fault code")  # the tail of Student's law
@pytest.mark.parametrize("kind", ["normal", "t3", "AR(.6)", "GARCH"])
def test_rates_of_false_alarms(kind):
    """Five references of 1000 samples, 5000 more from each, one alarm in 250 set: within four standard errors."""
    begun = []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u, v = rng.normal(size=6000), noise_of(kind, 6000, rng)
        run = track(GAIN, HELD, 2.0 * u + 1.0 + 3.0 * v, u)
        begun.append(len(run.detect(every=250.0, reference=1000, seed=seed).onsets))
    assert abs(np.mean(begun) / 20.0 - 1.0) < 4.0 * max(np.std(begun) / 20.0, 0.2) / 5.0**0.5


@pytest.mark.parametrize(("unit", "name", "size"), [(1.0, "gain", 0.6), (1e-4, "intercept", -1.0), (1e5, "noise", 2.0)])
def test_a_change_is_found_named_and_sized(unit, name, size):
    """With one false alarm in 1000 samples; in the units of y, whatever they are."""
    late, covered, since = [], [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u, v, after = rng.normal(size=1600), rng.normal(size=1600), np.arange(1600) >= 1200
        y = (2.0 + after * size * (name == "gain")) * u + 1.0 + after * size * (name == "intercept")
        y += v * np.where(after & (name == "noise"), size, 1.0)
        detected = track(GAIN, AugmentedFLS(mu=10.0), unit * y, u).detect(every=1000.0, reference=1000)
        begun = detected.onsets[detected.onsets >= 1200]
        late.append(begun[0] - 1200)
        settled = detected.change(int(begun[0]) + 150)
        scale = 1.0 if name == "noise" else unit
        covered.append(settled.low < size * scale < settled.high)
        assert settled.name == name
        since.append(detected.change(int(begun[0])).since - 1200)
    assert np.median(late) < 60
    assert sum(covered) >= 3
    assert np.median(np.abs(since)) < 20


def test_the_noise_model_of_a_reference():
    rng = np.random.default_rng(1)
    constant, h = noise_model(rng.standard_t(3, size=2000), 2)
    assert constant[ALPHA] < 0.02
    assert np.std(h) < 0.1
    changing, h = noise_model(noise_of("GARCH", 2000, rng), 2)
    assert 0.03 <= changing[ALPHA] <= 0.15
    assert 0.8 <= changing[ALPHA] + changing[BETA] < 1.0
    assert 0.6 < np.median(h) < 1.4
    phi, e = rng.normal(size=(2000, 2)) * [1.0, 1e6], noise_of("AR(.6)", 2000, rng)
    ok = np.ones(2000, bool)
    ok[100:103] = False
    frozen, known = frozen_model(reference(phi, phi @ [2.0, 1e-6] + e, ok))
    assert len(frozen.ar) == 1
    assert frozen.ar[0] == pytest.approx(0.6, abs=0.07)
    assert frozen.theta == pytest.approx([2.0, 1e-6], abs=0.1)
    assert len(known.x) == 2000 - 5  # a gap of three and the lag after it, and the first row
    unexcited, _ = frozen_model(reference(np.column_stack([phi[:, 0], phi[:, 0]]), phi[:, 0] + e, ok))
    assert unexcited.unseen.shape == (1, 2)  # nothing is known of their difference
    assert unexcited.unseen[0, 0] == pytest.approx(-unexcited.unseen[0, 1])


def test_a_short_reference_leaves_bursts_possible():
    """With 300 samples the most likely model is constant noise in two thirds of the references."""
    rng = np.random.default_rng(2)
    changing = [noise_model(noise_of("GARCH", 300, rng), 0)[0][ALPHA] for _ in range(40)]
    constant = [noise_model(rng.normal(size=300), 0)[0][ALPHA] for _ in range(40)]
    assert 0.04 < np.median(changing) < 0.15
    assert np.quantile(changing, 0.1) > 0.005
    assert np.median(constant) < 0.03


def test_the_covariance_of_a_reference_allows_for_what_was_fitted():
    """With 100 rows of 30 regressors residuals are a sixth smaller than errors."""
    square = []
    for seed in range(60):
        rng = np.random.default_rng([seed, 8])
        phi = rng.normal(size=(100, 30))
        found, _ = frozen_model(reference(phi, rng.normal(size=100)))
        away = found.theta * found.unit / found.numbers[SCALE]
        square.append(away @ np.linalg.solve(found.cov, away) / 30.0)
    assert 0.7 < np.mean(square) < 1.5


def test_a_short_reference_says_how_far_the_real_rate_may_be():
    rng = np.random.default_rng(3)
    u, v = rng.normal(size=(2, 2500))
    run = track(GAIN, HELD, 2.0 * u + 1.0 + v, u)
    short, long = (run.detect(every=1000.0, reference=N, records=192) for N in (180, 2000))
    assert short.rule.unsure > long.rule.unsure
    low, high = short.rule.real_rate
    assert low < 400.0 < 1000.0 < high
    assert "samples in 95 % of streams" in str(short)


def test_the_chance_of_an_extreme_and_the_default_reference():
    y, u = arx_record(900, 4)
    quiet = track(ARX(2, 2), HELD, y, u).detect()
    assert quiet.kind == "glr"
    assert quiet.start == 300
    assert quiet.every == 10_000.0
    loud = track(ARX(2, 2), HELD, y + 0.3 * (np.arange(900) > 600), u).detect()
    assert quiet.p > 0.01
    assert loud.p < 1e-6
    assert any("since" in row for row in rows_of(loud))
    assert "p-value < 0.0001 is the probability that a record without a fault is this extreme" in map(
        " ".join, rows_of(loud)
    )
    assert chance_of(quiet.rule, np.array(quiet.rule.limits), 5000) == pytest.approx(1.0 - np.exp(-0.5))
    assert onsets(loud.active)[0] == loud.onsets[0] > 600
    # extrapolation: a limit that is ten times as rare is the one that the tail of a normal variable has, roughly
    rare = track(ARX(2, 2), HELD, y, u).detect(every=100_000.0)
    ratio = stats.norm.sf(rare.limits[0]) / stats.norm.sf(quiet.limits[0])
    assert 0.03 < ratio < 0.3
    assert loud.cause(int(loud.onsets[0])) == "offset"


def test_a_short_record_has_a_longer_reference():
    y, u = arx_record(240, 4)
    assert track(ARX(2, 2), HELD, y, u).detect(records=20).start == 150
    y[60:70] = np.nan
    assert track(ARX(2, 2), HELD, y, u).detect(records=20).start == 162  # two more have a missing lag
    with pytest.raises(ValueError, match=r"samples 50 to 97 contain 47 that can be used. Give a longer"):
        track(ARX(2, 2), HELD, *arx_record(130, 4)).detect()


def test_errors():
    y, u = arx_record(400, 4)
    run = track(ARX(2, 2), HELD, y, u)
    with pytest.raises(ValueError, match="100 normal samples at least; samples 50 to 90 contain 40"):
        run.detect(reference=90)
    with pytest.raises(ValueError, match="must be a number of samples"):
        run.detect("glr", reference={"b1": (0.0, 1.0)})
    rule = run.detect(reference=300).rule
    with pytest.raises(ValueError, match="has 4 parameters"):
        Live(ARX(1, 1), HELD).detect(rule)


def test_an_idle_input_among_others_is_no_movement():
    """The directions that a reference did not excite are computed, and their rounding is not excited either: no sample
    of such a record was judged."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        u = rng.normal(size=(700, 3)) * [1.0, 0.0, 1.0]
        y = u.sum(axis=1) + 1.0 + rng.normal(size=700) + 1.0 * (np.arange(700) >= 600)
        alarms = track(Regression(3, intercept=True), HELD, y, u).detect(every=1000.0, reference=500, records=8)
        assert alarms.unseen == 0
        assert alarms.active[600:650].any()


@pytest.mark.parametrize("slope", [0.0, 2.0])
def test_a_reference_without_noise_is_refused_in_words(slope):
    """A sensor that stood still, and outputs that were computed: rounding errors are no measure of a change."""
    x = np.column_stack([np.ones(300), np.random.default_rng(0).normal(size=300)])
    for y in (x @ [5.0, slope], np.zeros(300)):
        with pytest.raises(ValueError, match=r"explain samples 50 to 200 without error"):
            track(Regression(2), Kalman(q=0.0, r=1.0), y, x).detect("glr", reference=(50, 200))


def test_a_column_of_zeros_is_no_constant():
    u = np.random.default_rng(1).normal(size=(400, 2)) * [1.0, 0.0]
    run = track(Regression(2), Kalman(q=0.0, r=0.25), u[:, 0] + np.random.default_rng(2).normal(size=400), u)
    assert run.detect(reference=200).rule.parameters[-1] == "offset"
