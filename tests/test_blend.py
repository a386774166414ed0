"""Blending: each pixel class gets exactly the contract's bands."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from kibs_steps import blend


def test_paper_text_and_script_blends():
    """The paper's text paints blue 200 and keeps nothing; its script writes (0, 0, 255) inside and (R, G, 0) outside."""
    rgb = np.full((3, 3, 3), (10, 20, 30), np.uint8)
    labels = np.zeros((3, 3), int)
    labels[1, 1] = 4
    out = blend.blend(rgb, labels, [0, 0, 255], [0, 0, 255], [None, None, 0])
    assert out[1, 1].tolist() == [0, 0, 255]
    assert out[0, 0].tolist() == [10, 20, 0]


@given(arrays.arrays(np.int32, (7, 9), elements=st.integers(0, 3)))
def test_rims_against_brute_force(labels):
    """A rim pixel is a section pixel with a 4-neighbour of another label; the picture's own edge is no rim."""
    expected = np.zeros(labels.shape, bool)
    for r in range(7):
        for c in range(9):
            around = [
                labels[i, j] for i, j in ((r - 1, c), (r + 1, c), (r, c - 1), (r, c + 1)) if 0 <= i < 7 and 0 <= j < 9
            ]
            expected[r, c] = labels[r, c] > 0 and any(x != labels[r, c] for x in around)
    np.testing.assert_array_equal(blend.rims(labels), expected)


@given(arrays.arrays(np.int32, (6, 6), elements=st.integers(0, 2)), arrays.arrays(np.uint8, (6, 6, 3)))
def test_kept_bands_are_untouched(labels, rgb):
    out = blend.blend(rgb, labels, [None, None, 255], [None, None, 128], [None, None, 0])
    np.testing.assert_array_equal(out[..., :2], rgb[..., :2])
    rim = blend.rims(labels)
    expected = np.where(rim, 128, np.where(labels > 0, 255, 0))
    np.testing.assert_array_equal(out[..., 2], expected)
