"""Exact medians in about one pass: the robust scales that reweighting asks for again and again."""

import numpy as np
from numpy.typing import NDArray

from magcal_core.arrays import Floats
from magcal_core.numerics.kernel import kernel


@kernel()
def _select(values: Floats, k: int) -> float:  # pragma: no cover - compiled
    """Return the ``k``-th smallest of ``values``, which are left partly sorted around it (Hoare's selection)."""
    low, high = 0, values.size - 1
    while high > low:
        middle = (low + high) // 2
        a, b, c = values[low], values[middle], values[high]
        pivot = max(min(a, b), min(max(a, b), c))
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if k <= j:
            high = j
        elif k >= i:
            low = i
        else:
            break
    found: float = values[k]
    return found


@kernel()
def median_in_place(values: Floats, below: int, count: int) -> float:  # pragma: no cover - compiled
    """Return the median of ``count`` numbers of which ``below`` are less than all of ``values``, as `numpy.median`.

    ``values`` hold no NaN, and are left in another order.
    """
    first, second = (count - 1) // 2 - below, count // 2 - below
    low = _select(values, first)
    if second == first:
        return low
    high = np.inf
    for i in range(first + 1, values.size):
        high = min(high, values[i])
    return 0.5 * (low + high)


@kernel()
def median_size(
    values: Floats, prior: Floats, guess: float, reach: float, scratch: Floats
) -> float:  # pragma: no cover - compiled
    """Return the median of |``values``| over the samples with ``prior``: exact, in one pass where the guess is near.

    ``guess``: where the median was last, negative where it is not known; ``reach``: how far, relative to the guess, it
    is looked for before all values are. ``scratch``: room for all values.
    """
    n = values.size
    if guess > 0.0:
        low, high = guess * (1.0 - reach), guess * (1.0 + reach)
        count, below, inside = 0, 0, 0
        for i in range(n):
            if prior[i] > 0.0:
                size = abs(values[i])
                count += 1
                if size < low:
                    below += 1
                elif size <= high:
                    scratch[inside] = size
                    inside += 1
        if below <= (count - 1) // 2 and count // 2 < below + inside:
            return median_in_place(scratch[:inside], below, count)
    count = 0
    for i in range(n):
        if prior[i] > 0.0:
            scratch[count] = abs(values[i])
            count += 1
    return median_in_place(scratch[:count], 0, count)


@kernel()
def running_median(values: Floats, width: int) -> Floats:  # pragma: no cover - compiled
    """Return the median of each window of ``width`` values, odd, shape (n - width + 1,); none may be NaN."""
    out = np.empty(max(values.size - width + 1, 0))
    if out.size == 0:
        return out
    window = np.sort(values[:width])
    out[0] = window[width // 2]
    for start in range(1, out.size):
        # The window stays sorted: the value that enters takes the place of the one that leaves, and moves from there.
        value, leaving, j = values[start + width - 1], values[start - 1], 0
        while j < width - 1 and window[j] != leaving:
            j += 1
        while j > 0 and window[j - 1] > value:
            window[j] = window[j - 1]
            j -= 1
        while j < width - 1 and window[j + 1] < value:
            window[j] = window[j + 1]
            j += 1
        window[j] = value
        out[start] = window[width // 2]
    return out


@kernel()
def peaks_above(values: Floats, limit: float, side: int) -> NDArray[np.bool_]:  # pragma: no cover - compiled
    """Return which values are above ``limit`` and not below any of the ``side`` values on either side, shape (n,)."""
    found = np.zeros(values.size, np.bool_)
    for i in range(values.size):
        if values[i] > limit:
            found[i] = True
            for j in range(max(0, i - side), min(values.size, i + side + 1)):
                if values[j] > values[i]:
                    found[i] = False
    return found
