"""Quadratic programs in two forms."""

import numpy as np
import pytest

from benchmarks.qp_solvers import recorded, solved


@pytest.mark.parametrize("objective", ["tracking", "progress"])
def test_both_forms_have_the_same_solution(objective):
    forms = recorded("orca", objective, 0.5)
    assert len(forms["condensed"]) == len(forms["by stages"]) > 20
    condensed = solved(forms["condensed"], "daqp").first
    by_stages = solved(forms["by stages"], "hpipm").first
    np.testing.assert_allclose(by_stages, condensed, atol=1e-3 * np.ptp(condensed))
