"""Where a COCO file has its images and annotations, found in one pass without holding the file.

A dataset of 20,000 pairs has files of 100 MB and more, which as Python's objects take several times that.
"""

from __future__ import annotations

import json
from array import array
from collections.abc import Callable, Iterator
from hashlib import blake2b
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from datasets_manifest.storage.storage import Storage
from datasets_manifest.storage.writer import canonical_json
from drogue_models.untrusted_files import parse_json

MOST_ENTRY_BYTES = 2**24
"""Most bytes of an image, an annotation or any other value of a COCO file."""
_BLOCK_BYTES = 2**18
_LISTS = ("images", "annotations")
_DIGEST_BYTES = 16
# Annotations whose beginnings are no farther apart are read by one request.
_NEAR_BYTES = 2**16


class CocoIndex:
    """Ids, categories and places of a COCO file's entries.

    Attributes:
        image_ids: (n,) ascending.
        annotation_ids: (m,) in the file's order.
        categories: (id, name) of each.
        digests: for each group of images the sum of the digests of its images and their annotations, in any order.
    """

    def __init__(self, storage: Storage, name: str, group_of: Callable[[int], str | None]) -> None:
        """Read a file once.

        Args:
            storage: with the file.
            name: of the file.
            group_of: the group of an image's id, such as its split.

        Raises:
            FileNotFoundError: no such file.
            OSError: it cannot be read.
            ValueError, KeyError, TypeError, AttributeError: it is truncated, not JSON, or not COCO's.
        """
        self._storage, self._name = storage, name
        self.digests: dict[str | None, int] = {}
        self.categories: list[tuple[Any, Any]] = []
        images, annotations = array("q"), array("q")
        image_of, offsets, sizes = array("q"), array("q"), array("q")
        found = set()
        with storage.open(name) as stream:
            for key, offset, raw in _members(stream):
                if raw is None or key not in _LISTS:
                    if key in found:
                        raise ValueError(f"has {key} twice")
                    found.add(key)
                if raw is None:
                    continue
                entry: Any = parse_json(raw)
                if key == "categories":
                    self.categories = [(each["id"], each["name"]) for each in entry]
                elif key in _LISTS:
                    image_id = entry["id" if key == "images" else "image_id"]
                    self._add_digest(group_of(image_id), key, entry)
                    if key == "images":
                        images.append(image_id)
                        continue
                    annotations.append(entry["id"])
                    for places, place in ((image_of, image_id), (offsets, offset), (sizes, len(raw))):
                        places.append(place)
        for key in ("annotations", "images", "categories"):
            if key not in found:
                raise KeyError(key)
        self.image_ids: NDArray[np.int64] = np.unique(np.array(images, dtype=np.int64))
        self.annotation_ids: NDArray[np.int64] = np.array(annotations, dtype=np.int64)
        order = np.argsort(np.array(image_of, dtype=np.int64), kind="stable")
        self._image_of, self._offsets, self._sizes = (
            np.array(each, dtype=np.int64)[order] for each in (image_of, offsets, sizes)
        )

    def has_image(self, image_id: int) -> bool:
        """Whether the file lists an image."""
        place = int(np.searchsorted(self.image_ids, image_id))
        return place < len(self.image_ids) and int(self.image_ids[place]) == image_id

    def annotations_of(self, image_id: int) -> list[Any]:
        """The annotations of an image, in the file's order, read again.

        Raises:
            OSError, ValueError: the file was changed since, or cannot be read.
        """
        first, last = (int(np.searchsorted(self._image_of, image_id, side)) for side in ("left", "right"))
        offsets, sizes = self._offsets[first:last], self._sizes[first:last]
        found: list[Any] = []
        # Those that stand close together are read at once: every request to an object store takes time.
        for part in np.split(np.arange(last - first), np.flatnonzero(np.diff(offsets) > _NEAR_BYTES) + 1):
            if not part.size:
                continue
            start, end = int(offsets[part[0]]), int(offsets[part[-1]] + sizes[part[-1]])
            text = self._storage.read(self._name, start, end - start)
            found += [parse_json(text[offsets[at] - start : offsets[at] - start + sizes[at]]) for at in part]
        return found

    def _add_digest(self, group: str | None, key: str, entry: Any) -> None:
        text = f"{key}{canonical_json(entry)}".encode("utf-8", "surrogatepass")
        digest = int.from_bytes(blake2b(text, digest_size=_DIGEST_BYTES).digest(), "big")
        self.digests[group] = (self.digests.get(group, 0) + digest) % (1 << 8 * _DIGEST_BYTES)


