"""Records that read as before and say something else."""

from __future__ import annotations

import json


def with_another_pose(record: bytes) -> bytes:
    """A record's file with another depth of the drogue, and not a byte more."""
    number = json.dumps(json.loads(record)["left_from_drogue"][2][3]).encode()
    changed = number[:-1] + (b"1" if number[-1:] != b"1" else b"2")
    at = record.index(number, record.index(b'"left_from_drogue"'))
    return record[:at] + changed + record[at + len(number) :]
