"""Which method of a file is the best one."""

from __future__ import annotations

from collections.abc import Mapping

from droguekit.benchmark.results.benchmark_result import MethodResult

# Whatever it is compared with, a method is also compared with the seed paper's.
PAPER_METHOD = "paper"

# A method that finds the drogue only where that is easy is not the best one.
_FIXES_OF_MOST = 0.9


def best_method(methods: Mapping[str, MethodResult]) -> str | None:
    """Smallest mean position error among the methods that found nearly as many poses as any; None without a pose."""
    most = max(method.overall.fix_fraction for method in methods.values())
    means = {
        name: method.overall.position_mean_m
        for name, method in methods.items()
        if method.overall.position_mean_m is not None and method.overall.fix_fraction >= _FIXES_OF_MOST * most
    }
    return min(means, key=lambda name: means[name]) if means else None
