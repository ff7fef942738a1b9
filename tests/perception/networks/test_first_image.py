"""How images are preprocessed is decided by the first that shows markers, not by a damaged one before it."""

from __future__ import annotations

import numpy as np
import pytest

from tests.helpers.marker_samples import simulated
from touchcell.perception.errors import ImageError
from touchcell.perception.networks.marker_training import preprocessing_and_size


def test_damaged_first_images_do_not_decide_about_the_others() -> None:
    (image,) = simulated(1, seed=1).images
    grey = (0.5 * image + 40.0).astype(np.uint8)
    expected = preprocessing_and_size([grey])
    assert expected[0].threshold is not None
    assert preprocessing_and_size([np.zeros_like(grey), np.full_like(grey, 255), grey]) == expected


def test_images_without_markers_are_refused() -> None:
    with pytest.raises(ImageError, match="7 markers or more"):
        preprocessing_and_size([np.zeros((60, 60), np.uint8)] * 3)
