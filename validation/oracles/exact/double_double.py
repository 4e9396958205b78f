"""Double-double arithmetic: pairs of float64 whose sum is the number, with about 32 digits.

For tissue with a contrast of 1e7, squared stiffness ratios leave no correct float64 digits for the
softest motions. Double-double numbers leave sixteen digits. A number is (high, low). The sums and
products are those of Dekker (1971) and Knuth.
"""

from __future__ import annotations

import numba
import numpy as np

_scalar = numba.njit(cache=True, error_model="numpy")
_loop = numba.njit(cache=True, nogil=True, error_model="numpy")

_SPLIT = 134217729.0  # 2^27 + 1
#: Pivots below this fraction of their diagonal are examined for a zero-energy motion.
_SUSPECT = 1e-9
#: Relative energy below which a motion counts as zero-energy. Rounding errors are 1e-31, and the
#: relative energy of the weakest connected tissue is 1e-24.
FREE = 1e-28


@_scalar
def two_sum(a, b):
    """Return the exact sum of two float64 numbers."""
    total = a + b
    part = total - a
    return total, (a - (total - part)) + (b - part)


@_scalar
def two_product(a, b):
    """Return the exact product of two float64 numbers."""
    product = a * b
    wide = _SPLIT * a
    a_high = wide - (wide - a)
    a_low = a - a_high
    wide = _SPLIT * b
    b_high = wide - (wide - b)
    b_low = b - b_high
    return product, ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low


@_scalar
def add(a, b):
    """Return the sum of two numbers."""
    high, low = two_sum(a[0], b[0])
    low += a[1] + b[1]
    total = high + low
    return total, low - (total - high)


@_scalar
def multiply(a, b):
    """Return the product of two numbers."""
    high, low = two_product(a[0], b[0])
    low += a[0] * b[1] + a[1] * b[0]
    total = high + low
    return total, low - (total - high)


@_scalar
def negative(a):
    """Return the number with the opposite sign."""
    return -a[0], -a[1]


@_scalar
def divide(a, b):
    """Return the quotient of two numbers, by two corrections."""
    first = a[0] / b[0]
    rest = add(a, negative(multiply((first, 0.0), b)))
    second = rest[0] / b[0]
    rest = add(rest, negative(multiply((second, 0.0), b)))
    return add(two_sum(first, second), (rest[0] / b[0], 0.0))


@_loop
def gather_sums(rows, columns, high, low):
    """Sum sorted matrix entries at the same position; return (count, first index, high, low)."""
    count = -1
    first = np.empty(len(rows), np.int64)
    total_high, total_low = np.empty(len(rows)), np.empty(len(rows))
    for k in range(len(rows)):
        if k > 0 and rows[k] == rows[k - 1] and columns[k] == columns[k - 1]:
            total = add((total_high[count], total_low[count]), (high[k], low[k]))
            total_high[count], total_low[count] = total
        else:
            count += 1
            first[count], total_high[count], total_low[count] = k, high[k], low[k]
    return count + 1, first, total_high, total_low


@_loop
def product(starts, columns, high, low, x_high, x_low):
    """Return the product of a sparse matrix and a vector."""
    out_high, out_low = np.empty(len(starts) - 1), np.empty(len(starts) - 1)
    for i in range(len(starts) - 1):
        total = (0.0, 0.0)
        for k in range(starts[i], starts[i + 1]):
            j = columns[k]
            total = add(total, multiply((high[k], low[k]), (x_high[j], x_low[j])))
        out_high[i], out_low[i] = total
    return out_high, out_low


@_loop
def factorise(high, low, width, symmetric):
    """Factorize a band matrix as L U in place, without pivoting.

    Entry (i, j) is stored at [i, j - i + width]. A symmetric matrix may be positive semidefinite.
    For each motion in its null space, one unknown is excluded from the factorization. Return the
    mask of excluded unknowns, and the motions, (motions, n), scaled to 1 at the excluded unknown.
    """
    n = len(high)
    left_out = np.zeros(n, np.bool_)
    motions = []
    diagonal = high[:, width].copy()
    for k in range(n):
        pivot = (high[k, width], low[k, width])
        if symmetric and pivot[0] < _SUSPECT * diagonal[k]:
            motion = _motion(high, low, width, left_out, k)
            size = 0.0
            for i in range(k + 1):
                size += diagonal[i] * motion[i] ** 2
            if pivot[0] < FREE * size:
                left_out[k] = True
                motions.append(motion)
                for i in range(max(0, k - width), min(n, k + width + 1)):
                    high[i, k - i + width] = low[i, k - i + width] = 0.0
                    high[k, i - k + width] = low[k, i - k + width] = 0.0
                high[k, width] = 1.0
                continue
        last = min(n, k + width + 1)
        upper_high, upper_low = high[k, width + 1 :], low[k, width + 1 :]
        for i in range(k + 1, last):
            at = k - i + width
            if high[i, at] == 0.0:
                continue
            factor = divide((high[i, at], low[i, at]), pivot)
            high[i, at], low[i, at] = factor
            _subtract(
                factor[0],
                factor[1],
                upper_high,
                upper_low,
                high[i, at + 1 :],
                low[i, at + 1 :],
                last - k - 1,
            )
    return left_out, motions


@_loop
def _subtract(f_high, f_low, x_high, x_low, high, low, count):
    """Subtract f x from a vector in place."""
    wide = _SPLIT * f_high
    a_high = wide - (wide - f_high)
    a_low = f_high - a_high
    for j in range(count):
        x = x_high[j]
        product = f_high * x
        wide = _SPLIT * x
        b_high = wide - (wide - x)
        b_low = x - b_high
        error = ((a_high * b_high - product) + a_high * b_low + a_low * b_high) + a_low * b_low
        error += f_high * x_low[j] + f_low * x
        y = high[j]
        total = y - product
        part = total - y
        rest = ((y - (total - part)) - (product + part)) + (low[j] - error)
        sum_ = total + rest
        high[j] = sum_
        low[j] = rest - (sum_ - total)


@_loop
def _motion(high, low, width, left_out, k):
    """Return the motion with unknown k at 1, later unknowns at 0, and no force before k."""
    z_high, z_low = np.zeros(len(high)), np.zeros(len(high))
    z_high[k] = 1.0
    for i in range(k - 1, -1, -1):
        if left_out[i]:
            continue
        total = (0.0, 0.0)
        for j in range(i + 1, min(k, i + width) + 1):
            at = j - i + width
            total = add(total, multiply((high[i, at], low[i, at]), (z_high[j], z_low[j])))
        z_high[i], z_low[i] = divide(negative(total), (high[i, width], low[i, width]))
    return z_high


@_loop
def substitute(high, low, width, left_out, x_high, x_low):
    """Solve L U x = b in place; excluded unknowns stay 0."""
    n = len(high)
    for i in range(n):
        total = (x_high[i], x_low[i])
        for j in range(max(0, i - width), i):
            at = j - i + width
            if high[i, at] != 0.0:
                term = multiply((high[i, at], low[i, at]), (x_high[j], x_low[j]))
                total = add(total, negative(term))
        x_high[i], x_low[i] = (0.0, 0.0) if left_out[i] else total
    for i in range(n - 1, -1, -1):
        total = (x_high[i], x_low[i])
        for j in range(i + 1, min(n, i + width + 1)):
            at = j - i + width
            if high[i, at] != 0.0:
                term = multiply((high[i, at], low[i, at]), (x_high[j], x_low[j]))
                total = add(total, negative(term))
        x_high[i], x_low[i] = divide(total, (high[i, width], low[i, width]))
