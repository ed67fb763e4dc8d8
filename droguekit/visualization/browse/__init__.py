"""A dataset as a page for a browser, which needs no server and no network."""
