"""The command `droguekit`."""
