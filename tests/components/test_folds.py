"""Folds of a record: every row is left out once, and what comes and goes is in several of them."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from estimator.components.folds import left_out


@given(n=st.integers(0, 400), folds=st.integers(2, 6), length=st.integers(0, 90))
def test_every_row_is_left_out_once(n, folds, length):
    out = np.array(list(left_out(n, folds, length)))
    assert out.shape == (folds, n)
    assert (out.sum(axis=0) == 1).all()


@pytest.mark.parametrize("every", range(2, 13))
def test_what_acts_at_equal_distances_is_left_out_in_parts(every):
    """In one stretch of ``every`` ones, as a fan at equal distances."""
    n, length = 75 * 60, 60
    acts = (np.arange(n) // length) % every == 0
    shares = [acts[out].sum() / acts.sum() for out in left_out(n, 3, length)]
    assert max(shares) < 0.75, shares
