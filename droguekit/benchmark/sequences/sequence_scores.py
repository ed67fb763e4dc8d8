"""Everything that is only defined over sequences, for all methods of a file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from datasets_manifest.types.estimates import Estimate, PoseEstimate
from droguekit.benchmark.poses.comparisons import PairGroups
from droguekit.benchmark.poses.distance_bins import distance_bins
from droguekit.benchmark.poses.frame_truth import DrogueTruth
from droguekit.benchmark.results.sequence_result import HiddenPairs, MethodSequences, SequencesResult
from droguekit.benchmark.sequences.docking_scores import docking_errors
from droguekit.benchmark.sequences.sequence_docking import true_dockings
from droguekit.benchmark.sequences.sequence_filtering import SequenceData, filtering, root_mean_length
from droguekit.benchmark.sequences.sequence_latency import latency
from droguekit.benchmark.sequences.sequence_motion import true_motions
from droguekit.benchmark.sequences.sequence_truth import Moment, TrueSequence
from droguekit.benchmark.sequences.tracking import track_regions
from droguekit.benchmark.sequences.tracking_scores import reacquisition

Methods = Mapping[str, Mapping[int, Estimate]]


def score_sequences(
    sequences: Sequence[TrueSequence], drogues: Mapping[int, DrogueTruth], methods: Methods
) -> SequencesResult | None:
    """Score what estimates say of boxes, motion, docking and time.

    Args:
        sequences: of the dataset.
        drogues: the truth of all pairs that show one, in ascending order of frames.
        methods: estimates by method and frame.

    Returns:
        None where there are no sequences, or no estimate of one says anything of these.
    """
    if not sequences:
        return None
    data = sequence_data(sequences, drogues)
    dockings = true_dockings(sequences, data.motions)
    # Where some report boxes, those who have none failed to.
    has_regions = any(answer.regions for estimates in methods.values() for answer in estimates.values())
    scored: dict[str, MethodSequences] = {}
    for name, estimates in methods.items():
        parts = {
            "tracking": track_regions(sequences, estimates) if has_regions else None,
            "filtering": filtering(data, name, methods),
            "docking": docking_errors(data, dockings, estimates, f"{name}, docking"),
            "latency": latency(data, estimates),
        }
        if any(part is not None for part in parts.values()):
            scored[name] = MethodSequences(hiding=_hidden_pairs(sequences, estimates), **parts)
    if not scored:
        return None
    spans = [sequence.moments[-1].time_s - sequence.moments[0].time_s for sequence in sequences]
    return SequencesResult(
        count=len(sequences),
        pairs=sum(len(sequence.moments) for sequence in sequences),
        minutes=float(np.sum(spans)) / 60,
        vibration_rms_m_s=root_mean_length(
            [motion.vibration_m_s for motion in data.motions.values() if motion.vibration_m_s is not None]
        ),
        methods=scored,
    )


def sequence_data(sequences: Sequence[TrueSequence], drogues: Mapping[int, DrogueTruth]) -> SequenceData:
    """The truth that sequences are scored with; arguments as those of `score_sequences`."""
    bins, labels = distance_bins([truth.distance_m for truth in drogues.values()])
    groups = PairGroups(
        bins,
        dict(zip(drogues, labels, strict=True)),
        {index: truth.sequence_id for index, truth in drogues.items()},
    )
    return SequenceData(sequences, drogues, true_motions(sequences), groups)


def _hidden_pairs(sequences: Sequence[TrueSequence], estimates: Mapping[int, Estimate]) -> HiddenPairs:
    moments = [moment for sequence in sequences for moment in sequence.moments if moment.sight == "hidden"]
    courses = [
        (
            [moment.sight for moment in sequence.moments],
            [_has_found(moment, estimates.get(moment.frame_index)) for moment in sequence.moments],
        )
        for sequence in sequences
    ]
    return HiddenPairs(
        hidden=len(moments),
        poses_while_hidden=sum(isinstance(estimates.get(moment.frame_index), PoseEstimate) for moment in moments),
        reacquisition=reacquisition(courses),
    )


def _has_found(moment: Moment, estimate: Estimate | None) -> bool:
    """Whether an answer is a pose that lies within the rim of the drogue."""
    pose, drogue = moment.left_from_drogue, moment.drogue
    if pose is None or drogue is None or not isinstance(estimate, PoseEstimate):
        return False
    error_m = estimate.left_from_drogue.translation_m - pose.translation_m
    return float(np.linalg.norm(error_m)) <= drogue.rim_radius_m
