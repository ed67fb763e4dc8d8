"""What a pair is filtered by, and its conditions as a reader wants them."""

from __future__ import annotations

from datasets_manifest.types.frame import Environment, FrameSpec
from datasets_manifest.types.records import PairRecord
from droguekit.benchmark.report.number_text import plain_number

# Our choice: night, dusk, a dull day's shade and a bright sky, by the luminance behind the drogue. [cd/m2]
LIGHTS = ("below 1 cd/m²", "1 to 100 cd/m²", "100 to 3000 cd/m²", "from 3000 cd/m²")
LIGHT_EDGES_CD_M2 = (1.0, 100.0, 3000.0)


def light_of(luminance_cd_m2: float) -> str:
    """The class of light that a background's luminance belongs to, one of `LIGHTS`. [cd/m2]"""
    return LIGHTS[sum(luminance_cd_m2 >= edge for edge in LIGHT_EDGES_CD_M2)]


def search_text(record: PairRecord, split: str) -> str:
    """Words by which a pair can be found."""
    frame, sky = record.frame, record.frame.environment
    words = [record.conditions.family, split, f"scene {record.scene_id}", record.engine, sky.ground]
    words += [cloud.kind for cloud in sky.clouds]
    words += [kind for kind, there in (("mist", sky.mist), ("moon", sky.moon), ("map", sky.map)) if there is not None]
    words += [object_.kind for object_ in frame.bystanders]
    words += ["no drogue" if frame.drogue is None else frame.drogue.name]
    words += [] if frame.board is None else ["board"]
    return " ".join(words).lower()


def conditions_table(record: PairRecord, split: str) -> list[tuple[str, str]]:
    """Names and values, the most telling first."""
    frame, conditions = record.frame, record.conditions
    rows = [("Distance", "no drogue" if conditions.distance_m is None else f"{plain_number(conditions.distance_m)} m")]
    if record.pitch_deg is not None and record.yaw_deg is not None and record.roll_deg is not None:
        angles = (record.pitch_deg, record.yaw_deg, record.roll_deg)
        rows.append(("Pitch, yaw, roll", ", ".join(f"{plain_number(angle)}°" for angle in angles)))
    if frame.drogue is not None:
        rows.append(("Drogue", f"{frame.drogue.name}, {frame.drogue.marker_count} markers"))
    rows.append(("Family", conditions.family))
    rows.append(("Split, scene", f"{split}, {record.scene_id}"))
    if record.sequence_id is not None:
        rows.append(("Sequence, time", f"{record.sequence_id}, {record.time_s:.3f} s"))
    rows.append(("Background", f"{plain_number(conditions.background_luminance_cd_m2)} cd/m²"))
    rows += _sky(frame.environment)
    exposure = frame.exposure
    rows.append(
        ("Exposure", f"{plain_number(1e3 * exposure.time_s)} ms, f/{exposure.f_number:g}, gain {exposure.gain:g}")
    )
    rows += _objects(frame)
    noise = conditions.monte_carlo_noise_fraction
    rows.append(("Noise of the renderer", f"{plain_number(100 * noise)} % of the luminance"))
    rows.append(("Made by", record.engine_version))
    return rows


def _sky(sky: Environment) -> list[tuple[str, str]]:
    rows = [("Sun", f"{plain_number(sky.sun_elevation_deg)}° high, azimuth {plain_number(sky.sun_azimuth_deg)}°")]
    if sky.map is not None:
        rows.append(("Surroundings", "a picture of sky and ground"))
        return rows
    rows.append(("Visibility", f"{plain_number(sky.visibility_m / 1e3)} km"))
    rows.append(("Clouds", ", ".join(cloud.kind for cloud in sky.clouds) or "none"))
    if sky.mist is not None:
        rows.append(("Mist", "around the camera"))
    if sky.moon is not None:
        rows.append(("Moon", "in the sky"))
    rows.append(("Ground", f"{sky.ground}, {plain_number(sky.altitude_m)} m below"))
    return rows


def _objects(frame: FrameSpec) -> list[tuple[str, str]]:
    rows = []
    if frame.bystanders:
        rows.append(("Also in view", ", ".join(object_.kind for object_ in frame.bystanders)))
    if frame.board is not None:
        rows.append(("Board", "for calibration, in the drogue's place"))
    if frame.rangefinder_reading_m is not None:
        rows.append(("Rangefinder", f"{plain_number(frame.rangefinder_reading_m)} m"))
    return rows
