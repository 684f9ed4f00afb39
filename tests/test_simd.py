"""SIMD vectors give the bits of single numbers; parts of compiled routines have no code of their own."""

import numpy as np
import pytest
from numba import njit

from driftfit.bank.reducing.merge import digamma
from driftfit.engine.kernel import exp, log
from driftfit.engine.simd import (
    WIDTH,
    below,
    entry,
    equal,
    exp_of,
    fill,
    gathered,
    higher,
    load,
    log_of,
    lower,
    only,
    pair,
    put_pair,
    reaches,
    row_sums,
    store,
    sum_of,
    times,
    two,
)

RNG = np.random.default_rng(3)


@njit(error_model="numpy")
def elementary(x, positive, out):
    for l in range(0, x.shape[1], WIDTH):
        store(out, 0, l, exp_of(load(x, 0, l)))
        store(out, 1, l, log_of(load(positive, 0, l)))


@njit(error_model="numpy")
def one_by_one(x, positive, out):
    for l in range(x.shape[1]):
        out[0, l], out[1, l] = exp(x[0, l]), log(positive[0, l])


def test_exp_and_log_of_a_vector_have_the_bits_of_single_numbers():
    x = np.concatenate([RNG.uniform(-720, 720, 4000), RNG.uniform(-1, 1, 4000), [0.0, -np.inf, 709.0, 800.0] * 2])[None]
    positive = np.concatenate([np.exp(RNG.uniform(-600, 600, 4000)), RNG.uniform(0.3, 3, 4000), [1.0, 2.0] * 4])[None]
    eight, one = np.zeros((2, x.size)), np.zeros((2, x.size))
    elementary(x, positive, eight)
    one_by_one(x, positive, one)
    np.testing.assert_array_equal(eight, one)


@njit
def others(x, order, events, out):
    a, b = load(x, 0, 0), load(x, 1, 0)
    store(out, 0, 0, lower(a, b))
    store(out, 1, 0, higher(a, b))
    store(out, 2, 0, reaches(a, b))
    store(out, 3, 0, only(a, b))
    store(out, 4, 0, gathered(x, 2, order, 1))
    store(out, 5, 0, equal(events, 1, 2))
    store(out, 6, 0, below(events, 1, 2))
    store(out, 7, 0, row_sums(x, 1))
    store(out, 8, 0, fill(sum_of(a)))


def test_the_operations_on_vectors():
    x, order, events = RNG.normal(size=(9, WIDTH + 4)), RNG.integers(0, WIDTH + 4, 12), RNG.integers(0, 4, 12)
    x[1, 3] = 0.0
    out = np.zeros((9, WIDTH))
    others(x, order, events, out)
    a, b = x[0, :WIDTH], x[1, :WIDTH]
    expected = [
        np.minimum(a, b), np.maximum(a, b), a >= b, np.where(b > 0.0, a, 0.0), x[2, order[1 : 1 + WIDTH]],
        events[1 : 1 + WIDTH] == 2, events[1 : 1 + WIDTH] < 2,
    ]  # fmt: skip
    np.testing.assert_array_equal(out[:7], expected)
    np.testing.assert_allclose(out[7], x[1:, :WIDTH].sum(1), rtol=1e-14)
    np.testing.assert_allclose(out[8], a.sum(), rtol=1e-14)


@njit(error_model="numpy")
def in_pairs(x, out):
    for k in range(x.shape[0]):
        both = times(pair(x, k), two(2.0, -1.0))
        put_pair(out, k, higher(only(both, pair(x, k)), two(0.5, entry(both, 0))))


def test_pairs_are_the_entries_of_the_last_axis():
    x = RNG.normal(size=(6, 2))
    out = np.zeros((2, 3, 2))
    in_pairs(x, out)
    both = x * [2.0, -1.0]
    least = np.column_stack([np.full(6, 0.5), both[:, 0]])
    np.testing.assert_array_equal(out.reshape(6, 2), np.maximum(np.where(x > 0.0, both, 0.0), least))


def test_a_part_of_a_compiled_routine_says_that_it_cannot_be_called():
    with pytest.raises(TypeError, match="py_func"):
        digamma(1.0)
