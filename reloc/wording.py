"""Answers in words for people."""

import math

import numpy as np

from featuredb.geometry.error_radius import error_radius
from featuredb.maps.lineage import lineage_text
from reloc.answered_view import geopose_of
from reloc.wire.query import InMapPose, LocaliseReply

# Steeper than this a photo shows no horizon, and people ask where its top points.
_STEEP_DEG = 60.0

# What a person can do about each reason.
ADVICE = {
    "NO_COVERAGE": "check the prior if there is one, name a map (`featuredb maps` lists them), or ingest "
    "photos of the place",
    "TOO_FEW_FEATURES": "the photo shows too little texture: take a sharper, lighter or wider one",
    "TOO_FEW_MATCHES": "it may show another place; if not, a photo from a more similar viewpoint, "
    "a prior (--prior), or add photos of the place to the database",
    "TOO_FEW_INLIERS": "it may show another place; if not, give a prior (--prior) or the camera "
    "(--camera), or take another photo",
    "AMBIGUOUS": "another place, or a look-alike, explains it about as well: give a prior (--prior)",
    "CONTRADICTS_PRIOR": "the photo fits a place far from the prior: check the prior or widen its sigma",
}


def describe(name: str, reply: LocaliseReply, database: str) -> str:
    """A few lines about one answer of a database."""
    total = reply.timings_ms.get("total", 0.0)
    if reply.in_map is not None:
        return _in_map(name, reply, reply.in_map, database)
    if reply.utm is None or reply.position is None or reply.accuracy is None or reply.camera is None:
        advice = ADVICE.get(reply.reason or "", "")
        return (
            f"{name}: not localised in {database}: {reply.reason} ({reply.detail})\n"
            f"  {reply.inliers} inliers, {reply.matches} matches, {reply.features} features, {total:.0f} ms\n"
            f"{_own_position(reply)}"
            f"{_contribution(reply)}"
            f"  try: {advice}\n"
        )
    utm, position, accuracy = reply.utm, reply.position, reply.accuracy
    return (
        f"{name}: localised in {database}, confidence {reply.confidence:.3f}\n"
        f"  UTM       EPSG:{utm.epsg}  E {utm.easting:.3f}  N {utm.northing:.3f}  "
        f"height {utm.height:.3f} m ({reply.height_datum})\n"
        f"  WGS84     {position.lat:.8f}, {position.lon:.8f}  h {position.h:.3f} m\n"
        f"  looks     {_looks(reply)}\n"
        f"  68 %      {accuracy.horizontal_68_m:.3f} m horizontally, "
        f"{accuracy.vertical_68_m:.3f} m vertically, {accuracy.orientation_68_deg:.3f} deg\n"
        f"{_radii_95(reply)}"
        f"{_own_position(reply)}"
        f"  evidence  {_evidence(reply)}, residual {reply.residual_rms_px or 0.0:.2f} px, "
        f"camera from {reply.camera.source}, maps {', '.join(reply.maps)}\n"
        f"{_lineage(reply)}"
        f"{_contribution(reply)}"
        f"  time      {total:.0f} ms, snapshot {reply.snapshot}\n"
    )


def _evidence(reply: LocaliseReply) -> str:
    """Inliers may be more than matches: the pose finds some that nothing else tells from their like."""
    return (
        f"{reply.inliers} inliers ({reply.matches} matches led to the pose, which was then used to find more)"
    )


def _looks(reply: LocaliseReply) -> str:
    pose = geopose_of(reply)
    heading, pitch, roll = pose.heading_pitch_roll_deg
    text = f"heading {heading:.2f} deg from true north, pitch {pitch:+.2f}, roll {roll:+.2f}"
    if abs(pitch) <= _STEEP_DEG:
        if abs(roll) < 0.05:  # as it is printed, neither end
            return text
        text += f" (the horizon's right end is {'higher' if roll > 0 else 'lower'})"
    else:
        up = pose.true_enu_from_body[:, 2]
        text += f"; the photo's top points to {math.degrees(math.atan2(up[0], up[1])) % 360.0:.2f}"
    return text


def _radii_95(reply: LocaliseReply) -> str:
    c = np.array(reply.covariance)
    across, up, turn = (error_radius(part, 0.95) for part in (c[3:5, 3:5], c[5:, 5:], c[:3, :3]))
    return f"  95 %      {across:.3f} m horizontally, {up:.3f} m vertically, {math.degrees(turn):.3f} deg\n"


def _own_position(reply: LocaliseReply) -> str:
    """What the position in the photo's EXIF did; nothing where it has none, or was not asked."""
    own = reply.exif_prior
    if own is None:
        return ""
    away = "" if own.distance_m is None else f", {_metres(own.distance_m)} away horizontally"
    said = {
        "agrees": f"the photo's EXIF position{away}, agrees; the answer is the same without it",
        "decided": f"the photo's EXIF position{away}, decided; --no-exif-prior leaves it out",
        "contradicted": "the photo fits a place near its EXIF position, and one elsewhere"
        if own.distance_m is None
        else f"the photo's EXIF position{away}, is not what the photo shows; not believed",
        "no_help": "the photo's EXIF position was tried, and did not help",
    }
    return f"  prior     {said[own.role]}\n"


def _metres(distance_m: float) -> str:
    return f"{distance_m:.1f} m" if distance_m < 1000.0 else f"{distance_m / 1000.0:.1f} km"


def _in_map(name: str, reply: LocaliseReply, pose: InMapPose, database: str) -> str:
    """A pose in a map's own frame, worded so that nobody takes it for a place."""
    x, y, z = pose.center
    unit = "m" if pose.metric else "units of the map, not metres"
    return (
        f"{name}: found in map {pose.map_id} of {database}, which has NO PLACE ON EARTH, "
        f"confidence {reply.confidence:.3f}\n"
        f"  in map    x {x:.3f}  y {y:.3f}  z {z:.3f} {unit}; "
        f"z is {'up' if pose.upright else 'not known to be up'}\n"
        f"  evidence  {_evidence(reply)}, residual {pose.residual_rms_px:.2f} px, "
        f"camera from {pose.camera.source}\n"
        f"  to place the map: featuredb maps says how\n"
        f"  time      {reply.timings_ms.get('total', 0.0):.0f} ms, snapshot {reply.snapshot}\n"
    )


def _lineage(reply: LocaliseReply) -> str:
    """What the first map, which most inliers lie on, stands on; nothing for an anchor of known place."""
    first = reply.lineage[0] if reply.lineage else None
    if first is None or (not first.steps and first.drift_m is None):
        return ""
    text = lineage_text(first.steps, first.anchors, first.drift_m, first.budget_m)
    return f"  lineage   {text}\n"


def _contribution(reply: LocaliseReply) -> str:
    said = reply.contribution
    if said is None:
        return ""
    if said.accepted:
        return f"  given     candidate {said.candidate_id}\n"
    return f"  not taken {said.reason}: {said.detail}\n"
