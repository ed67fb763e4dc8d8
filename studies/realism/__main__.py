"""Prints how far the modelled skies are from real ones: `python -m studies.realism`."""

from __future__ import annotations

import argparse
from collections.abc import Sequence

from studies.realism.sky_measures import sky_table


def main(arguments: Sequence[str] | None = None) -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(prog="python -m studies.realism", description=__doc__)
    parser.parse_args(arguments)
    print(sky_table())


if __name__ == "__main__":
    main()
