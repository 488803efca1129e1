# Copyright 2026 mapmerge_ros contributors
# SPDX-License-Identifier: Apache-2.0
"""Products in place: right on blocks of other matrices, and never in the way of other threads."""

import sys
import threading
import time

import numpy as np
import pytest

from mapmerge_ros.blas import (
    add_square,
    cholesky,
    inverse_of_factored,
    inverse_of_positive,
    mirror,
    square_of_lower,
    times_lower,
)


def blocks(rows, columns, seed=0):
    """A block inside a larger matrix in Fortran order, and the whole one."""
    whole = np.asfortranarray(np.random.default_rng(seed).normal(size=(rows + 7, columns + 5)))
    return whole[3 : 3 + rows, 2 : 2 + columns], whole


SIZES = [1, 2, 5, 33, 130]


def only_the_lower_triangle_changed(whole, before, size):
    inside = np.zeros(whole.shape, bool)
    inside[3 : 3 + size, 2 : 2 + size] = np.tri(size, dtype=bool)
    np.testing.assert_array_equal(whole[~inside], before[~inside])


@pytest.mark.parametrize('size', SIZES)
@pytest.mark.parametrize('columns', [0, 1, 40])
def test_add_square(size, columns):
    c, whole = blocks(size, size)
    a, before = blocks(size, columns, 1)[0], whole.copy()
    expected = 0.5 * c - 2.0 * a @ a.T
    add_square(c, a, -2.0, 0.5)
    np.testing.assert_allclose(np.tril(c), np.tril(expected), atol=1e-12)
    only_the_lower_triangle_changed(whole, before, size)
    c[...] = np.nan
    add_square(c, a, beta=0.0)
    np.testing.assert_allclose(np.tril(c), np.tril(a @ a.T), atol=1e-12)


@pytest.mark.parametrize('size', [*SIZES, 64, 65, 128])
def test_mirror(size):
    matrix, whole = blocks(size, size)
    before, lower = whole.copy(), np.tril(matrix)
    mirror(matrix)
    np.testing.assert_array_equal(matrix, lower + np.tril(lower, -1).T)
    whole[3 : 3 + size, 2 : 2 + size] = before[3 : 3 + size, 2 : 2 + size]
    np.testing.assert_array_equal(whole, before)


@pytest.mark.parametrize('size', SIZES)
@pytest.mark.parametrize('transposed', [False, True])
@pytest.mark.parametrize('right', [False, True])
def test_times_lower(size, transposed, right):
    lower, _ = blocks(size, size)
    triangle = np.tril(lower).T if transposed else np.tril(lower)
    b, whole = blocks(*((11, size) if right else (size, 11)), 1)
    before, expected = whole.copy(), 3.0 * (b @ triangle if right else triangle @ b)
    times_lower(b, lower, 3.0, transposed=transposed, right=right)
    np.testing.assert_allclose(b, expected, atol=1e-12)
    b[...] = before[3 : 3 + b.shape[0], 2 : 2 + b.shape[1]]
    np.testing.assert_array_equal(whole, before)


@pytest.mark.parametrize('size', SIZES)
def test_square_of_lower(size):
    lower, whole = blocks(size, size)
    before, expected = whole.copy(), np.tril(lower).T @ np.tril(lower)
    square_of_lower(lower)
    np.testing.assert_allclose(np.tril(lower), np.tril(expected), atol=1e-12)
    only_the_lower_triangle_changed(whole, before, size)


@pytest.mark.parametrize('size', SIZES)
def test_factor_and_inverse_of_a_positive_matrix(size):
    root, whole = blocks(size, size)
    exact = root @ root.T + size * np.eye(size)
    root[...] = exact
    before = whole.copy()
    np.testing.assert_allclose(inverse_of_positive(exact), np.linalg.inv(exact), atol=1e-12)
    cholesky(root)
    np.testing.assert_allclose(np.tril(root), np.linalg.cholesky(exact), rtol=1e-10, atol=1e-12)
    only_the_lower_triangle_changed(whole, before, size)
    inverse = inverse_of_factored(root)
    assert inverse is root
    np.testing.assert_array_equal(inverse, inverse.T)
    np.testing.assert_allclose(inverse, np.linalg.inv(exact), atol=1e-12)
    whole[3 : 3 + size, 2 : 2 + size] = exact
    np.testing.assert_array_equal(whole, before)


@pytest.mark.parametrize('value', [-1.0, np.nan, np.inf])
@pytest.mark.parametrize('at', [0, 70, 199])
def test_what_cannot_be_factorised_is_refused(value, at):
    matrix = np.eye(200, order='F')
    matrix[at, at] = value
    with pytest.raises(np.linalg.LinAlgError):
        inverse_of_positive(matrix)
    with pytest.raises(np.linalg.LinAlgError):
        inverse_of_factored(np.zeros((2, 2), order='F'))


def test_nothing_is_done_to_an_empty_matrix():
    empty = np.zeros((0, 0), order='F')
    for job in (cholesky, inverse_of_factored, inverse_of_positive, square_of_lower):
        job(empty)
    add_square(empty, np.zeros((0, 4), order='F'))
    times_lower(np.zeros((0, 4), order='F'), empty)


@pytest.mark.parametrize(
    'wrong',
    [
        np.zeros((3, 3), np.float32, order='F'),
        np.zeros((3, 3)),
        np.zeros((6, 6), order='F')[::2, ::2],
        np.zeros((3, 4), order='F'),
        np.broadcast_to(np.zeros((3, 1)), (3, 3)),
        np.zeros((3, 3), order='F')[:, ::-1],
    ],
    ids=['float32', 'by rows', 'every second', 'not square', 'broadcast', 'backwards'],
)
def test_other_arrays_are_refused(wrong):
    with pytest.raises(ValueError, match=r'needed|square'):
        square_of_lower(wrong)


def test_sizes_that_do_not_go_together_are_refused():
    three = np.zeros((3, 3), order='F')
    with pytest.raises(ValueError, match='does not go into 3 x 3'):
        add_square(three, np.zeros((4, 2), order='F'))
    with pytest.raises(ValueError, match='triangle of 3'):
        times_lower(np.zeros((4, 2), order='F'), three)


@pytest.mark.parametrize(
    'job',
    [
        lambda a: add_square(np.zeros(a.shape, order='F'), a),
        lambda a: times_lower(a, a.copy(order='F')),
        cholesky,
        inverse_of_factored,
        square_of_lower,
    ],
    ids=['square', 'triangle', 'cholesky', 'inverse', 'square of lower'],
)
def test_another_thread_goes_on_meanwhile(job):
    matrix = np.asfortranarray(np.eye(900))
    turns, ended, begun = [0], threading.Event(), threading.Event()

    def other():
        while not ended.is_set():
            turns[0] += 1
            begun.set()
            time.sleep(0.0)

    usual = sys.getswitchinterval()
    thread = threading.Thread(target=other)
    thread.start()
    begun.wait()
    try:
        # From here on a thread only gets the interpreter when another one gives it away.
        sys.setswitchinterval(1e3)
        before = turns[0]
        for _ in range(5):
            job(matrix)
        meanwhile = turns[0] - before
    finally:
        sys.setswitchinterval(usual)
        ended.set()
        thread.join()
    assert meanwhile
