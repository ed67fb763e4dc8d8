"""Numbers as text: a sensible unit and three significant digits, never an exponent."""

from __future__ import annotations

from decimal import Decimal

ABSENT = "–"


def three_digits(value: float | None) -> str:
    """Rounded to three significant digits; trailing zeros are kept where they are significant."""
    if value is None:
        return ABSENT
    rounded = Decimal(f"{value:.2e}")
    exponent = rounded.adjusted() if rounded else 0
    text = f"{rounded:.{max(0, 2 - exponent)}f}"
    return text.replace("-", "−")


def millimetres(value_m: float | None) -> str:
    """A length in metres, as millimetres."""
    return three_digits(None if value_m is None else value_m * 1e3)


def percent(fraction: float | None) -> str:
    """A fraction in percent with one decimal, without it where the percentage is whole."""
    if fraction is None:
        return ABSENT
    # A fraction below 1 is never shown as 100 %, nor one above 0 as 0 %.
    shown = min(max(round(fraction * 100, 1), 0.1), 99.9) if 0 < fraction < 1 else fraction * 100
    return f"{shown:g} %"


def distance_text(low_m: float, high_m: float) -> str:
    """A bin's distances: one number for a station."""
    # Frames of a station lie within 1 % of it.
    if high_m <= low_m * 1.0201:
        return f"{plain_number((low_m * high_m) ** 0.5)} m"
    return f"{plain_number(low_m)}–{plain_number(high_m)} m"


def interval_text(ends: tuple[float, float] | None, scale: float = 1.0) -> str:
    """An interval's two ends."""
    return ABSENT if ends is None else f"{three_digits(ends[0] * scale)} to {three_digits(ends[1] * scale)}"


def plain_number(value: float) -> str:
    """Three significant digits without trailing zeros."""
    text = three_digits(value)
    return text.rstrip("0").rstrip(".") if "." in text else text
