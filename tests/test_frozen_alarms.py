"""Alarms on a frozen reference model: a naive twin of the statistics, rates, delays, and what changed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy import signal, stats
from scipy.linalg import toeplitz
from support import arx_record, rows_of

from driftfit import ARX, AugmentedFLS, Kalman, Live, Regression, track
from driftfit.data.storage import describe, rebuild
from driftfit.judge.alarms.bootstrap import START
from driftfit.judge.alarms.frozen import frozen_model, noise_model, noise_models, slopes_of
from driftfit.judge.alarms.onsets import onsets
from driftfit.judge.alarms.side_by_side import SimulatedRecords, statistics_of
from driftfit.run.live.likelihood_ratio import scan
from driftfit.run.live.reference_model import (
    ALPHA,
    BETA,
    BOUND,
    CLIP,
    CONSTANT,
    CUSUM,
    EVEN,
    JOINT,
    KAPPA,
    LONGEST,
    NOISE,
    NORMAL,
    NUMBERS,
    ONE,
    RAW,
    SCALE,
    SHIFT,
    SIZE,
    TOP,
    WHICH,
    Frozen,
    K,
    V,
    memory_of,
)
from driftfit.run.live.rule import AlarmRule

HELD = Kalman(q=0.0, r=1.0)
GAIN = Regression(["gain"], intercept=True)


def naive_centred(phi, model):
    """Regressors (.., n) about the means of the reference."""
    return phi - phi[..., [int(model.numbers[CONSTANT])]] * model.mean if len(model.mean) else phi


def naive_scores(rows, model):
    """(phi, x, g, index of the row) of the usable rows, from the definition: every row is predicted from all usable
    ones before, by the covariances of the autoregression."""
    n, numbers = len(model.theta), model.numbers
    response = signal.lfilter([1.0], np.r_[1.0, -model.ar], np.eye(1, 4000)[0])
    autocovariance = np.correlate(response, response, "full")[len(response) - 1 :]
    h, at, found, places, past = 1.0, 0, [], [], []
    for t, row in enumerate(rows):
        phi, (y, ok, noise, dt) = row[:n], row[n:]
        if dt == 0.0:
            continue
        at += round(dt) if dt > 1.5 else 1
        if ok == 0.0:
            continue
        phi = naive_centred(phi, model)
        own = np.append(phi / model.unit, y - phi @ model.theta) / np.sqrt(noise)
        cross = autocovariance[at - np.array(places, int)]
        weights = np.linalg.solve(toeplitz(autocovariance[:400])[np.ix_(places, places)], cross)
        variance = autocovariance[0] - weights @ cross
        white = (own - weights @ np.reshape(past, (-1, n + 1))) / np.sqrt(variance)
        places, past = [*places, at], [*past, own]
        x = white[n] / (numbers[SCALE] * np.sqrt(h))
        g = np.clip(x, -numbers[CLIP], numbers[CLIP])
        found.append((white[:n] / np.sqrt(h), x, g, t))
        h = 1.0 - numbers[ALPHA] - numbers[BETA] + (numbers[ALPHA] * g * g / numbers[V] + numbers[BETA]) * h
    return found


def naive_window(part, model):
    """(one, which, size, joint, noise, fit) of the scores of a window; fit is NaN if few scores are clipped."""
    numbers, L = model.numbers, len(part)
    phi, x, g = (np.array([one[k] for one in part]) for k in range(3))
    G = phi.T @ phi
    inverse = np.linalg.inv(numbers[V] * G + numbers[K] ** 2 * G @ model.cov @ G)
    S, U, n = phi.T @ g, phi.T @ x, phi.shape[1]
    found, clipped = [], g @ g > 0.5 * L * numbers[CLIP] ** 2
    for j, step, share in naive_steps(model):
        length, score, raw = (G @ step @ inverse @ one for one in (G @ step, S, U))
        by = raw**2 / length if clipped else score**2 / length
        found.append((by - (1.0 if share < 1.0 else 0.0), score**2 / length, j, share * raw / length))
    _, _, j, size = max(found)
    lines = [phi @ step for k, step, _ in naive_steps(model) if k == j]
    explained = max((line @ x) ** 2 / (line @ line) for line in lines)
    squares, left = x @ x / (L * numbers[RAW]), max(x @ x - explained, 0.0) / ((L - 1) * numbers[RAW])
    fit = (explained / left if squares > max(1.0, left**2) else 0.0) if clipped else np.nan
    c = 2.0 / (9.0 * n)
    joint = ((S @ inverse @ S / n) ** (1.0 / 3.0) - (1.0 - c)) / np.sqrt(c)
    shape = L * numbers[V] ** 2 / numbers[KAPPA]
    noise = ((np.mean(g * g) / numbers[V]) ** (1.0 / 3.0) - (1.0 - 1.0 / (9.0 * shape))) * 3.0 * np.sqrt(shape)
    noise = abs(noise) / np.sqrt(1.0 + L / numbers[NORMAL]) if numbers[LONGEST] >= L else np.nan
    return np.sqrt(max(square for _, square, _, _ in found)), j, size, joint, noise, fit


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
        CONSTANT: 2, EVEN: 0.5, TOP: 3.0,
    }.items():  # fmt: skip
        numbers[place] = value
    root = 0.01 * rng.normal(size=(n, n))
    mean = np.array([0.0, 50.0, 0.0] if centred else [])
    model = Frozen(
        rng.normal(size=n), np.array([1.0, 10.0, 0.1]), np.array(ar), root @ root.T, numbers, np.zeros((0, n)), mean
    )
    rows = np.ones((T, n + 4))
    rows[:, :n] = rng.normal(size=(T, n)) * [1.0, 10.0, 0.1] + [0.0, 5.0, 0.0]
    rows[:, 2] = 0.1 if centred else rows[:, 2]
    rows[:, n] = naive_centred(rows[:, :n], model) @ model.theta + 2.0 * rng.normal(size=T)
    rows[[30, 31, 90], n + 1] = 0.0
    rows[40:60, n + 2] = 4.0
    rows[120, n + 3], rows[150, n + 3] = 0.0, 3.0
    findings, use = np.empty((T, CUSUM + n + 1)), np.zeros(T, np.int8)
    memory = memory_of(model)
    scan(rows[:100], model, memory, findings[:100], use[:100])
    scan(rows[100:], model, memory, findings[100:], use[100:])  # in two parts, as a stream
    scores, best = naive_scores(rows, model), {}
    slopes = [(j, step) for j, step, share in naive_steps(model) if 0.2 < share < 1.0]
    up, down = np.zeros(n + 1 + len(slopes)), np.zeros(n + 1 + len(slopes))
    for count, (phi, _, g, t) in enumerate(scores, start=1):
        for level in range(6):
            for blocks in (8, 12):
                L = blocks << level
                if count % (1 << level) == 0 and count >= L:
                    best[L] = naive_window(scores[count - L : count], model)
        own, phi = np.clip([phi @ step for _, step in slopes], -BOUND, BOUND), np.clip(phi, -BOUND, BOUND)
        z, power = np.r_[phi * g, g * g - numbers[V], own * g], np.r_[phi * phi, 1.0, own * own]
        shift, var = np.full(len(z), SHIFT * numbers[K]), np.full(len(z), numbers[V])
        shift[n], var[n] = SHIFT * numbers[V], numbers[KAPPA]
        up = np.maximum(0.0, up + (shift * z - 0.5 * shift**2 * power) / var)
        down = np.maximum(0.0, down + (-shift * z - 0.5 * shift**2 * power) / var)
        up, down = (np.where(one > 4.5, 4.5 + 0.98 * (one - 4.5), one) for one in (up, down))
        most = np.sqrt(2.0 * np.maximum(up, down))
        for (j, _), one in zip(slopes, most[n + 1 :], strict=True):
            most[j] = max(most[j], one)
        assert findings[t, CUSUM:] == pytest.approx(most[: n + 1])
        if not best:
            assert np.isnan(findings[t, ONE])
            continue
        even = {L: numbers[EVEN] * 2.0 * np.log(384 / L) for L in best}
        deviates = np.array(
            [
                np.sqrt(np.maximum(np.maximum(np.take(found, [0, 3, 4]), 0.0) ** 2 - even[L], 0.0))
                for L, found in best.items()
            ]
        )
        one = max(best.values())
        shown = max((found for found in best.values() if found[5] >= 0.0), key=lambda found: found[5], default=one)
        shown = shown if one[5] >= 0.0 and shown[5] > one[5] else one
        assert findings[t, [WHICH, SIZE]] == pytest.approx(shown[1:3])
        assert findings[t, [ONE, JOINT, NOISE]] == pytest.approx(np.nanmax(deviates, axis=0))
    assert np.array_equal(findings[30], findings[29], equal_nan=True)
    assert np.array_equal(findings[120], findings[119], equal_nan=True)


@pytest.mark.parametrize("cusum", [False, True])
def test_records_side_by_side_have_the_statistics_of_each(cusum):
    """Eleven records in two vectors, each with a model of its own; the third has a regressor that is always zero, and
    from the sixth on the first regressor is centred."""
    rng, R, T, n = np.random.default_rng(3), 11, 400, 2
    numbers = np.zeros((R, NUMBERS))
    numbers[:, [CLIP, K, V, KAPPA, SCALE, NORMAL, CONSTANT, EVEN]] = [2.5, 0.98, 0.95, 1.2, 1.0, 480, 1, 0.5]
    mean = np.where(np.arange(R) < 5, 0.0, 0.5 * np.arange(R))
    numbers[:, V] += 0.01 * np.arange(R)
    numbers[:, LONGEST] = 30 + 30 * np.arange(R)
    root = 0.02 * rng.normal(size=(R, n, n))  # theta is known well enough for every sample to judge the noise
    phi, g = rng.normal(size=(R, T, n)), np.clip(rng.normal(size=(R, T)), -2.5, 2.5)
    phi[2, :, 1] = 0.0
    cov = root @ root.transpose(0, 2, 1)
    models = [
        Frozen(np.zeros(n), np.ones(n), np.zeros(0), cov[k], numbers[k], np.zeros((0, n)), np.array([mean[k], 0.0]))
        for k in range(R)
    ]
    records = SimulatedRecords(cov, numbers, phi, g, np.array([slopes_of(model) for model in models]))
    together = statistics_of(records, cusum)
    assert np.array_equal(statistics_of(records, cusum, START), together[:, START:])
    for k, found in enumerate(together):
        findings, rows = np.empty((T, CUSUM + n + 1)), phi[k] + np.outer(phi[k, :, 1], [mean[k], 0.0])
        scan(
            np.column_stack([rows, g[k], np.ones((T, 3))]),
            models[k],
            memory_of(models[k]),
            findings,
            np.zeros(T, np.int8),
        )
        alone = findings[START:, CUSUM:] if cusum else findings[START:, [ONE, JOINT, NOISE]]
        np.testing.assert_allclose(found[START:], np.nan_to_num(alone), rtol=1e-9, atol=1e-9)


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
    """Five references of 1000 samples, 5000 more from each, one alarm in 100 set: within four standard errors."""
    begun = {"glr": [], "cusum": []}
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u, v = rng.normal(size=6000), noise_of(kind, 6000, rng)
        run = track(GAIN, HELD, 2.0 * u + 1.0 + 3.0 * v, u)
        for name, counts in begun.items():
            counts.append(len(run.detect(name, every=100.0, reference=1000, seed=seed).onsets))
    for counts in begun.values():
        assert abs(np.mean(counts) / 50.0 - 1.0) < 4.0 * max(np.std(counts) / 50.0, 0.2) / 5.0**0.5


@pytest.mark.parametrize(("unit", "name", "size"), [(1.0, "gain", 0.6), (1e-4, "intercept", -1.0), (1e5, "noise", 2.0)])
def test_a_change_is_found_named_and_sized(unit, name, size):
    """With one false alarm in 1000 samples; in the units of y, whatever they are."""
    late, covered, since = [], [], []
    for seed in range(5):
        rng = np.random.default_rng(seed)
        u, v, after = rng.normal(size=1600), rng.normal(size=1600), np.arange(1600) >= 1200
        y = (2.0 + after * size * (name == "gain")) * u + 1.0 + after * size * (name == "intercept")
        y += v * np.where(after & (name == "noise"), size, 1.0)
        detected = track(GAIN, AugmentedFLS(mu=10.0), unit * y, u).detect(every=1000.0, reference=1000, hold=20)
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
    frozen, rows = frozen_model(phi, phi @ [2.0, 1e-6] + e, ok)
    assert len(frozen.ar) == 1
    assert frozen.ar[0] == pytest.approx(0.6, abs=0.07)
    assert frozen.theta == pytest.approx([2.0, 1e-6], abs=0.1)
    assert len(rows.x) == 2000 - 5  # a gap of three and the lag after it, and the first row
    unexcited, _ = frozen_model(np.column_stack([phi[:, 0], phi[:, 0]]), phi[:, 0] + e, ok)
    assert unexcited.unseen.shape == (1, 2)  # nothing is known of their difference
    assert unexcited.unseen[0, 0] == pytest.approx(-unexcited.unseen[0, 1])


def test_a_short_reference_leaves_bursts_possible():
    """With 300 samples the most likely model is constant noise in two thirds of the references."""
    rng = np.random.default_rng(2)
    changing, _ = noise_models(np.array([noise_of("GARCH", 300, rng) for _ in range(40)]), 0)
    constant, _ = noise_models(rng.normal(size=(40, 300)), 0)
    assert 0.04 < np.median(changing[:, ALPHA]) < 0.15
    assert np.quantile(changing[:, ALPHA], 0.1) > 0.005
    assert np.median(constant[:, ALPHA]) < 0.03


def test_the_covariance_of_a_reference_allows_for_what_was_fitted():
    """With 100 rows of 30 regressors residuals are a sixth smaller than errors."""
    square = []
    for seed in range(60):
        rng = np.random.default_rng([seed, 8])
        phi = rng.normal(size=(100, 30))
        found, _ = frozen_model(phi, rng.normal(size=100), np.ones(100, bool))
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


@pytest.mark.parametrize("kind", ["glr", "cusum"])
def test_a_rule_of_an_earlier_version_judges_as_it_did(kind):
    """It was saved without directions that its reference did not excite."""
    y, u = arx_record(400, 9)
    run = track(ARX(2, 2), HELD, y, u)
    now = run.detect(kind, reference=300, records=8)
    assert now.rule.frozen[6] == ()  # no regressor is far from zero
    saved = json.dumps(describe(replace(now.rule, frozen=now.rule.frozen[:5])))
    earlier = run.detect(rebuild(json.loads(saved), AlarmRule), start=now.start)
    assert len(earlier.rule.frozen) == 5
    np.testing.assert_array_equal(earlier.statistic, now.statistic)
    assert (earlier.p, earlier.unseen) == (now.p, 0)
    live = Live(ARX(2, 2), HELD)
    alarms = [live.detect(one.rule) for one in (now, earlier)]
    for t in range(400):
        live.update(y[t], u[t])
    assert np.isfinite(alarms[0].statistic).all()
    np.testing.assert_array_equal(*(one.statistic for one in alarms))


def test_an_idle_input_leaves_the_alarm_as_it_is():
    """A column of zeros in the reference has no parameter: the gain's jump is found as without that column."""
    rng = np.random.default_rng(1)
    u, after = rng.normal(size=1600), np.arange(1600) >= 1200
    y = (2.0 + 0.6 * after) * u + 1.0 + 0.5 * rng.normal(size=1600)
    idle = track(Regression(2, intercept=True), Kalman(q=0.0, r=0.25), y, np.c_[u, np.zeros(1600)])
    begun = idle.detect(every=1000.0, reference=800).onsets
    assert 1200 <= begun[begun >= 1200][0] < 1250


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
