"""Draw datasets and results: sheets, videos, pages, the rerun viewer, mesh files and PDF."""
