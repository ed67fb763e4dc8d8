"""The benchmark report as an HTML page: tables, figures and pictures."""
