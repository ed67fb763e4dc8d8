"""Join parts of a dataset that were made separately."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Iterator, Mapping, Sequence

from datasets_manifest.recipe.recipe import RecipeSource
from datasets_manifest.storage.frame_store import FrameStore
from datasets_manifest.storage.layout import RECIPE_FILE, RECORD_FILE
from datasets_manifest.storage.manifest import Manifest, read_manifest
from datasets_manifest.storage.packing import pack_if_complete, read_packing
from datasets_manifest.storage.reader import Dataset
from datasets_manifest.storage.storage import Location, map_in_order, open_storage
from datasets_manifest.storage.writer import write_frame
from droguekit.batch.progress import ProgressReport
from droguekit.batch.render_dataset import EventLog, RunSummary, RunTotals, describe_dataset, still_missing
from droguekit.batch.resume import check_frames, differing_keys, open_dataset, remove_damaged
from render.version import RENDER_VERSION

_SHOWN = 20
_SAME_BUILD = "make all shards with the same packages on processors of one kind"


def merge_shards(
    out: Location, shards: Sequence[Location], report: ProgressReport, pairs_per_tar: int | None = None
) -> RunSummary:
    """Join shards of one recipe into the dataset that a single run would have made.

    Complete frames that are in `out` already stay, so the same call continues a merge that was stopped.

    Args:
        out: place of the dataset; a folder is made if missing.
        shards: datasets that hold a part of the frames each; a frame may be in several.
        report: is told of the progress.
        pairs_per_tar: frames in a tar file; None keeps what the dataset has, folders at first.

    Raises:
        ValueError: the shards do not belong together or to the frames in `out`, lack frames, or hold damaged ones;
            nothing is joined then.
        OSError: the folder cannot be written; finished frames stay.
    """
    if not shards:
        raise ValueError("shards: at least one must be given")
    manifests = {shard: read_manifest(shard) for shard in shards}
    first, manifest = next(iter(manifests.items()))
    for shard, other in manifests.items():
        _check_compatible(first, manifest, shard, other)
    sources = _locate_frames(manifests)
    drops = [drop for other in manifests.values() for drop in other.drops if drop.frame_index not in sources]
    _check_complete(manifest.recipe.frames.count, {*sources, *(drop.frame_index for drop in drops)})
    datasets = {shard: Dataset(shard) for shard in shards}
    source = RecipeSource(manifest.recipe, _recipe_text(first))
    with open_dataset(out, source, pairs_per_tar, report.say) as stream:
        events = EventLog(stream)
        before = read_manifest(out)
        if before.frames:
            _check_compatible(first, manifest, out, before, "merge into a new folder")
        there = check_frames(out, before)
        whole = there.whole
        _check_kept(out, whole, sources)
        events.write("merge", shards=[str(shard) for shard in shards], kept=len(whole))
        totals, packing = RunTotals(), read_packing(out, range(manifest.recipe.frames.count))
        report.begin("pairs", len(sources) - len(whole))
        try:
            for frame_index in sorted(set(sources) - whole):
                totals.size_bytes += _copy_frame(datasets[sources[frame_index][0]], frame_index, out)
                totals.made.append(frame_index)
                if packing is not None:
                    pack_if_complete(out, frame_index, packing)
                report.advance()
        finally:
            report.end()
        remove_damaged(out, before, {*there.damaged} - {*sources})
        missing = still_missing(drops, out)
        result = describe_dataset(manifest.recipe, out, missing, made_by=manifest)
        events.write("end", pairs=result.counts.pairs, dataset_sha256=result.dataset_sha256)
    planned = manifest.recipe.frames.count
    return RunSummary(totals, len(whole), missing, result.counts.pairs, planned, result.dataset_sha256)


def _check_compatible(
    first: Location, manifest: Manifest, shard: Location, other: Manifest, advice: str = _SAME_BUILD
) -> None:
    """Check that two shards are parts of one dataset.

    Raises:
        ValueError: they are not; names what differs.
    """
    differing = differing_keys(manifest.recipe.model_dump(mode="json"), other.recipe.model_dump(mode="json"))
    if differing:
        raise ValueError(f"{shard}: is of another recipe than {first}: they differ in {', '.join(differing[:8])}")
    for what, there, here in _build_pairs(manifest, other):
        if there != here:
            raise ValueError(
                f"{shard}: was made with {what} {here}, but {first} with {there}; their pixels or last digits differ: "
                f"{advice}"
            )
    if other.render_version != RENDER_VERSION:
        raise ValueError(f"{shard}: is of render version {other.render_version}, this is {RENDER_VERSION}; use that")


def _build_pairs(manifest: Manifest, other: Manifest) -> Iterator[tuple[str, str, str]]:
    """What two shards were made with: kind, value of the one, value of the other."""
    yield "render version", manifest.render_version, other.render_version
    if manifest.engines and other.engines:
        yield "engine", " and ".join(sorted(manifest.engines)), " and ".join(sorted(other.engines))
    for name in sorted({*manifest.software, *other.software}):
        yield name, manifest.software.get(name, "missing"), other.software.get(name, "missing")
    mine, theirs = set(manifest.cpu_features), set(other.cpu_features)
    yield (
        "processor features",
        " ".join(sorted(mine - theirs)) or "none more",
        " ".join(sorted(theirs - mine)) or ("none more"),
    )


def _locate_frames(manifests: dict[Location, Manifest]) -> dict[int, tuple[Location, str]]:
    """The shard that holds each frame, and the hash of its record.

    Raises:
        ValueError: two shards hold different frames of one index.
    """
    found: dict[int, tuple[Location, str]] = {}
    for shard, manifest in manifests.items():
        for entry in manifest.frames:
            known, sha256 = found.setdefault(entry.frame_index, (shard, entry.record_sha256))
            if sha256 != entry.record_sha256:
                raise ValueError(
                    f"{shard}: its frame {entry.frame_index} differs from that of {known}; make both again"
                )
    return found


def _check_kept(out: Location, whole: Collection[int], sources: Mapping[int, tuple[Location, str]]) -> None:
    """Check that the frames which stay in the dataset are those of the shards.

    Raises:
        ValueError: one differs; names it.
    """
    store, kept = FrameStore(out), sorted(sources.keys() & whole)
    records = map_in_order(lambda frame_index: store.read(frame_index, RECORD_FILE), kept, store.storage)
    for frame_index, record in zip(kept, records, strict=True):
        shard, sha256 = sources[frame_index]
        if hashlib.sha256(record).hexdigest() != sha256:
            raise ValueError(f"{out}: its frame {frame_index} differs from that of {shard}; merge into a new folder")


def _check_complete(count: int, there: set[int]) -> None:
    missing = [frame_index for frame_index in range(count) if frame_index not in there]
    if missing:
        shown = ", ".join(map(str, missing[:_SHOWN])) + (
            f" and {len(missing) - _SHOWN} more" if len(missing) > _SHOWN else ""
        )
        raise ValueError(
            f"shards: {len(missing)} of {count} frames are in none of them: {shown}; run the commands of their "
            "shards again, then merge"
        )


def _recipe_text(shard: Location) -> str:
    storage = open_storage(shard)
    try:
        return storage.read(RECIPE_FILE).decode()
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{storage.where(RECIPE_FILE)}: is no UTF-8 text: {error.reason} at byte {error.start}; put the recipe back"
        ) from error


def _copy_frame(source: Dataset, frame_index: int, out: Location) -> int:
    """Copy a frame, hashing it on the way.

    Returns:
        The size of its files without the record. [bytes]

    Raises:
        ValueError: it is damaged.
    """
    try:
        record, files = source.whole_frame(frame_index)
    except ValueError as error:
        raise ValueError(f"{error}; run the command of that shard again, which repairs it, then merge") from error
    write_frame(out, record, files)
    return sum(len(content) for content in files.values())
