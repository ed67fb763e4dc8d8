"""Measurements of droguekit by its makers: acceptance bars, comparisons, costs. Nothing that ships imports them."""
