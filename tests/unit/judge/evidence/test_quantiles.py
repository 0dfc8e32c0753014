"""Own medians and quantiles are NumPy's, bit by bit: the shipped heads were trained on NumPy's."""

import numpy as np
import pytest

from wm_nodes.judge.evidence.quantiles import median, quantile


@pytest.mark.parametrize("kind", [np.float32, np.float64])
def test_they_equal_numpys_for_any_number_of_values(kind: type[np.floating]) -> None:
    rng = np.random.default_rng(0)
    for count in range(1, 60):
        values = rng.normal(size=(3, count)).astype(kind)
        values[0] = np.round(values[0])  # equal ones among them
        middle = median(values)
        assert middle.dtype == kind and np.array_equal(middle, np.median(values, 1))
        for share in (0, 0.02, 0.25, 0.5, 0.85, 1):
            assert quantile(values, share) == float(np.quantile(values, share))
