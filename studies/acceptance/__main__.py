"""`python -m studies.acceptance`."""

from __future__ import annotations

import sys

from studies.acceptance.command import run_command

if __name__ == "__main__":
    sys.exit(run_command(sys.argv[1:]))