def _members(stream: BinaryIO) -> Iterator[tuple[str, int, bytes | None]]:
    """Key, offset and text of each value of a JSON object; the lists of a COCO file entry by entry, after a None."""
    text = _JsonText(stream)
    text.expect("{")
    more = text.peek() != "}"
    while more:
        key = json.loads(text.value()[1])
        if not isinstance(key, str):
            raise ValueError(f"keys must be texts, got {key!r}")
        text.expect(":")
        if key in _LISTS:
            yield key, 0, None
            text.expect("[")
            inside = text.peek() != "]"
            while inside:
                yield key, *text.value()
                inside = text.peek() == ","
                if inside:
                    text.expect(",")
            text.expect("]")
        else:
            yield key, *text.value()
        more = text.peek() == ","
        if more:
            text.expect(",")
    text.expect("}")
    if text.peek():
        raise ValueError("goes on behind its end")


class _JsonText:
    """A stream of JSON, of which only the value at hand is held."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._decoder = stream, json.JSONDecoder()
        # A character a byte: what delimits JSON is ASCII, and places are those in the file.
        self._text, self._at, self._before = "", 0, 0

    def peek(self) -> str:
        """The next character that is no space; empty at the end."""
        while True:
            rest = len(self._text)
            while self._at < rest and self._text[self._at] in " \t\n\r":
                self._at += 1
            if self._at < rest:
                return self._text[self._at]
            if not self._read_on():
                return ""

    def expect(self, character: str) -> None:
        """Go on behind a character.

        Raises:
            ValueError: another one follows.
        """
        if self.peek() != character:
            raise ValueError(f"{character!r} expected at byte {self._before + self._at}, got {self.peek()!r}")
        self._at += 1

    def value(self) -> tuple[int, bytes]:
        """Offset and text of the next value.

        Raises:
            ValueError: it is truncated, no JSON, nested too deep or larger than `MOST_ENTRY_BYTES`.
        """
        self.peek()
        while True:
            try:
                end = self._decoder.raw_decode(self._text, self._at)[1]
            except RecursionError as error:
                raise ValueError("is nested too deep") from error
            except json.JSONDecodeError as error:
                if not self._read_on():
                    raise ValueError(f"{error.msg} at byte {self._before + error.pos}") from error
            else:
                # A number at the end of what is read may have more digits.
                if end < len(self._text) or not self._read_on():
                    break
        start, self._at = self._at, end
        if end - start > MOST_ENTRY_BYTES:
            raise ValueError(f"has a value of more than {MOST_ENTRY_BYTES} bytes at byte {self._before + start}")
        return self._before + start, self._text[start:end].encode("latin-1")

    def _read_on(self) -> bool:
        """Read more, at least as much as is held of the value at hand; whether there was any."""
        held = len(self._text) - self._at
        if held > MOST_ENTRY_BYTES:
            raise ValueError(f"has a value of more than {MOST_ENTRY_BYTES} bytes at byte {self._before + self._at}")
        data = self._stream.read(max(_BLOCK_BYTES, held))
        if data:
            self._before += self._at
            self._text, self._at = self._text[self._at :] + data.decode("latin-1"), 0
        return bool(data)
