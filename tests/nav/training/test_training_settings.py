from __future__ import annotations

from pathlib import Path

import pytest

from nav.training.training_settings import build_settings, parse_size


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"size_px": (480, 650)}, "size_px: must be multiples of 32 px"),
        ({"size_px": (0, 640)}, "size_px: must be multiples of 32 px"),
        ({"size_px": (4128, 640)}, "size_px: must be at most 4096 px a side, got 4128x640"),
        ({"final_size_px": (480, 320_000)}, "final_size_px: must be at most 4096 px a side"),
        (
            {"size_px": (640, 640), "final_size_px": (480, 640)},
            "final_size_px: must have the shape of the larger size_px 640x640, got 480x640",
        ),
        ({"batch_images": 5}, "batch_images: must be even"),
        ({"batch_images": 2048}, "batch_images:"),
        ({"loader_workers": 65}, "loader_workers:"),
        ({"variant": "m"}, "variant:"),
        ({"learning_rate": float("nan")}, "learning_rate:"),
        ({"image_passes": 0}, "image_passes:"),
        ({"colour": 1}, "colour:"),
    ],
)
def test_wrong_settings_are_one_line(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message) as caught:
        build_settings(None, changes)
    assert "\n" not in str(caught.value)


def test_settings_come_from_a_file_and_changes_precede_it(tmp_path: Path) -> None:
    file = tmp_path / "mine.toml"
    file.write_text('variant = "s"\nlearning_rate = 0.002\nsize_px = [320, 416]\n')
    settings = build_settings(file, {"learning_rate": 0.004})
    assert (settings.variant, settings.learning_rate, settings.size_px) == ("s", 0.004, (320, 416))
    file.write_text("variant = \n")
    with pytest.raises(ValueError, match=r"mine\.toml: is not valid TOML"):
        build_settings(file, {})
    with pytest.raises(ValueError, match=r"none\.toml: cannot be read"):
        build_settings(tmp_path / "none.toml", {})


def test_sizes_are_height_by_width() -> None:
    assert parse_size("480x640") == (480, 640)
    for text in ("480", "x640", "480x-32", "480 x 640", "a" * 50):
        with pytest.raises(ValueError, match="must be HEIGHTxWIDTH"):
            parse_size(text)
