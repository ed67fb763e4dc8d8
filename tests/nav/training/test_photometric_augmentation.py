from __future__ import annotations

import numpy as np

from nav.training.augmentation import color_jitter


def test_color_jitter_varies_and_does_not_change_its_input() -> None:
    image = np.full((32, 48, 3), 128, np.uint8)
    varied = [color_jitter(np.random.default_rng(seed), image) for seed in range(200)]
    assert (image == 128).all()
    assert all(each.shape == image.shape and each.dtype == np.uint8 for each in varied)
    means = np.array([each.mean() for each in varied])
    assert means.min() < 40 and means.max() > 180  # low light, and nearly twice the exposure
    assert means.min() > 18  # 20, less what blur, rounding and cut-off noise change
    dim = [color_jitter(np.random.default_rng(seed), image // 6).mean() for seed in range(200)]
    # What is dark already is exposed, cast and curved as all images are, by 0.55, 0.7 and a gamma of 1.45 at worst.
    assert min(dim) > 255 * (21 / 255) ** 1.45 * 0.55 * 0.7
    again = color_jitter(np.random.default_rng(7), image)
    np.testing.assert_array_equal(again, varied[7])
